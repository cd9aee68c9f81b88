"""Two trajectories of one journey in different worlds: which poses belong together, and the similarity between them."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_shape
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import se3

LEAST_PAIRS = 3
"""Fewer pairs than this leave a similarity undetermined."""

TIME_ROUNDING_NS = 1000
"""Allowance on the tolerance in time: time stamps are often printed with six decimals."""

LEAST_EXTENT = 1e-9
"""Spread of positions about their mean, relative to their distance from the origin, that counts as standing still."""


def time_tolerance_ns(estimate: Trajectory) -> int:
    """Return half the median time between the estimate's poses, in nanoseconds."""
    return int(estimate.t_ns.diff().median()) // 2 + TIME_ROUNDING_NS if len(estimate) > 1 else TIME_ROUNDING_NS


def nearest(t_ns: Int64[Tensor, "N"], among_t_ns: Int64[Tensor, "M"]) -> Int64[Tensor, "N"]:
    """Return, for each time, the index of the nearest one among sorted others; the earlier one in a tie."""
    after = torch.searchsorted(among_t_ns.contiguous(), t_ns.contiguous()).clamp(max=len(among_t_ns) - 1)
    before = (after - 1).clamp(min=0)
    return torch.where(t_ns - among_t_ns[before] <= (among_t_ns[after] - t_ns).abs(), before, after)


def associate(estimate: Trajectory, truth: Trajectory) -> tuple[Int64[Tensor, "P"], Int64[Tensor, "P"]]:
    """Pair poses that are each other's nearest in time, within half the median time between the estimate's poses.

    Returns:
        Indices into the estimate and into the truth, both increasing.

    Raises:
        InputError: Fewer than three pairs.
    """
    i_estimate = i_truth = torch.zeros(0, dtype=torch.int64)
    if len(estimate) and len(truth):
        i_truth = nearest(estimate.t_ns, truth.t_ns)
        i_estimate = torch.arange(len(estimate))
        close = (truth.t_ns[i_truth] - estimate.t_ns).abs() <= time_tolerance_ns(estimate)
        kept = close & (nearest(truth.t_ns, estimate.t_ns)[i_truth] == i_estimate)
        i_estimate, i_truth = i_estimate[kept], i_truth[kept]
    if len(i_truth) < LEAST_PAIRS:
        raise InputError(
            f"truth: expected at least {LEAST_PAIRS} poses at times of the estimate ({_span(estimate)}), "
            f"got {len(i_truth)} ({_span(truth)})."
        )
    return i_estimate, i_truth


def _span(trajectory: Trajectory) -> str:
    if not len(trajectory):
        return "no poses"
    return f"{int(trajectory.t_ns[0]) / 1e9:.3f} s to {int(trajectory.t_ns[-1]) / 1e9:.3f} s"


def similarity_from_points(
    source: Float64[Tensor, "N 3"], target: Float64[Tensor, "N 3"], *, with_scale: bool = True
) -> Float64[Tensor, "4 4"] | None:
    """Return the similarity S with the least squared distance between `S @ source` and `target`.

    Args:
        source: Points in one frame.
        target: The same points in another frame.
        with_scale: False holds the scale at 1.

    Returns:
        The 4 x 4 similarity [s R, t; 0, 1]; None when either set is a single place, which has neither rotation nor
        scale. Points on one line leave the turn about it open, and any is returned.

    Source: Umeyama, Least-squares estimation of transformation parameters between two point patterns, 1991.
    """
    check_shape("source", source, "N 3")
    check_shape("target", target, f"{source.shape[0]} 3")
    source_mean, target_mean = source.mean(0), target.mean(0)
    p, q = source - source_mean, target - target_mean
    for spread, points in ((p, source), (q, target)):
        if float(spread.norm()) <= LEAST_EXTENT * float(points.norm()):
            return None
    R, trace = _best_rotation(q.mT @ p)
    scale = float(trace / (p * p).sum()) if with_scale else 1.0
    return se3(scale * R, target_mean - scale * (R @ source_mean))


def similarity_between(
    T_estimate: Float64[Tensor, "N 4 4"], T_truth: Float64[Tensor, "N 4 4"], *, with_scale: bool = True
) -> Float64[Tensor, "4 4"]:
    """Return the similarity that maps the world of estimated poses into that of the true ones.

    It makes positions agree in the least squares sense. Where either camera stands still, positions fix neither
    rotation nor scale: the rotation then comes from the orientations and the scale is 1.
    """
    p_estimate, p_truth = T_estimate[:, :3, 3], T_truth[:, :3, 3]
    S = similarity_from_points(p_estimate, p_truth, with_scale=with_scale)
    if S is None:
        R = rotation_between(T_estimate, T_truth)
        S = se3(R, p_truth.mean(0) - R @ p_estimate.mean(0))
    return S


def rotation_between(T_estimate: Float64[Tensor, "N 4 4"], T_truth: Float64[Tensor, "N 4 4"]) -> Float64[Tensor, "3 3"]:
    """Return the rotation of the world that makes the orientations agree best: the chordal mean."""
    return _best_rotation((T_truth[:, :3, :3] @ T_estimate[:, :3, :3].mT).sum(0))[0]


def _best_rotation(M: Float64[Tensor, "3 3"]) -> tuple[Float64[Tensor, "3 3"], Float64[Tensor, ""]]:
    """Return the rotation R with the largest `trace(R^T M)`, and that trace."""
    U, singular, Vh = torch.linalg.svd(M)
    sign = torch.ones_like(singular)
    # the nearest orthonormal matrix may be a mirror: turn the weakest axis
    sign[2] = torch.sign(torch.linalg.det(U) * torch.linalg.det(Vh))
    return (U * sign) @ Vh, (singular * sign).sum()
