"""Rotation between two panoramas without any depth: a global search over SO(3), refined by direct alignment.

At 64 x 32 pixels the whole group costs one batched look-up of about a thousand rotations; the best few are refined.
"""

import functools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360 import lie, pairs
from torchvo360.agreement import agreeing_share
from torchvo360.backends import linearize, numba, use_numba
from torchvo360.image import sample
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import LMConfig, Solution, minimize

ROTATION_AND_BRIGHTNESS = (False, False, False, True, True, True, True, True)
REFINED = 6
"""Candidates of the global search that are refined."""
SCORED_POINTS = 500
"""Points of the reference, evenly thinned, by which the grid's rotations are ranked."""
MAX_LOG_GAIN = 10.0
"""Exposures differ by less than e to this power."""


@dataclass(frozen=True)
class RotationResult:
    """Rotations R_tgt_ref, the one of lowest robust cost first."""

    R_tgt_ref: Float[Tensor, "K 3 3"]
    affine: Float[Tensor, "K 2"]
    """Brightness (a, b)."""
    cost: Float[Tensor, "K"]
    agreement: Float[Tensor, "K"]
    """Share of the gradient that is matched to within half a pixel, 0 to 1."""


@functools.lru_cache(maxsize=4)
@torch.inference_mode(False)
def rotation_grid(step_rad: float) -> Float[Tensor, "M 3 3"]:
    """Cover SO(3): every rotation is within about `step_rad` of one of these.

    Directions spread evenly over the sphere by a golden spiral, each with equal steps of roll about it.
    """
    directions = max(1, round(4 * math.pi / step_rad**2))
    k = torch.arange(directions, dtype=torch.float64)
    height = 1 - (2 * k + 1) / directions
    lon = k * (math.pi * (3 - math.sqrt(5)))
    # The rotation that takes the vertical axis to each direction by the shortest way.
    angle = torch.acos(height)
    axis = torch.stack([lon.cos(), torch.zeros_like(lon), -lon.sin()], -1)
    tilt = lie.so3_exp(axis * angle[:, None])
    rolls = max(1, round(math.tau / step_rad))
    roll = torch.arange(rolls, dtype=torch.float64) * (math.tau / rolls)
    about = lie.so3_exp(torch.stack([torch.zeros_like(roll), roll, torch.zeros_like(roll)], -1))
    return (tilt[:, None] @ about).flatten(0, 1)


def align_rotation(
    reference: Reference,
    target: Target,
    R_tgt_ref: Float[Tensor, "K 3 3"],
    *,
    max_steps: int = 30,
    loss: LossConfig | None = None,
) -> RotationResult:
    """Refine rotations and brightness from K starts in one batch; the points are taken at infinity.

    Args:
        reference: Points of one reference (batch 1).
        target: One target image (batch 1).
        R_tgt_ref: Starts, float64.
        max_steps: Most steps of the solver.
        loss: The robust loss.
    """
    K = R_tgt_ref.shape[0]
    loss = LossConfig() if loss is None else loss
    points = Reference(reference.ray, torch.zeros_like(reference.rho), reference.value, reference.weight).repeated(K)
    images = target.repeated(K)
    T, affine = lie.se3(R_tgt_ref, R_tgt_ref.new_zeros(K, 3)), R_tgt_ref.new_zeros(K, 2)
    solution = _solve(points, images, T, affine, loss, LMConfig(max_steps=max_steps, cost_tolerance=1e-4))
    cost = solution.equations.cost / solution.equations.weight.clamp_min(1e-9)
    order = cost.argsort(stable=True)
    T, affine = (part[order] for part in solution.state)
    return RotationResult(T[:, :3, :3], affine, cost[order], agreeing_share(points, images, T, affine))


