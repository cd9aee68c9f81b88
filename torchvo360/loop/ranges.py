"""Ranges of two frames compared: points of one, moved into the other, beside its nearest points.

    e = log rho_moved - log rho_nearest

The logarithm treats both frames alike, and its noise stays what it is under a change of scale.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from torchvo360.backends import are_plain

NEAR_RAD = 0.06
"""Points whose rays are farther apart than this are no neighbours; 3000 points lie 0.065 apart on the sphere."""
SLOPE = 1.0
"""Typical change of a surface's log-range by the angle; adds (SLOPE angle)^2 to the variance of a comparison."""
ROWS_AT_ONCE = 64
"""Points whose neighbours are searched together."""
MIN_RANGE_SIGMA = 0.03
"""Least standard deviation of a difference of log-ranges."""


class RangePoints(NamedTuple):
    """Points of one frame."""

    ray: Float[Tensor, "3 N"]
    """Unit rays."""
    rho: Float[Tensor, "N"]
    """Inverse distances, positive."""
    variance: Float[Tensor, "N"]
    """Of rho."""

    def thinned(self, most: int) -> "RangePoints":
        """Return about `most` of the points, in even steps."""
        step = max(1, self.rho.shape[0] // most)
        return RangePoints(self.ray[:, ::step], self.rho[::step], self.variance[::step])


class RangePairs(NamedTuple):
    """Points moved into another frame beside that frame's nearest points."""

    difference: Float[Tensor, "K N"]
    """log rho of the moved point less that of its neighbour."""
    weight: Float[Tensor, "K N"]
    """Inverse variance of the difference; 0 without a neighbour."""
    J: Float[Tensor, "K N 7"]
    """Derivative of the difference by a left step (v, w, sigma) of the similarity, the neighbour held."""


def pair_ranges(points: RangePoints, near: RangePoints, S_near_points: Float64[Tensor, "K 4 4"]) -> RangePairs:
    """Move points into another frame and compare their log-ranges with those of that frame's nearest points.

    Args:
        points: Points of one frame.
        near: Points of the other.
        S_near_points: K similarities into the other frame.
    """
    S = S_near_points.to(points.ray.dtype)
    Y = S[:, :3, :3] @ points.ray + points.rho * S[:, :3, 3:]
    length = Y.square().sum(1).sqrt().clamp_min(1e-12)
    moved, moved_rho = Y / length[:, None], points.rho / length
    index = _nearest(moved, near.ray)
    # The chord between the rays: 1 - cos loses small angles in float32.
    angle = (moved - near.ray[:, index].movedim(0, 1)).square().sum(1).sqrt()
    difference = moved_rho.log() - near.rho[index].log()
    relative = points.variance / points.rho.square() + (near.variance / near.rho.square())[index]
    spread = relative + (SLOPE * angle).square() + MIN_RANGE_SIGMA**2
    radial = (-moved_rho[:, None] * moved).mT
    J = torch.cat([radial, torch.zeros_like(radial), -torch.ones_like(angle)[..., None]], -1)
    return RangePairs(difference, (angle < NEAR_RAD) / spread, J)


def _nearest(ray: Float[Tensor, "K 3 N"], near: Float[Tensor, "3 M"]) -> Int64[Tensor, "K N"]:
    """Return for each unit ray the nearest of others."""
    if not are_plain(ray, near):
        return (ray.mT @ near).argmax(-1)
    # NumPy searches a row ten times faster than torch, and a few rows at a time stay in the cache.
    K, _, N = ray.shape
    rows, others = ray.mT.reshape(K * N, 3).numpy(), near.numpy()
    index = [(part @ others).argmax(1) for part in np.array_split(rows, max(1, len(rows) // ROWS_AT_ONCE))]
    return torch.from_numpy(np.concatenate(index)).reshape(K, N)
