"""From rays to a map of the floor: upright axes, the floor's height, occupancy by ray casting, and map files of ROS."""

from torchvo360.mapping.grid import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from torchvo360.mapping.level import Floor, find_floor, upright_axes
from torchvo360.mapping.occupancy import BuiltMap, MapConfig, build_map
from torchvo360.mapping.rays import Rays, rays_of_depth
from torchvo360.mapping.ros import read_map, unit_of_map, write_map

__all__ = [
    "FREE",
    "OCCUPIED",
    "UNKNOWN",
    "BuiltMap",
    "Floor",
    "MapConfig",
    "OccupancyMap",
    "Rays",
    "build_map",
    "find_floor",
    "rays_of_depth",
    "read_map",
    "unit_of_map",
    "upright_axes",
    "write_map",
]
