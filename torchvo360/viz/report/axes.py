"""The axes in which a page shows a world: x to the right, y ahead, z up, as the first frame stands."""

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.data.trajectory import Trajectory

LEAST_AGREEMENT = 0.3
"""Length of the mean of the cameras' upward directions below which they share none; 1 where all are the same."""

LEAST_AHEAD = 0.1
"""Sine of the angle to the vertical below which a direction does not tell what lies ahead."""


def upright_axes(poses: Trajectory, up: Float64[Tensor, "3"] | None = None) -> Float64[Tensor, "3 3"]:
    """Return R_view_world, whose axes stand upright and look ahead with the first camera.

    Args:
        poses: At least one.
        up: A direction in the world, where it is known; else it is the mean of the cameras' own, or the first one's
            where they have none in common.
    """
    R_world_cam = poses.T_world_cam[:, :3, :3]
    if up is None:
        mean = -R_world_cam[:, :, 1].mean(0)
        up = mean if float(mean.norm()) > LEAST_AGREEMENT else -R_world_cam[0, :, 1]
    up = up / up.norm()
    ahead = R_world_cam[0, :, 2] - (R_world_cam[0, :, 2] @ up) * up
    if float(ahead.norm()) < LEAST_AHEAD:
        ahead = R_world_cam[0, :, 1] - (R_world_cam[0, :, 1] @ up) * up
    ahead = ahead / ahead.norm()
    return torch.stack([torch.linalg.cross(ahead, up), ahead, up])
