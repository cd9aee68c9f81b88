"""The normal equations of the window's unknowns, and the map from an edge's unknowns to them."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.window.calibration import INTRINSICS
from torchvo360.window.state import PER_FRAME, POSE, Estimate

LEAST_CURVATURE = 1e-9
"""Added to every unknown's curvature, so that there is an inverse."""


class PointSystem(NamedTuple):
    """Normal equations of the points, with keyframes where they are."""

    curvature: Float64[Tensor, "N"]
    """Second derivatives by rho."""
    slope: Float64[Tensor, "N"]
    """First derivatives by rho."""
    by_point: Float64[Tensor, "N"]
    """Each point's share of the energy, its prior included."""
    inliers: Float[Tensor, "N"]
    """Images that see the point within their threshold."""
    edges: int
    """How many edges there were."""
    thresholds: Float[Tensor, "K+S"]
    """Of the keyframes, then of the further images."""


class WindowSystem(NamedTuple):
    """Normal equations of all unknowns, and what the energy was made of.

    The unknowns are (v, w, a, b) of each keyframe and then, where they are estimated, (fx, fy, cx, cy).
    """

    H: Float64[Tensor, "D D"]
    g: Float64[Tensor, "D"]
    cross: Float64[Tensor, "N D"]
    """Mixed second derivatives of points and all else."""
    curvature: Float64[Tensor, "N"]
    """Second derivatives by rho."""
    slope: Float64[Tensor, "N"]
    """First derivatives by rho."""
    energy: float
    """Edges beyond their image's threshold count by the threshold."""
    by_point: Float64[Tensor, "N"]
    """Each point's share of it, its prior included."""
    inliers: Float[Tensor, "N"]
    """Images that see the point within their threshold."""
    edges: int
    """How many edges there were."""
    thresholds: Float[Tensor, "K+S"]
    """Of the keyframes, then of the further images."""


def columns(estimate: Estimate, T_cam_world: Float64[Tensor, "K 4 4"]) -> Float64[Tensor, "K K L D"]:
    """Return d(local unknowns of the edge i -> j) / d(all unknowns): I at j, -Ad(T_ji) at i, I at the intrinsics.

    The local ones are (v, w, a, b) of the target with the host at rest, and the intrinsics (mathematics.md, section 6).
    """
    K = T_cam_world.shape[0]
    T_j_i = T_cam_world[None] @ lie.se3_inverse(T_cam_world)[:, None]
    a = estimate.affine[:, 0]
    L = T_cam_world.new_zeros(K, K, PER_FRAME, K, PER_FRAME)
    place = torch.arange(K, device=T_cam_world.device)
    L[:, place, :, place] = torch.eye(PER_FRAME, dtype=L.dtype, device=L.device)
    by_host = L.new_zeros(K, K, PER_FRAME, PER_FRAME)
    by_host[..., :POSE, :POSE] = -lie.se3_adjoint(T_j_i)
    by_host[..., POSE, POSE] = -1
    by_host[..., POSE + 1, POSE + 1] = -(a[None] - a[:, None]).exp()
    L[place, :, :, place] += by_host
    L = L.reshape(K, K, PER_FRAME, K * PER_FRAME)
    if estimate.intrinsics is None:
        return L
    shared = torch.eye(INTRINSICS, dtype=L.dtype, device=L.device).expand(K, K, -1, -1)
    zero_right, zero_left = L.new_zeros(K, K, PER_FRAME, INTRINSICS), L.new_zeros(K, K, INTRINSICS, K * PER_FRAME)
    return torch.cat([torch.cat([L, zero_right], -1), torch.cat([zero_left, shared], -1)], 2)
