"""Odometry as edges of a pose graph, and a corrected graph as poses of all frames."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.checks import InputError, check_finite_number, check_pose, check_shape

TURN_SIGMA_RAD = 2e-3
"""Standard deviation of the rotation between neighbouring keyframes."""
SHIFT_SIGMA = 0.02
"""Of the translation, as a share of its length."""
SCALE_SIGMA = 0.02
"""Of the logarithm of the scale: a drift of 1.3 over a loop of a hundred keyframes is then a matter of 1.3 sigma."""


def odometry_information(
    S_j_i: Float64[Tensor, "E 4 4"],
    *,
    turn_sigma_rad: float = TURN_SIGMA_RAD,
    shift_sigma: float = SHIFT_SIGMA,
    scale_sigma: float = SCALE_SIGMA,
) -> Float64[Tensor, "E 7 7"]:
    """Return the information of odometry between neighbouring keyframes.

    The scale of a monocular odometry drifts from keyframe to keyframe, and with it all that follows: that is why it is
    free here, with a deviation of its own. Errors are taken as growing with the distance gone, and as least a
    tenth of the mean distance of these edges: nothing is known exactly, a standing camera's pose neither.

    Args:
        S_j_i: Measured similarities between neighbours, X_j = S_j_i X_i.
        turn_sigma_rad: Standard deviation of a rotation.
        shift_sigma: Of a translation, as a share of its length.
        scale_sigma: Of the logarithm of the scale.
    """
    check_shape("S_j_i", S_j_i, "E 4 4")
    for name, value in (
        ("turn_sigma_rad", turn_sigma_rad),
        ("shift_sigma", shift_sigma),
        ("scale_sigma", scale_sigma),
    ):
        check_finite_number(name, value, above=0)
    length = torch.linalg.vector_norm(S_j_i[:, :3, 3], dim=-1)
    least = 0.1 * length.mean() if len(length) else length.new_zeros(())
    shift = shift_sigma * torch.maximum(length, least).clamp_min(1e-6)
    turn, scale = torch.full_like(shift, turn_sigma_rad), torch.full_like(shift, scale_sigma)
    sigma = torch.stack([shift] * 3 + [turn] * 3 + [scale], -1)
    return torch.diag_embed(sigma.square().reciprocal())


def carry_poses(
    S_world_key: Float64[Tensor, "K 4 4"], key: Int64[Tensor, "F"], T_key_cam: Float64[Tensor, "F 4 4"]
) -> Float64[Tensor, "F 4 4"]:
    """Return T_world_cam of frames that are known by their pose in a keyframe, after the keyframes have been corrected.

    Args:
        S_world_key: Corrected keyframes.
        key: Number of each frame's keyframe.
        T_key_cam: Rigid poses in the keyframes' own, uncorrected scale.

    Returns:
        Rigid motions: the similarity's rotation and scaled translation, a camera having no size.

    Raises:
        ShapeError: Shapes do not match.
        InputError: A keyframe does not exist, or a pose is not rigid.
    """
    sizes = check_shape("S_world_key", S_world_key, "K 4 4")
    check_shape("key", key, f"{T_key_cam.shape[0]}")
    check_pose("T_key_cam", T_key_cam)
    if key.numel() and not 0 <= int(key.min()) <= int(key.max()) < sizes["K"]:
        raise InputError(f"key: expected numbers from 0 to {sizes['K'] - 1}, got others.")
    S_world_cam = S_world_key[key] @ T_key_cam
    scale = torch.linalg.det(S_world_cam[:, :3, :3]).pow(1 / 3)
    return lie.se3_normalized(lie.se3(S_world_cam[:, :3, :3] / scale[:, None, None], S_world_cam[:, :3, 3]))
