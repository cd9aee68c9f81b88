"""Is it the same place, and how do two keyframes lie to each other? Direct Sim(3) alignment, and what it must pass.

After `register` come tests that a chance likeness does not pass: the images agree in both directions, the ranges agree
in both, and either direction by itself ends where both together did.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.alignment import solve_level
from torchvo360.checks import InputError
from torchvo360.loop.config import VerifyConfig
from torchvo360.loop.frame import LoopFrame
from torchvo360.loop.ranges import RangePairs
from torchvo360.loop.register import Registration, register, search_starts
from torchvo360.loop.similarity import Direction, directions
from torchvo360.solve import Status, inverse_ldl

CONSISTENT = 3.0
"""Normalised difference of log-ranges below which two points agree."""
VARIANCE_INFLATION = 4.0
"""By how much H understates the covariance, because residuals of neighbouring pixels and levels are not independent.
Measured on 287 synthetic pairs: xi^T information xi is 2 to 5 in the median and 7 to 12 in 95 of 100, by distance;
seven degrees of freedom have 6.3 and 14."""

NO_SOLUTION = (Status.SINGULAR, Status.TOO_FEW_PIXELS, Status.DIVERGED)


class LoopReason(StrEnum):
    """Why a loop was accepted or not."""

    ACCEPTED = "accepted"
    TOO_FEW_POINTS = "too_few_points"
    NO_ROTATION = "no_rotation"
    NOT_SOLVED = "not_solved"
    IMAGES_DISAGREE = "images_disagree"
    RANGES_DISAGREE = "ranges_disagree"
    TOO_FAR = "too_far"
    DIRECTIONS_DISAGREE = "directions_disagree"


class LoopEvidence(NamedTuple):
    """What speaks for and against a loop."""

    agreement: float = 0.0
    """Share of the gradient that agrees beyond chance, in the worse direction."""
    range_agreement: float = 0.0
    """Share of the points with a neighbour in the other frame whose range agrees, in the worse direction."""
    baseline: float = math.inf
    """Distance between the cameras, in median ranges."""
    turn_deg: float = math.inf
    """Most that one direction by itself turned from the joint solution."""
    shift: float = math.inf
    """Most that it moved from it, in median ranges."""


@dataclass(frozen=True)
class LoopResult:
    """How keyframe B lies to keyframe A."""

    S_b_a: Float64[Tensor, "4 4"]
    """Similarity X_b = S_b_a X_a, each in its frame's own scale; the identity where nothing was found."""
    information: Float64[Tensor, "7 7"]
    """Inverse covariance of xi = (v, w, sigma) in `S_true = exp(xi) S_b_a`; zero where nothing was found."""
    evidence: LoopEvidence
    reason: LoopReason

    @property
    def accepted(self) -> bool:
        """Whether the loop may be closed."""
        return self.reason is LoopReason.ACCEPTED

    @property
    def inliers(self) -> float:
        """Share of the gradient that agrees beyond chance, in the worse direction."""
        return self.evidence.agreement


def verify_loop(a: LoopFrame, b: LoopFrame, config: VerifyConfig | None = None) -> LoopResult:
    """Decide whether two keyframes show one place, and find the similarity between them.

    Args:
        a: A keyframe.
        b: Another of the same camera; it may face any way and be up to about a quarter of the median range away. The
            poses of neither are used.
        config: Settings.

    Returns:
        Always finite; `accepted` says whether it holds, `reason` why not.

    Raises:
        InputError: The frames are of different cameras.
    """
    config = VerifyConfig() if config is None else config
    if a.cameras != b.cameras:
        raise InputError("a, b: expected frames with levels of the same cameras, got different ones.")
    if min(a.rho.numel(), b.rho.numel()) < config.min_points:
        return _nothing(LoopReason.TOO_FEW_POINTS)
    R_b_a, affine = search_starts(a, b, config.rotations)
    if R_b_a.shape[0] == 0:
        return _nothing(LoopReason.NO_ROTATION)
    found = register(a, b, R_b_a, affine, config)
    if found is None:
        return _nothing(LoopReason.IMAGES_DISAGREE)
    evidence = weigh_evidence(found, config)
    information = _information(found, evidence)
    if information is None:
        return _nothing(LoopReason.NOT_SOLVED)
    return LoopResult(found.S_b_a[0].cpu(), information.cpu(), evidence, judge_evidence(evidence, config))


