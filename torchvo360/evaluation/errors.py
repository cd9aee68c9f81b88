"""Errors of an estimated trajectory: ATE, RPE, drift, rotations and coverage.

ATE is the distance between positions after one alignment of the whole trajectory; RPE and drift compare motions over a
number of poses or a distance, so that an early error is not counted again in every later pose.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import InputError, check_choice, check_finite_number
from torchvo360.data.registration import associate, nearest, rotation_between, similarity_between, time_tolerance_ns
from torchvo360.data.trajectory import Trajectory
from torchvo360.evaluation.relative import Drift, drift, motion_errors, pairs_by_distance, pairs_by_frames, travelled
from torchvo360.evaluation.statistics import Statistics
from torchvo360.lie import so3_angle

NEGLIGIBLE_M = 1e-9
"""Errors below this are rounding, and 0 % of any path: also of one without length."""

SHARES = (0.1, 0.2, 0.3, 0.4, 0.5)
"""Sub-lengths of the drift where none are named, as shares of the true path.

Source: Zhang and Scaramuzza, A tutorial on quantitative trajectory evaluation for visual(-inertial) odometry, 2018.
"""

ALIGNMENTS = ("sim3", "se3", "none")


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
    ate_m: Statistics
    """Distances between aligned and true positions, metres."""
    rpe_frames: int
    """Poses from the beginning to the end of a relative motion."""
    rpe_m: Statistics
    """Errors of the translation over `rpe_frames`, metres."""
    rpe_deg: Statistics
    """Errors of the rotation over `rpe_frames`, degrees."""
    rpe_metres: float
    """True path from the beginning to the end of a relative motion, metres."""
    rpe_metres_m: Statistics | None
    """Errors of the translation over `rpe_metres`, metres; None where no two poses are that far apart."""
    rpe_metres_deg: Statistics | None
    """Errors of the rotation over `rpe_metres`, degrees; None where no two poses are that far apart."""
    drift: Drift
    """Errors over sub-lengths of the path, in proportion to them."""


def evaluate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    align: str = "sim3",
    rpe_frames: int = 10,
    rpe_metres: float | None = None,
    lengths: Sequence[float] | None = None,
) -> Evaluation:
    """Compare an estimate with the truth.

    Poses belong together when each is the other's nearest in time, within half the median time between estimates.

    Args:
        estimate: Poses T_world_cam in any world, unit and scale.
        truth: True poses of the same camera, metres.
        align: What may be chosen to make the positions agree: "sim3" rotation, translation and scale, "se3" no scale,
            "none" nothing; the orientations then are not rotated either. Where the camera or its estimate stands still,
            positions fix neither rotation nor scale: the rotation then comes from the orientations, and the scale is 1.
        rpe_frames: How many compared poses lie between the ends of a relative motion; fewer when there are not as many.
        rpe_metres: Length of the true path between the ends of a relative motion, metres; None for a tenth of it all.
        lengths: Sub-lengths of the true path for the drift, metres; None for 10, 20, 30, 40 and 50 % of it. Those that
            the path does not hold are left out.

    Raises:
        InputError: Fewer than three poses belong together, or an argument is out of range.
    """
    check_choice("align", align, ALIGNMENTS)
    if rpe_frames < 1:
        raise InputError(f"rpe_frames: expected at least 1, got {rpe_frames}.")
    for name, metres in [("rpe_metres", rpe_metres), *(("lengths", length) for length in lengths or ())]:
        if metres is not None:
            check_finite_number(name, metres, above=0.0)
    i_estimate, i_truth = associate(estimate, truth)
    T_estimate, T_truth = estimate.T_world_cam[i_estimate], truth.T_world_cam[i_truth]
    p_estimate, p_truth = T_estimate[:, :3, 3], T_truth[:, :3, 3]
    S, R = torch.eye(4, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    if align != "none":
        S = similarity_between(T_estimate, T_truth, with_scale=align == "sim3")
        R = rotation_between(T_estimate, T_truth)
    scale = float(torch.linalg.det(S[:3, :3]).pow(1 / 3))

    ate_m = _figures(torch.linalg.vector_norm(p_estimate @ S[:3, :3].mT + S[:3, 3] - p_truth, dim=-1))
    R_error = T_truth[:, :3, :3].mT @ R @ T_estimate[:, :3, :3]

    path_m = travelled(p_truth)
    path_length_m = float(path_m[-1])
    over_frames = pairs_by_frames(len(T_truth), rpe_frames)
    error_m, error_deg, moved_m = motion_errors(T_estimate, T_truth, scale, over_frames)
    rpe_metres = path_length_m / 10 if rpe_metres is None else rpe_metres
    over_metres = pairs_by_distance(path_m, rpe_metres)
    metres_error_m, metres_error_deg, _ = motion_errors(T_estimate, T_truth, scale, over_metres)
    if lengths is None:
        lengths = [share * path_length_m for share in SHARES if path_length_m > NEGLIGIBLE_M]
    return Evaluation(
        ate_rmse_m=ate_m.rmse,
        ate_percent=float(_percent(torch.tensor(ate_m.rmse, dtype=torch.float64), path_m[-1])),
        rpe_translation_percent=float(_percent(error_m, moved_m).median()),
        rpe_rotation_deg=float(error_deg.median()),
        rotation_median_deg=math.degrees(float(so3_angle(R_error).median())),
        coverage=_coverage(estimate, truth),
        scale=scale,
        path_length_m=path_length_m,
        pairs=len(i_estimate),
        T_truth_estimate=S,
        ate_m=ate_m,
        rpe_frames=min(rpe_frames, len(T_truth) - 1),
        rpe_m=_figures(error_m),
        rpe_deg=_figures(error_deg),
        rpe_metres=rpe_metres,
        rpe_metres_m=Statistics.of(metres_error_m),
        rpe_metres_deg=Statistics.of(metres_error_deg),
        drift=drift(T_estimate, T_truth, scale, lengths),
    )


def _figures(error: Float64[Tensor, "N"]) -> Statistics:
    figures = Statistics.of(error)
    assert figures is not None  # at least three poses, and so two motions
    return figures


def _percent(error: Float64[Tensor, "*batch"], of: Float64[Tensor, "*batch"]) -> Float64[Tensor, "*batch"]:
    return torch.where(error > NEGLIGIBLE_M, 100 * error / of, 0.0)


def _coverage(estimate: Trajectory, truth: Trajectory) -> float:
    tolerance_ns = time_tolerance_ns(estimate)
    first_ns, last_ns = estimate.t_ns[0] - tolerance_ns, estimate.t_ns[-1] + tolerance_ns
    t_ns = truth.t_ns[(truth.t_ns >= first_ns) & (truth.t_ns <= last_ns)]
    distance_ns = (estimate.t_ns[nearest(t_ns, estimate.t_ns)] - t_ns).abs()
    return float((distance_ns <= tolerance_ns).double().mean())
