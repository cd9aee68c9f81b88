"""Free space and obstacles from rays, by log-odds: a ray that passes a cell frees it, one that ends there fills it.

Only what a robot can meet counts: rays are followed where they run between the floor and the robot's height, points
above the step it can climb and below its height are obstacles, points on the floor are free ground. That space is cut
into layers, for a ray to a wall that passes over a railing shall not take it away. A cell of the map is occupied if it
is in any layer. A cell of a layer is counted once a scan, and what a scan has hit it does not free. The frame is the
map's: z up, the floor at z = 0.

Source: Moravec and Elfes 1985; voxels, once a scan, and clamping as in Hornung et al., OctoMap, 2013.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_finite_number, check_shape
from torchvo360.mapping.grid import FREE, OCCUPIED, UNKNOWN, OccupancyMap, grid_around
from torchvo360.mapping.rays import Rays
from torchvo360.mapping.traverse import cells_crossed

HIT, MISS = math.log(0.7 / 0.3), math.log(0.4 / 0.6)
"""Evidence of one scan. Source: OctoMap's sensor model, 0.7 and 0.4."""

LEAST, MOST = math.log(0.12 / 0.88), math.log(0.97 / 0.03)
"""Bounds of the evidence, so that a map can change its mind. Source: OctoMap."""

OCCUPIED_ABOVE, FREE_BELOW = math.log(0.65 / 0.35), math.log(0.45 / 0.55)
"""One hit fills, one miss frees, and one of each leaves the cell unknown."""

MOST_VOXELS = 100_000_000
"""400 MB."""

CHUNK_RAYS = 1 << 14
"""Rays followed at once: some 100 MB where each crosses a few hundred cells."""


@dataclass(kw_only=True)
class MapConfig:
    """Settings of a map, in its own unit."""

    resolution: float = 0.05
    """Size of a cell."""
    robot_height: float = 1.5
    """What rises higher above the floor than this is no obstacle."""
    step: float = 0.1
    """What rises less than this is no obstacle either."""
    max_range: float = 12.0
    """Points farther from the camera than this are not used."""
    layer: float = 0.2
    """Height of a layer, in which evidence is kept apart."""
    carrier_radius: float = 0.2
    """Whoever carried the camera took this much room, so that it is free along the path; 0 for a camera that flew."""

    def __post_init__(self) -> None:
        for name in ("resolution", "robot_height", "max_range", "layer"):
            check_finite_number(name, getattr(self, name), above=0.0)
        for name in ("step", "carrier_radius"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"{name}: expected a finite number of at least 0, got {value!r}.")
        if self.max_range < self.resolution:
            least = f"the resolution of {self.resolution:g}"
            raise InputError(f"max_range: expected at least {least}, got {self.max_range:g}.")
        if self.step >= self.robot_height:
            raise InputError(f"step: expected less than the robot's height {self.robot_height:g}, got {self.step:g}.")


@dataclass(frozen=True, eq=False)
class BuiltMap:
    """What rays tell of the floor."""

    occupancy: OccupancyMap
    log_odds: Float32[Tensor, "H W"]
    """Evidence that a cell is occupied in some layer: the greatest, 0 where there is none."""
    height: Float32[Tensor, "H W"]
    """Height of the highest point in a cell up to the robot's height, 0 where none was seen."""


def build_map(rays: Rays, path: Float64[Tensor, "P 3"], config: MapConfig | None = None) -> BuiltMap:
    """Make a map of rays.

    Args:
        rays: In the map's frame: z up, the floor at z = 0.
        path: Camera centres in the same frame, in order; the map holds them all.

    Raises:
        ShapeError: The path is not [P, 3].
        InputError: It is empty, or the map would have too many cells.
    """
    config = MapConfig() if config is None else config
    check_shape("path", path, "P 3")
    if not len(path):
        raise InputError("path: expected at least one camera centre, got none.")
    rays = rays.kept(torch.linalg.vector_norm(rays.points - rays.origins, dim=-1) <= config.max_range)
    band = _in_band(rays, config)
    resolution = config.resolution
    seen = torch.cat([path[:, :2].double(), *(ends[:, :2] for ends in (band.start, band.end))])
    origin, shape = grid_around(seen, resolution, margin=max(config.carrier_radius, 2 * resolution))
    voxels = _voxels(band, origin, shape, config)
    highest, flat = voxels.amax(0), voxels.amin(0)
    evidence = torch.where(highest > 0, highest, flat)  # occupied in any layer, or else free in one
    height = torch.zeros(shape[0] * shape[1])
    reaches = band.is_hit | band.is_ground
    corner = torch.tensor(origin, dtype=torch.float64)
    column, row = ((band.end[reaches, :2] - corner) / resolution).floor().long().unbind(-1)
    height.scatter_reduce_(0, row * shape[1] + column, band.end[reaches, 2].float().clamp_min(0), "amax")
    if config.carrier_radius > 0:
        walked = _within((path[:, :2].double() - corner) / resolution, shape, config.carrier_radius / resolution)
        evidence[walked] = LEAST
    states = torch.full(shape, UNKNOWN, dtype=torch.int8)
    states[evidence > OCCUPIED_ABOVE] = OCCUPIED
    states[evidence < FREE_BELOW] = FREE
    return BuiltMap(OccupancyMap(states, resolution, origin), evidence, height.view(shape))


