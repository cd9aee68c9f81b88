"""Tracking: a frame's pose against a keyframe's points, from a batch of hypotheses, coarse to fine."""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.agreement import share_beyond_chance
from torchvo360.alignment import AlignConfig, PosePrior, solve_level
from torchvo360.backends import compare
from torchvo360.checks import InputError, check_finite_number
from torchvo360.depth import InverseRange
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import LMConfig, inverse_ldl
from torchvo360.vo.frame import PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe, KeyPoints

WORST, BEST = -3.0, 2.0
"""Bounds of a tracked point's score: a frame that does not show it takes 1, one that does gives half."""


@dataclass(kw_only=True)
class TrackConfig:
    """Settings of tracking."""

    points_by_level: list[int] = field(default_factory=lambda: [3000, 3000, 1500, 800])
    """Most points at each level, the finest first; the last entry serves all coarser ones."""
    steps_by_level: list[int] = field(default_factory=lambda: [12, 12, 12, 10])
    noise: float = 4 / 255
    """Standard deviation of an intensity, against which the variance of inverse ranges is weighed."""
    huber: float = 7.4 / 255
    """Residual at which the cost turns linear."""
    cutoff: float = 34 / 255
    """Residuals beyond this weigh nothing, but on the coarsest level all count."""
    solver: LMConfig = field(default_factory=lambda: LMConfig(cost_tolerance=1e-3, step_tolerance=0.05))
    min_points: int = 60
    """Fewer trusted points cannot be tracked."""

    def __post_init__(self) -> None:
        for name in ("points_by_level", "steps_by_level"):
            values = getattr(self, name)
            if not values or min(values) < 1:
                raise InputError(f"{name}: expected positive numbers, got {values}.")
        for name in ("noise", "huber", "cutoff"):
            check_finite_number(name, getattr(self, name), above=0)
        if self.min_points < 8:
            raise InputError(f"min_points: expected at least 8, got {self.min_points}.")

    def align_config(self, coarsest: bool) -> AlignConfig:
        """Return the settings of one level's solve."""
        loss = LossConfig(scale=self.huber, cutoff=None if coarsest else self.cutoff)
        return AlignConfig(loss=loss, noise=self.noise, solver=self.solver, min_pixels=self.min_points // 2)


class Track(NamedTuple):
    """Where a frame was found."""

    T_cam_key: Float64[Tensor, "4 4"]
    affine: Float64[Tensor, "2"]
    residual: float
    inliers: float
    covariance: Float64[Tensor, "6 6"]
    """Of the pose's left error (v, w), by the alignment's own residuals; infinite where it does not tell."""
    steps: int = 0
    """Accepted and refused steps of the solver over all levels, of the hypothesis that won."""


def _thinned(index: Int64[Tensor, "N"], count: int) -> Int64[Tensor, "M"]:
    """Return `count` of the indices in even steps: pixels are in order, so that they stay spread over the sphere."""
    if index.numel() <= count:
        return index
    return index[torch.arange(count, device=index.device) * index.numel() // count]


def _references(key: KeyPoints, usable: Int64[Tensor, "N"], counts: list[int]) -> list[Reference]:
    """Return some of a keyframe's points for each level, the finest first, at most so many; batch 1."""
    chosen: dict[int, tuple[Tensor, Reference]] = {}
    references = []
    for value, most in zip(key.values, counts, strict=True):
        count = min(most, usable.numel())
        if count not in chosen:
            index = _thinned(usable, count)
            chosen[count] = index, _reference(key, key.values[0], index)
        index, points = chosen[count]
        references.append(replace(points, value=value[index][None, None]))
    return references


def _reference(key: KeyPoints, value: Float[Tensor, "N"], index: Int64[Tensor, "M"] | None = None) -> Reference:
    """Return a keyframe's points, or some of them, as the alignment takes them; batch 1."""
    ray, rho, variance = key.ray, key.points.rho, key.points.variance
    if index is not None:
        ray, rho, variance, value = ray[:, index], rho[index], variance[index], value[index]
    # Points are equal-area already: a further weight by solid angle would count it twice.
    return Reference(ray[None], rho[None], value[None, None], torch.ones_like(rho)[None], variance[None])


def _repeated(reference: Reference, target: Target, B: int) -> tuple[Reference, Target]:
    """Return points and an image for B poses."""
    if B == 1:
        return reference, target
    every = torch.zeros(B, dtype=torch.int64, device=reference.rho.device)
    return reference.take(every), target.take(every)


def track(
    key: KeyPoints,
    frame: PyramidFrame,
    T_cam_key: Float64[Tensor, "K 4 4"],
    affine: Float64[Tensor, "2"],
    config: TrackConfig,
    max_relative_variance: float,
    prior: PosePrior | None = None,
) -> Track | None:
    """Find a frame's pose against a keyframe.

    All hypotheses are solved together on the coarsest level; the best goes on to the finer ones.

    Args:
        key: The keyframe.
        frame: The frame.
        T_cam_key: Hypotheses.
        affine: Brightness (a, b) to start from.
        config: Settings.
        max_relative_variance: Points with V / rho^2 below this are used.
        prior: What is known of the pose besides, a batch of one.

    Returns:
        The track, or None where the keyframe has too few points or no solve succeeded.
    """
    usable = key.trusted(max_relative_variance).nonzero()[:, 0]
    if usable.numel() < config.min_points:
        return None
    device = key.ray.device
    T, ab = T_cam_key.to(device), affine.to(device).expand(T_cam_key.shape[0], 2)
    levels, taken = len(frame.targets), 0
    counts = [config.points_by_level[min(level, len(config.points_by_level) - 1)] for level in range(levels)]
    references = _references(key, usable, counts)
    covariance = torch.full((6, 6), torch.inf, dtype=torch.float64)
    for level in range(levels - 1, -1, -1):
        steps = config.steps_by_level[min(level, len(config.steps_by_level) - 1)]
        B = T.shape[0]
        reference, target = _repeated(references[level], frame.targets[level], B)
        known = None if prior is None else PosePrior(*(part.to(device).expand(B, -1, -1) for part in prior))
        align_config = config.align_config(level == levels - 1)
        solution = solve_level(reference, target, T, ab, align_config, max_steps=steps, prior=known)
        cost = solution.equations.cost / solution.equations.weight
        best = int(cost.nan_to_num(nan=torch.inf).argmin()) if B > 1 else 0
        if not math.isfinite(float(cost[best])):
            return None
        T, ab = solution.state[0][best : best + 1], solution.state[1][best : best + 1]
        taken += int(solution.steps[best])
        if level == 0:
            covariance = _covariance(solution.equations, best)
    T_best, ab_best = lie.se3_normalized(T[0]).to(T_cam_key.device), ab[0].to(affine.device)
    found = _measured(references[0], frame, T_best, ab_best)
    return found._replace(covariance=covariance.to(T_cam_key.device), steps=taken)


def _covariance(equations: NormalEquations, element: int) -> Float64[Tensor, "6 6"]:
    """Return the pose's covariance, s^2 H^-1 with the brightness eliminated (mathematics.md, section 7)."""
    inverse, ok = inverse_ldl(equations.H[element])
    variance = equations.square[element] / (equations.weight[element] - 8).clamp_min(1)
    return torch.where(ok, inverse[:6, :6] * variance, torch.inf)


def measure_keyframe(key: Keyframe, config: TrackConfig, max_relative_variance: float) -> Track:
    """Return a keyframe as it tracks itself."""
    index = key.trusted(max_relative_variance).nonzero()[:, 0]
    eye, none = torch.eye(4, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    reference = _reference(key, key.values[0], _thinned(index, config.points_by_level[0]))
    return _measured(reference, key.frame, eye, none)


def judge_points(key: KeyPoints, frame: PyramidFrame, found: Track, max_difference: float) -> None:
    """Mark a keyframe's points up or down by how a tracked frame shows them: what moves or is hidden loses its say.

    Args:
        key: The keyframe; its points' scores are changed.
        frame: The frame.
        found: Where it was found.
        max_difference: Intensities that differ by more than this, and by three median differences, do not fit.
    """
    rho, variance, score = key.points
    T, ab = found.T_cam_key[None].to(rho.device), found.affine[None].to(rho.device)
    met = compare(_reference(key, key.values[0]), frame.targets[0], T, ab)
    off, seen = met.residual[0, 0].abs(), met.weight[0, 0] > 0
    used = seen & (score > 0)
    usual = float(off[used].median()) if bool(used.any()) else 0.0
    change = torch.where(off > max(max_difference, 3 * usual), -1.0, 0.5)
    key.points = InverseRange(rho, variance, (score + change * seen).clamp(WORST, BEST))


def _measured(
    reference: Reference, frame: PyramidFrame, T_cam_key: Float64[Tensor, "4 4"], affine: Float64[Tensor, "2"]
) -> Track:
    """Return a pose with its mean absolute residual and its agreement on the finest level."""
    device = reference.rho.device
    met = compare(reference, frame.targets[0], T_cam_key[None].to(device), affine[None].to(device))
    residual = float((met.residual.abs() * met.weight).sum() / met.weight.sum().clamp_min(1e-9))
    # Beyond chance: in an unrelated image of strong contrast a gain of zero explains most of the gradient.
    inliers = float(share_beyond_chance(met)[0])
    return Track(T_cam_key, affine, residual, inliers, torch.full((6, 6), torch.inf, dtype=torch.float64))
