"""All points of a window as one of its keyframes sees them."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.residuals.direct import look_up_usable
from torchvo360.window.pattern import CENTRE
from torchvo360.window.points import WindowPoints
from torchvo360.window.state import WindowFrame


class Projected(NamedTuple):
    """The points in one keyframe."""

    pixel: Int64[Tensor, "N"]
    """Flat, the nearest in the image."""
    ray: Float[Tensor, "3 N"]
    """Unit rays."""
    rho: Float[Tensor, "N"]
    """Inverse distances."""
    shown: Bool[Tensor, "N"]
    """Whether the point is in view and looks there as it should: neither hidden nor masked."""


def project_points(points: WindowPoints, frames: list[WindowFrame], place: int, max_difference: float) -> Projected:
    """Return where points lie in a keyframe of their window.

    Args:
        points: The points.
        frames: The window's keyframes.
        place: Which of them looks.
        max_difference: Points whose intensity differs by more are hidden.
    """
    viewer = frames[place]
    camera = viewer.target.camera
    T_host_world = torch.stack([frame.T_cam_world for frame in frames])
    T = (viewer.T_cam_world @ lie.se3_inverse(T_host_world)).to(points.rho)[points.host]
    centre = CENTRE if points.ray.shape[2] > 1 else 0
    Y = torch.einsum("nij,jn->in", T[:, :3, :3], points.ray[..., centre]) + points.rho * T[:, :3, 3].T
    inv_length = Y.square().sum(0).clamp_min(1e-24).rsqrt()
    ray, rho = Y * inv_length, points.rho * inv_length
    uv, seen = camera.project(ray.T)
    column = uv[:, 0].long().clamp(0, camera.width - 1)
    row = uv[:, 1].long().clamp(0, camera.height - 1)
    affine = torch.stack([frame.affine for frame in frames]).to(points.rho)[points.host]
    scene = (points.value[:, centre] - affine[:, 1]) * (-affine[:, 0]).exp()
    own = viewer.affine.to(points.rho)
    off = look_up_usable(viewer.target, ray) - (own[0].exp() * scene + own[1])
    # A NaN, where nothing usable is seen, fails the comparison.
    shown = seen & (off.abs() < max_difference) & (points.weight[:, centre] > 0)
    return Projected(row * camera.width + column, ray, rho, shown)
