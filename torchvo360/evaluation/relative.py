"""Errors of relative motions: over a number of poses, over a distance, and over sub-lengths of the path.

With true and estimated motions `T_i_j`, the error is `E = inv(T_true) T_estimated`: its translation in metres, its
rotation as an angle. An early error is so not counted again in every later pose. All motions of a kind are one batch.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.lie import se3_inverse, so3_angle

Pairs = tuple[Int64[Tensor, "P"], Int64[Tensor, "P"]]
"""Indices of the poses at the beginning and at the end of each motion."""

TOLERANCE = 0.1
"""Share of a distance by which the path between two poses may differ from it.

Source: evo's `rel_delta_tol`.
"""


@dataclass(frozen=True, eq=False)
class Drift:
    """Errors over sub-lengths of the path that begin at every pose, in proportion to the length.

    Source: Geiger et al., Are we ready for autonomous driving? The KITTI vision benchmark suite, 2012 (its development
    kit, evaluate_odometry.cpp, begins at every tenth pose).
    """

    length_m: Float64[Tensor, "L"]
    """The sub-lengths that the path holds, metres; there may be none."""
    translation_percent: Float64[Tensor, "L"]
    """Mean error of the translation over each, in percent of it."""
    rotation_deg_per_m: Float64[Tensor, "L"]
    """Mean error of the rotation over each, degrees a metre."""
    count: Int64[Tensor, "L"]
    """How many motions of each length there are."""

    @property
    def mean_translation_percent(self) -> float | None:
        """Mean over all motions of all lengths; None where there is none."""
        return _weighted_mean(self.translation_percent, self.count)

    @property
    def mean_rotation_deg_per_m(self) -> float | None:
        """Mean over all motions of all lengths; None where there is none."""
        return _weighted_mean(self.rotation_deg_per_m, self.count)


def travelled(position: Float64[Tensor, "N 3"]) -> Float64[Tensor, "N"]:
    """Return the length of the path from the first position to each."""
    steps = torch.linalg.vector_norm(position.diff(dim=0), dim=-1)
    return torch.cat([steps.new_zeros(1), steps.cumsum(0)])


def pairs_by_frames(count: int, frames: int) -> Pairs:
    """Return all pairs of poses with this many from one to the other; fewer where there are not as many."""
    i = torch.arange(count - min(frames, count - 1))
    return i, i + min(frames, count - 1)


def pairs_by_distance(path_m: Float64[Tensor, "N"], metres: float) -> Pairs:
    """Return for every pose the later one that lies nearest to this much further on the path, within a tenth of it.

    Args:
        path_m: Length of the path from the first pose to each.
        metres: Length from one to the other.
    """
    i = torch.arange(len(path_m) - 1)
    target = path_m[i] + metres
    above = torch.searchsorted(path_m, target).clamp(max=len(path_m) - 1)
    # the first of those that stand at the place before
    below = torch.searchsorted(path_m, path_m[(above - 1).clamp(min=0)])
    above, below = torch.maximum(above, i + 1), torch.maximum(below, i + 1)
    j = torch.where((path_m[below] - target).abs() <= (path_m[above] - target).abs(), below, above)
    moved_m = path_m[j] - path_m[i]
    kept = (moved_m > 0) & ((moved_m - metres).abs() <= TOLERANCE * metres)
    return i[kept], j[kept]


def motion_errors(
    T_estimate: Float64[Tensor, "N 4 4"], T_truth: Float64[Tensor, "N 4 4"], scale: float, pairs: Pairs
) -> tuple[Float64[Tensor, "P"], Float64[Tensor, "P"], Float64[Tensor, "P"]]:
    """Compare motions between poses.

    Args:
        T_estimate: Estimated poses T_world_cam.
        T_truth: True poses T_world_cam, metres.
        scale: Metres per unit of the estimate.
        pairs: Which motions.

    Returns:
        error_m: Errors of the translations, metres.
        error_deg: Errors of the rotations, degrees.
        moved_m: True distances between the positions, metres.
    """
    i, j = pairs
    true = se3_inverse(T_truth[i]) @ T_truth[j]
    estimated = se3_inverse(T_estimate[i]) @ T_estimate[j]
    error_m = torch.linalg.vector_norm(scale * estimated[:, :3, 3] - true[:, :3, 3], dim=-1)
    error_deg = so3_angle(true[:, :3, :3].mT @ estimated[:, :3, :3]).rad2deg()
    return error_m, error_deg, torch.linalg.vector_norm(true[:, :3, 3], dim=-1)


def drift(
    T_estimate: Float64[Tensor, "N 4 4"], T_truth: Float64[Tensor, "N 4 4"], scale: float, length_m: Sequence[float]
) -> Drift:
    """Measure errors over sub-lengths of the true path; each ends at the first pose beyond its length."""
    path_m = travelled(T_truth[:, :3, 3])
    length = torch.tensor(length_m, dtype=torch.float64)
    end = torch.searchsorted(path_m, (path_m + length[:, None]).flatten(), right=True)
    which, begin = torch.meshgrid(torch.arange(len(length)), torch.arange(len(path_m)), indexing="ij")
    kept = end < len(path_m)
    which, pairs = which.flatten()[kept], (begin.flatten()[kept], end[kept])
    error_m, error_deg, _ = motion_errors(T_estimate, T_truth, scale, pairs)
    count = torch.bincount(which, minlength=len(length))
    held = count > 0

    def mean(error: Float64[Tensor, "P"]) -> Float64[Tensor, "L"]:
        total = torch.zeros_like(length).index_add(0, which, error / length[which])
        return total[held] / count[held]

    return Drift(length[held], mean(100 * error_m), mean(error_deg), count[held])


def _weighted_mean(value: Float64[Tensor, "L"], count: Int64[Tensor, "L"]) -> float | None:
    return float((value * count).sum() / count.sum()) if len(count) else None
