"""How far each pose lies from the true one, after the alignment that fits the whole trajectory best."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.data.registration import associate, rotation_between, similarity_between
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import so3_angle


@dataclass(frozen=True, eq=False)
class Deviation:
    """Errors of the poses that have a true one at their time."""

    row: Int64[Tensor, "P"]
    """Which poses of the estimate, increasing."""
    position_m: Float64[Tensor, "P"]
    """Distance between aligned and true position, metres of the true world."""
    rotation_deg: Float64[Tensor, "P"]
    """Angle between the orientations after the best constant rotation of the world, degrees."""
    S_truth_world: Float64[Tensor, "4 4"]
    """Similarity that maps the estimate's world into the true one."""


def deviation(estimate: Trajectory, truth: Trajectory) -> Deviation:
    """Compare every pose with the true one, as ATE and the orientations' median do.

    Args:
        estimate: Poses T_world_cam in any world and unit.
        truth: True poses of the same camera, metres.

    Raises:
        InputError: Fewer than three poses belong together.
    """
    row, true_row = associate(estimate, truth)
    T_estimate, T_truth = estimate.T_world_cam[row], truth.T_world_cam[true_row]
    S = similarity_between(T_estimate, T_truth)
    R = rotation_between(T_estimate, T_truth)
    aligned = T_estimate[:, :3, 3] @ S[:3, :3].mT + S[:3, 3]
    return Deviation(
        row=row,
        position_m=torch.linalg.vector_norm(aligned - T_truth[:, :3, 3], dim=-1),
        rotation_deg=so3_angle(T_truth[:, :3, :3].mT @ R @ T_estimate[:, :3, :3]).rad2deg(),
        S_truth_world=S,
    )
