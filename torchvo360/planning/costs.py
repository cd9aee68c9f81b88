"""What each cell costs a robot: no way near obstacles, a dearer way beside them."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from torchvo360.mapping import OCCUPIED, UNKNOWN, OccupancyMap
from torchvo360.planning.config import PlanConfig

LEAST_MARGIN = 1e-30
"""A smaller one is none, and has no inverse in single precision."""


@dataclass(frozen=True, eq=False)
class Clearance:
    """A map as a robot sees it."""

    distance: Float32[np.ndarray, "H W"]
    """From each cell's middle to the nearest obstacle's edge, in the map's unit; inf where there is none."""
    weight: Float32[np.ndarray, "H W"]
    """Cost of a way through a cell per unit of its length, at least 1; inf where the robot does not fit."""


def clearance_of(occupancy: OccupancyMap, config: PlanConfig) -> Clearance:
    """Return the distance to obstacles, and the cost that follows from it.

    Half a cell is taken off the distance between cells' middles: an obstacle reaches to its cell's edge. With
    `unknown=blocked` cells that were not seen are obstacles, and so is what lies outside the map.
    """
    states = occupancy.states.numpy()
    blocked = states == OCCUPIED
    if outside := config.unknown == "blocked":
        blocked = blocked | (states == UNKNOWN)
    padded = np.pad(blocked, 1, constant_values=outside)
    cells = cv2.distanceTransform((~padded).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    distance = np.float32(occupancy.resolution) * np.maximum(cells - np.float32(0.5), 0)
    if not padded.any():
        distance[:] = np.inf
    weight = np.ones(states.shape, np.float32)
    if config.margin > 0 and config.clearance_weight > 0:
        near = 1 - (distance - np.float32(config.robot_radius)) * np.float32(1 / max(config.margin, LEAST_MARGIN))
        np.clip(near, 0, 1, out=near)
        weight += np.float32(config.clearance_weight) * (near * near)  # its slope ends at 0, where the margin does
    if not outside and config.unknown_weight > 0:
        weight[states == UNKNOWN] += np.float32(config.unknown_weight)
    weight[blocked | (distance < config.robot_radius)] = np.inf
    return Clearance(distance, weight)