def _solve(
    points: Reference,
    images: Target,
    T_tgt_ref: Float64[Tensor, "K 4 4"],
    affine: Float64[Tensor, "K 2"],
    loss: LossConfig,
    config: LMConfig,
) -> Solution:
    """Estimate rotations and brightness of points at infinity: compiled where it serves, else in steps of torch."""
    free = torch.tensor(ROTATION_AND_BRIGHTNESS, device=T_tgt_ref.device)
    if pairs.serves(points, images, T_tgt_ref, affine):
        return pairs.solve(
            points,
            images,
            T_tgt_ref,
            affine,
            loss,
            config,
            noise=1.0,
            free=free,
            min_weight=1.0,
            prior=None,
            max_translation=math.inf,
            max_log_gain=MAX_LOG_GAIN,
        )

    def evaluate(state: tuple[Tensor, ...], active: Tensor) -> NormalEquations:
        T, affine = state
        return linearize(points.take(active), images.take(active), T, affine, loss)

    def retract(state: tuple[Tensor, ...], delta: Tensor) -> tuple[Tensor, ...]:
        return lie.se3_exp(delta[:, :6]) @ state[0], state[1] + delta[:, 6:]

    def is_sensible(state: tuple[Tensor, ...]) -> Tensor:
        return state[1][:, 0].abs() < MAX_LOG_GAIN

    per_radian = 1 / images.camera.pixel_angle
    scale = affine.new_tensor([0.0] * 3 + [per_radian] * 3 + [1.0] * 2).expand(len(affine), -1)
    start = (T_tgt_ref, affine)
    return minimize(evaluate, retract, start, config, step_scale=scale, free=free, min_weight=1.0, sensible=is_sensible)


def search_rotation(
    reference: Reference,
    target: Target,
    grid: Float[Tensor, "M 3 3"],
    *,
    refined: int = REFINED,
) -> RotationResult:
    """Find the rotation between two small panoramas wherever it is on SO(3).

    Every grid rotation is scored by the normalised cross-correlation of the images, and the best are refined.

    Args:
        reference: Points of the reference (batch 1), for instance all pixels of a 64 x 32 level.
        target: The target image (batch 1) of that level.
        grid: Rotations R_tgt_ref to try, for instance `rotation_grid(0.43)`.
        refined: How many of the best are refined.
    """
    best = _correlation(reference, target, grid).topk(min(refined, grid.shape[0])).indices
    return align_rotation(reference, target, grid[best])


def _correlation(reference: Reference, target: Target, grid: Float[Tensor, "M 3 3"]) -> Float[Tensor, "M"]:
    """Return the normalised cross-correlation of some of the reference's points with the target, by rotation."""
    stride = max(1, reference.rho.shape[1] // SCORED_POINTS)
    ray, value, weight = (part[..., ::stride] for part in (reference.ray, reference.value, reference.weight))
    some = Reference(ray, torch.zeros_like(weight), value, weight)
    T = lie.se3(grid.double(), grid.new_zeros(len(grid), 3).double())
    if target.camera.wraps and value.shape[1] == 1 and use_numba(T) and numba.serves(some, target, T, T):
        return numba.correlate_rotations(some, target, T)
    directions = torch.einsum("mij,jn->mni", grid.to(value), ray[0])
    inside = target.padded[..., 1:-1, 1:-1]
    found = sample(inside, target.camera.pixel(directions).flatten(0, 1)[None], target.camera)[0, 0]
    found = found.view(grid.shape[0], -1)
    weight = weight / weight.sum().clamp_min(1e-9)
    centred = value[0, :1] - (weight * value[0, :1]).sum()
    found = found - (weight * found).sum(-1, keepdim=True)
    spread = (weight * found.square()).sum(-1) * (weight * centred.square()).sum()
    return (weight * found * centred).sum(-1) / spread.clamp_min(1e-12).sqrt()


def fit_rotation(
    ref: Float[Tensor, "N 3"], tgt: Float[Tensor, "N 3"], start: Float[Tensor, "3 3"]
) -> Float[Tensor, "3 3"]:
    """Return the rotation that best takes bearings to their matches, robustly, from a start.

    Iteratively reweighted Kabsch: parallax and bad tracks are outliers.
    """
    R = start
    for _ in range(8):
        error = torch.linalg.vector_norm(ref @ R.mT - tgt, dim=-1)
        weight = 1 / (error.square() + error.median().square().clamp_min(1e-8))
        U, _, Vh = torch.linalg.svd(tgt.mT @ (ref * weight[:, None]))
        sign = torch.linalg.det(U @ Vh).sign()
        R = U @ torch.diag(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign])) @ Vh
    return R