def _information(found: Registration, evidence: LoopEvidence) -> Float64[Tensor, "7 7"] | None:
    """Return the inverse covariance of the similarity; None where the solution is none."""
    equations = found.equations
    covariance, ok = inverse_ldl(equations.H)
    if found.status in NO_SOLUTION or not bool(ok.all()):
        return None
    excess = (equations.square / equations.weight.clamp_min(1.0)).clamp_min(1.0)
    # The brightness is marginalised: the covariance's block, not H's.
    covariance = covariance[0, :7, :7] * (VARIANCE_INFLATION * excess)
    # What one direction alone would have changed is an error that residuals do not show.
    moved = evidence.shift / found.pair.points_b.rho.median().double()
    if math.isfinite(evidence.turn_deg) and math.isfinite(evidence.shift):
        turned = torch.full_like(moved, math.radians(evidence.turn_deg))
        apart = torch.stack([moved] * 3 + [turned] * 3 + [torch.zeros_like(moved)])
        covariance = covariance + torch.diag(apart.square())
    information, ok = inverse_ldl(covariance)
    return information if bool(ok) else None


def _nothing(reason: LoopReason) -> LoopResult:
    eye, zero = torch.eye(4, dtype=torch.float64), torch.zeros(7, 7, dtype=torch.float64)
    return LoopResult(eye, zero, LoopEvidence(), reason)


def weigh_evidence(found: Registration, config: VerifyConfig) -> LoopEvidence:
    """Return what speaks for a registration, on its finest level."""
    agreement, turn, shift, baseline = [], [], [], []
    for way in directions(found.pair, found.S_b_a, found.affine):
        rho = float(way.points.rho.median())
        agreement.append(way.agreement)
        baseline.append(float(torch.linalg.vector_norm(way.T[0, :3, 3])) * rho)
        turned, moved = _alone(way, config)
        turn.append(turned)
        shift.append(moved * rho)
    share = [_consistent_share(ranges) for ranges in found.pair.ranges(found.S_b_a)]
    return LoopEvidence(min(agreement), min(share), max(baseline), max(turn), max(shift))


def _alone(way: Direction, config: VerifyConfig) -> tuple[float, float]:
    """Return by how many degrees and metres a pose changes when one direction is solved by itself."""
    settings = config.align_config(coarsest=False)
    solution = solve_level(way.points, way.image, way.T, way.affine, settings, max_steps=config.max_steps)
    if int(solution.status[0]) in NO_SOLUTION:
        return math.inf, math.inf
    T = solution.state[0][0]
    turned = float(lie.so3_angle(T[:3, :3] @ way.T[0, :3, :3].mT).rad2deg())
    return turned, float(torch.linalg.vector_norm(T[:3, 3] - way.T[0, :3, 3]))


def _consistent_share(ranges: RangePairs) -> float:
    normalised: Float[Tensor, "N"] = (ranges.difference.abs() * ranges.weight.sqrt())[0]
    return float(((normalised < CONSISTENT) & (ranges.weight[0] > 0)).double().mean())


def judge_evidence(evidence: LoopEvidence, config: VerifyConfig) -> LoopReason:
    """Return whether evidence suffices, or the first test that it fails."""
    if not evidence.agreement >= config.min_agreement:
        return LoopReason.IMAGES_DISAGREE
    if not evidence.range_agreement >= config.min_range_agreement:
        return LoopReason.RANGES_DISAGREE
    if not evidence.baseline <= config.max_baseline:
        return LoopReason.TOO_FAR
    if not (evidence.turn_deg <= config.max_turn_deg and evidence.shift <= config.max_shift):
        return LoopReason.DIRECTIONS_DISAGREE
    return LoopReason.ACCEPTED
