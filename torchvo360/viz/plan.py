"""A map seen from above, like the plan of a floor: which of its points are drawn, and how much of it is seen."""

from dataclasses import dataclass

import numpy as np
import torch

LEVEL_BAND = 0.4
"""Points farther above or below the path than this share of their median distance from it are left out: walls show, the
floor and the ceiling, which would cover them, do not."""

MOST_POINTS = 60_000
"""More than this change the picture little."""

VIEW_QUANTILES = (0.03, 0.97)
"""The points between these, along either axis, are certain to be seen: a few far ones shall not shrink the path."""

MOST_POSITIONS, CHUNK = 300, 1 << 15
"""Positions and, at a time, points between which distances are measured: 80 MB."""


@dataclass(frozen=True)
class Plan:
    """Points of a map as seen from above, at least one."""

    xy: np.ndarray
    """Places on the page, [N, 2]; what comes later lies higher."""
    rgb: np.ndarray
    """Colours, [N, 3], 0 to 1."""

    @property
    def box(self) -> np.ndarray:
        """Opposite corners, [2, 2], of the part that shall be seen."""
        return np.quantile(self.xy, VIEW_QUANTILES, axis=0)

    @property
    def dot_area(self) -> float:
        """Area of a dot, in square points of print: few points are drawn larger."""
        return float(np.clip(30_000 / len(self.xy), 1, 3))


def level_with_path(xyz: np.ndarray, rgb: np.ndarray, path_xyz: np.ndarray) -> Plan | None:
    """Choose the points to be drawn: at about the height of the path near them, and not too many.

    Args:
        xyz: Points, [N, 3]: right and up on the page, height; those that are not finite are left out.
        rgb: Their colours, [N, 3], 0 to 255.
        path_xyz: Positions of the camera in the same axes and unit, at least one.

    Returns:
        None when there is no such point.
    """
    finite = np.isfinite(xyz).all(-1)
    xyz, rgb = xyz[finite], rgb[finite]
    if not len(xyz):
        return None
    level = eye_level(xyz, path_xyz)
    if not level.any():
        return None
    order = _thinned(np.flatnonzero(level)[np.argsort(xyz[level, 2])], MOST_POINTS)
    return Plan(xyz[order, :2], rgb[order] / 255)


def eye_level(xyz: np.ndarray, path_xyz: np.ndarray) -> np.ndarray:
    """Return, [N], whether each point lies at about the height of the path near it.

    Args:
        xyz: Finite points, [N, 3], the last axis upwards.
        path_xyz: Positions of the camera in the same axes and unit, at least one.
    """
    if not len(xyz):
        return np.zeros(0, bool)
    path = torch.from_numpy(_thinned(path_xyz, MOST_POSITIONS))
    parts = [torch.cdist(part, path).min(-1) for part in torch.from_numpy(xyz).split(CHUNK)]
    distance, nearest = (torch.cat(column) for column in zip(*parts, strict=True))
    return np.abs(xyz[:, 2] - path[nearest, 2].numpy()) <= LEVEL_BAND * float(distance.median())


def _thinned(rows: np.ndarray, most: int) -> np.ndarray:
    """Return every n-th row, n the least number that leaves no more than these."""
    return rows[:: -(-len(rows) // most)]
