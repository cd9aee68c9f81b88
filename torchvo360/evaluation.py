"""How far an estimated trajectory lies from the true one: ATE, RPE, rotations and coverage.

ATE is the distance between positions after one similarity for the whole trajectory; RPE compares motions over a fixed
number of frames, so that an early error is not counted again in every later frame.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import InputError, check_choice
from torchvo360.data.registration import associate, nearest, rotation_between, similarity_between, time_tolerance_ns
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import se3_inverse, so3_angle

NEGLIGIBLE_M = 1e-9
"""Errors below this are rounding, and 0 % of any path: also of one without length."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Errors of an estimate, over the poses that have a true one at their time.

    A percentage of a true path without length is infinite, or 0 where the error is below a nanometre.
    """

    ate_rmse_m: float
    """Root mean square distance between aligned and true positions, metres of the true world."""
    ate_percent: float
    """The same in percent of the true path."""
    rpe_translation_percent: float
    """Median error of the translation over `rpe_frames`, in percent of the true distance moved meanwhile."""
    rpe_rotation_deg: float
    """Median error of the rotation over `rpe_frames`, degrees."""
    rotation_median_deg: float
    """Median error of the orientation after the best constant rotation of the world, degrees."""
    coverage: float
    """Share, 0 to 1, of the true poses between the estimate's first and last time that have an estimate."""
    scale: float
    """Metres of the true world per unit of the estimate."""
    path_length_m: float
    """Length of the true path through the compared poses."""
    pairs: int
    """Number of compared poses."""
    T_truth_estimate: Float64[Tensor, "4 4"]
    """Similarity that maps the estimate's world into the true one."""


def evaluate(estimate: Trajectory, truth: Trajectory, *, align: str = "sim3", rpe_frames: int = 10) -> Evaluation:
    """Compare an estimate with the truth.

    Poses belong together when each is the other's nearest in time, within half the median time between estimates.

    Args:
        estimate: Poses T_world_cam in any world, unit and scale.
        truth: True poses of the same camera, metres.
        align: What may be chosen to make the positions agree: "sim3" rotation, translation and scale, "se3" no scale,
            "none" nothing; the orientations then are not rotated either. Where the camera or its estimate stands still,
            positions fix neither rotation nor scale: the rotation then comes from the orientations, and the scale is 1.
        rpe_frames: How many compared poses lie between the ends of a relative motion; fewer when there are not as many.

    Raises:
        InputError: Fewer than three poses belong together, or an argument is out of range.
    """
    check_choice("align", align, ("sim3", "se3", "none"))
    if rpe_frames < 1:
        raise InputError(f"rpe_frames: expected at least 1, got {rpe_frames}.")
    i_estimate, i_truth = associate(estimate, truth)
    T_estimate, T_truth = estimate.T_world_cam[i_estimate], truth.T_world_cam[i_truth]
    p_estimate, p_truth = T_estimate[:, :3, 3], T_truth[:, :3, 3]
    S, R = torch.eye(4, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    if align != "none":
        S = similarity_between(T_estimate, T_truth, with_scale=align == "sim3")
        R = rotation_between(T_estimate, T_truth)
    scale = float(torch.linalg.det(S[:3, :3]).pow(1 / 3))

    error_m = torch.linalg.vector_norm(p_estimate @ S[:3, :3].mT + S[:3, 3] - p_truth, dim=-1)
    ate_rmse_m = error_m.square().mean().sqrt()
    path_length_m = torch.linalg.vector_norm(p_truth.diff(dim=0), dim=-1).sum()
    R_error = T_truth[:, :3, :3].mT @ R @ T_estimate[:, :3, :3]
    rpe_translation_percent, rpe_rotation_deg = _relative_errors(T_estimate, T_truth, scale, rpe_frames)
    return Evaluation(
        ate_rmse_m=float(ate_rmse_m),
        ate_percent=float(_percent(ate_rmse_m, path_length_m)),
        rpe_translation_percent=rpe_translation_percent,
        rpe_rotation_deg=rpe_rotation_deg,
        rotation_median_deg=math.degrees(float(so3_angle(R_error).median())),
        coverage=_coverage(estimate, truth),
        scale=scale,
        path_length_m=float(path_length_m),
        pairs=len(i_estimate),
        T_truth_estimate=S,
    )


def _relative_errors(
    T_estimate: Float64[Tensor, "N 4 4"], T_truth: Float64[Tensor, "N 4 4"], scale: float, frames: int
) -> tuple[float, float]:
    """Return the median errors of relative motions: translation in percent of the distance, rotation in degrees."""
    frames = min(frames, len(T_truth) - 1)
    true = se3_inverse(T_truth[:-frames]) @ T_truth[frames:]
    estimated = se3_inverse(T_estimate[:-frames]) @ T_estimate[frames:]
    rotation_deg = so3_angle(true[:, :3, :3].mT @ estimated[:, :3, :3]).rad2deg()
    error_m = torch.linalg.vector_norm(scale * estimated[:, :3, 3] - true[:, :3, 3], dim=-1)
    moved_m = torch.linalg.vector_norm(true[:, :3, 3], dim=-1)
    return float(_percent(error_m, moved_m).median()), float(rotation_deg.median())


def _percent(error: Float64[Tensor, "*batch"], of: Float64[Tensor, "*batch"]) -> Float64[Tensor, "*batch"]:
    return torch.where(error > NEGLIGIBLE_M, 100 * error / of, 0.0)


def _coverage(estimate: Trajectory, truth: Trajectory) -> float:
    tolerance_ns = time_tolerance_ns(estimate)
    first_ns, last_ns = estimate.t_ns[0] - tolerance_ns, estimate.t_ns[-1] + tolerance_ns
    t_ns = truth.t_ns[(truth.t_ns >= first_ns) & (truth.t_ns <= last_ns)]
    distance_ns = (estimate.t_ns[nearest(t_ns, estimate.t_ns)] - t_ns).abs()
    return float((distance_ns <= tolerance_ns).double().mean())
