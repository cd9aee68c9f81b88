"""All points of a window as one of its keyframes sees them; compiled where numba serves, else eager torch."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.backends.numba.arrays import plain
from torchvo360.backends.numba.images import can_see, image_view, look_up_usable
from torchvo360.backends.numba.kernel import kernel
from torchvo360.residuals.direct import Target
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
    T_viewer_host = (viewer.T_cam_world @ lie.se3_inverse(T_host_world)).to(points.rho)
    affine = torch.stack([frame.affine for frame in frames]).to(points.rho)
    centre = CENTRE if points.ray.shape[2] > 1 else 0
    if can_see(viewer.target, also=(points.rho, points.ray, points.value, points.weight)):
        return _project_compiled(points, T_viewer_host, affine, place, viewer.target, centre, max_difference)
    T, affine_of_host = T_viewer_host[points.host], affine[points.host]
    Y = torch.einsum("nij,jn->in", T[:, :3, :3], points.ray[..., centre]) + points.rho * T[:, :3, 3].T
    inv_length = Y.square().sum(0).clamp_min(1e-24).rsqrt()
    ray, rho = Y * inv_length, points.rho * inv_length
    uv, seen = camera.project(ray.T)
    column = uv[:, 0].long().clamp(0, camera.width - 1)
    row = uv[:, 1].long().clamp(0, camera.height - 1)
    scene = (points.value[:, centre] - affine_of_host[:, 1]) * (-affine_of_host[:, 0]).exp()
    own = affine[place]
    off = look_up_usable(viewer.target, ray) - (own[0].exp() * scene + own[1])
    # A NaN, where nothing usable is seen, fails the comparison.
    shown = seen & (off.abs() < max_difference) & (points.weight[:, centre] > 0)
    return Projected(row * camera.width + column, ray, rho, shown)


def _project_compiled(
    points: WindowPoints,
    T_viewer_host: Float[Tensor, "K 4 4"],
    affine: Float[Tensor, "K 2"],
    place: int,
    target: Target,
    centre: int,
    max_difference: float,
) -> Projected:
    pixel, shown = torch.empty_like(points.host), torch.empty_like(points.host, dtype=torch.bool)
    ray, rho = points.ray.new_empty(3, len(points)), torch.empty_like(points.rho)
    kernel("projecting").project(
        plain(points.ray),
        centre,
        *(plain(part) for part in (points.rho, points.host, points.value, points.weight)),
        *(plain(part) for part in (T_viewer_host, affine, affine[place])),
        image_view(target),
        np.float32(max_difference),
        *(part.numpy() for part in (ray, rho, pixel, shown)),
    )
    return Projected(pixel, ray, rho, shown)