@dataclass(frozen=True)
class _Band:
    """The parts of rays that run at a robot's height."""

    start: Float64[Tensor, "N 3"]
    end: Float64[Tensor, "N 3"]
    scan: Int64[Tensor, "N"]
    is_hit: Tensor
    """Whether the part ends at an obstacle."""
    is_ground: Tensor
    """Whether it ends on the floor."""


def _in_band(rays: Rays, config: MapConfig) -> _Band:
    """Cut rays to where they run from a step below the floor to the robot's height; the others are left out."""
    low, high = -config.step, config.robot_height
    oz, z = rays.origins[:, 2], rays.points[:, 2]
    rise = z - oz
    level = rise.abs() < 1e-9
    slope = torch.where(level, 1.0, rise)
    at_low, at_high = (low - oz) / slope, (high - oz) / slope
    runs = (oz >= low) & (oz <= high)
    enter = torch.where(level, torch.where(runs, 0.0, 1.0), torch.minimum(at_low, at_high)).clamp(0, 1)
    leave = torch.where(level, torch.where(runs, 1.0, 0.0), torch.maximum(at_low, at_high)).clamp(0, 1)
    inside = (z >= low) & (z <= high)
    keep = (leave > enter) | inside
    offset = rays.points - rays.origins
    start = rays.origins + enter[:, None] * offset
    end = torch.where(inside[:, None], rays.points, rays.origins + leave[:, None] * offset)
    is_hit = inside & (z > config.step)
    return _Band(start[keep], end[keep], rays.scan[keep], is_hit[keep], (inside & ~is_hit)[keep])


def _voxels(
    band: _Band, origin: tuple[float, float], shape: tuple[int, int], config: MapConfig
) -> Float32[Tensor, "L H W"]:
    """Return the evidence by layer.

    Raises:
        InputError: There would be too many voxels.
    """
    layers = max(1, math.ceil((config.robot_height + config.step) / config.layer))
    if layers * shape[0] * shape[1] > MOST_VOXELS:
        most = f"{MOST_VOXELS // (shape[0] * shape[1])} layers of {config.layer:.3g} on {shape[1]} x {shape[0]} cells"
        raise InputError(f"robot_height: expected at most {most}, got {layers:.6g}.")
    grid = (layers, *shape)
    thickness = (config.robot_height + config.step) / layers
    size = torch.tensor([config.resolution, config.resolution, thickness], dtype=torch.float64)
    low = torch.tensor([*origin, -config.step], dtype=torch.float64)
    start, end = (((ends - low) / size).clamp_min(0) for ends in (band.start, band.end))
    for ends in (start, end):
        ends[:, 2].clamp_(max=layers - 1e-9)  # the top belongs to the last layer
    column, row, layer = end.floor().long().unbind(-1)
    voxel = (layer * shape[0] + row) * shape[1] + column
    evidence = torch.zeros(grid)
    flat = evidence.view(-1)
    order = band.scan.argsort(stable=True)
    sizes = torch.unique_consecutive(band.scan[order], return_counts=True)[1]
    for scan in order.split(sizes.tolist()):
        hit = torch.unique(voxel[scan[band.is_hit[scan]]])
        parts = [cells_crossed(start[part], end[part], grid)[1].unique() for part in scan.split(CHUNK_RAYS)]
        passed = torch.unique(torch.cat(parts))
        passed = passed[~torch.isin(passed, hit)]
        flat[passed] = (flat[passed] + MISS).clamp_min(LEAST)
        flat[hit] = (flat[hit] + HIT).clamp_max(MOST)
    return evidence


def _within(path: Float64[Tensor, "P 2"], shape: tuple[int, int], radius: float) -> Tensor:
    """Return the cells within a distance of a path, all in cells."""
    start, end = (path, path) if len(path) == 1 else (path[:-1], path[1:])
    away = np.ones(shape, np.uint8)
    away.reshape(-1)[cells_crossed(start, end, shape)[1].numpy()] = 0
    distance = cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return torch.from_numpy(distance <= radius)
