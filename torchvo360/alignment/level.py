"""Alignment at one resolution: compiled where it serves (`pairs`), else in steps of torch."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from torchvo360 import lie, pairs
from torchvo360.alignment.config import AlignConfig
from torchvo360.backends import linearize
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.solve import Problem, Solution, minimize

MAX_TRANSLATION = 1e6
"""Positions farther away than this, m, are no place of anything."""

MAX_LOG_GAIN = 10.0
"""Exposures differ by less than e to this power, fourteen stops."""


def retract(state: tuple[Tensor, ...], delta: Float[Tensor, "B 8"]) -> tuple[Tensor, ...]:
    """Apply steps (v, w, a, b) to poses and brightness."""
    T_tgt_ref, affine = state
    return lie.se3_exp(delta[:, :6]) @ T_tgt_ref, affine + delta[:, 6:]


def is_sensible(state: tuple[Tensor, ...]) -> Bool[Tensor, "B"]:
    """Return which states are within any scene and any exposure: unrelated images drive the gain towards zero."""
    T_tgt_ref, affine = state
    return (T_tgt_ref[:, :3, 3].abs() < MAX_TRANSLATION).all(-1) & (affine[:, 0].abs() < MAX_LOG_GAIN)


def free_parameters(config: AlignConfig, device: torch.device, *, motion_only: bool = False) -> Bool[Tensor, "8"]:
    """Return which of (v, w, a, b) are estimated."""
    return torch.arange(8, device=device) < (8 if config.affine and not motion_only else 6)


class PosePrior(NamedTuple):
    """What is known of the poses besides the images: the energy d^T information d / 2 with d = Log(T T_prior^-1)."""

    T_tgt_ref: Float64[Tensor, "B 4 4"]
    information: Float64[Tensor, "B 6 6"]
    """In the unit of the images' energy; zero for what is not known."""

    def take(self, index: Tensor) -> PosePrior:
        """Return the batch elements of an index."""
        return PosePrior(self.T_tgt_ref[index], self.information[index])

    def added(self, equations: NormalEquations, T_tgt_ref: Float64[Tensor, "B 4 4"]) -> NormalEquations:
        """Return the normal equations with the prior's, to first order in d."""
        d = lie.se3_log(T_tgt_ref @ lie.se3_inverse(self.T_tgt_ref))
        pull = (self.information @ d[..., None])[..., 0]
        H, g = F.pad(self.information, (0, 2, 0, 2)), F.pad(pull, (0, 2))
        cost = equations.cost + 0.5 * (d * pull).sum(-1)
        return equations._replace(H=equations.H + H, g=equations.g + g, cost=cost)


def level_problem(
    reference: Reference,
    target: Target,
    config: AlignConfig,
    free: Bool[Tensor, "8"],
    prior: PosePrior | None = None,
) -> Problem:
    """Return the least-squares problem of one pyramid level."""
    B = target.padded.shape[0]

    def evaluate(state: tuple[Tensor, ...], index: Tensor) -> NormalEquations:
        T, affine = state
        whole = index.numel() == B
        points, images = (reference, target) if whole else (reference.take(index), target.take(index))
        equations = linearize(points, images, T, affine, config.loss, noise=config.noise)
        return equations if prior is None else (prior if whole else prior.take(index)).added(equations, T)

    return Problem(evaluate, retract, free, is_sensible)


def solve_level(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    config: AlignConfig,
    *,
    max_steps: int,
    free: Bool[Tensor, "8"] | None = None,
    prior: PosePrior | None = None,
    traced: bool = False,
) -> Solution:
    """Align at one resolution from given poses and brightness.

    Args:
        reference: Points.
        target: Images of one pyramid level.
        T_tgt_ref: Starts, float64.
        affine: (a, b) to start from, float64.
        config: Settings; of the solver's, `max_steps` is replaced.
        max_steps: Most steps.
        free: Which of (v, w, a, b) are estimated; all, or all but (a, b), by `config.affine` when it is None.
        prior: What is known of the poses besides.
        traced: Whether every step is noted.
    """
    B = T_tgt_ref.shape[0]
    free = free_parameters(config, T_tgt_ref.device) if free is None else free
    if not traced and pairs.serves(reference, target, T_tgt_ref, affine, *(prior or ())):
        return pairs.solve(
            reference,
            target,
            T_tgt_ref,
            affine,
            config.loss,
            replace(config.solver, max_steps=max_steps),
            noise=config.noise,
            free=free,
            min_weight=config.min_pixels,
            prior=prior,
            max_translation=MAX_TRANSLATION,
            max_log_gain=MAX_LOG_GAIN,
        )
    problem = level_problem(reference, target, config, free, prior)
    per_radian = 1 / target.camera.pixel_angle
    weight = reference.weight.double()
    mean_rho = (reference.rho.double() * weight).sum(1) / weight.sum(1).clamp_min(1e-12)
    scale = torch.cat(
        [
            (mean_rho * per_radian)[:, None].expand(B, 3),
            torch.full_like(mean_rho, per_radian)[:, None].expand(B, 3),
            torch.ones_like(mean_rho)[:, None].expand(B, 2),
        ],
        -1,
    )
    return minimize(
        problem.linearize,
        problem.retract,
        (T_tgt_ref, affine),
        replace(config.solver, max_steps=max_steps),
        step_scale=scale,
        free=problem.free,
        min_weight=config.min_pixels,
        sensible=problem.sensible,
        traced=traced,
    )
