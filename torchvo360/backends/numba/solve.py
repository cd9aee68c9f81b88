"""Levenberg-Marquardt of pairs as one compiled call: tensors to arrays, and rows to normal equations."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from torchvo360.backends.numba.arrays import as_arrays
from torchvo360.backends.numba.kernel import kernel
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig

NO_PRIOR = np.empty((1, 4, 4)), np.empty((0, 6, 6))
"""Stands in for a prior that is not there."""


class Rules(NamedTuple):
    """When steps are taken and solves end, in plain numbers."""

    max_steps: int
    by_gain_ratio: bool
    """Whether the damping follows Nielsen's rule, or else LSD-SLAM's."""
    initial_damping: float
    max_damping: float
    step_tolerance: float
    cost_tolerance: float
    least_promise: float
    """A refused step that promised a smaller share of the cost has converged."""
    min_weight: float
    max_translation: float
    max_log_gain: float
    pivot_tolerance: float


class Outcomes(NamedTuple):
    """What the solver's outcomes are called."""

    going_on: int
    converged: int
    out_of_steps: int
    stalled: int
    singular: int
    too_few_pixels: int
    diverged: int


class Solved(NamedTuple):
    """What became of the pairs."""

    T_tgt_ref: Float64[Tensor, "B 4 4"]
    affine: Float64[Tensor, "B 2"]
    equations: NormalEquations
    status: Int64[Tensor, "B"]
    steps: Int64[Tensor, "B"]


def solve_pairs(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    loss: LossConfig,
    *,
    noise: float,
    free: Bool[Tensor, "8"],
    rules: Rules,
    outcomes: Outcomes,
    prior: tuple[Float64[Tensor, "B 4 4"], Float64[Tensor, "B 6 6"]] | None = None,
) -> Solved:
    """Align every pair from its own start, with the arguments of `linearize`, which must be what `serves` says.

    Args:
        reference: Points.
        target: Images.
        T_tgt_ref: Starts, float64.
        affine: (a, b) to start from, float64.
        loss: The robust loss.
        noise: Standard deviation of an intensity.
        free: Which of (v, w, a, b) are estimated.
        rules: Of the solver.
        outcomes: How they are called.
        prior: Poses and their information, in the unit of the images' energy.
    """
    known = NO_PRIOR
    if prior is not None:
        known = tuple(part.detach().double().contiguous().numpy() for part in prior)
    T, ab, rows, status, steps = kernel("levenberg").solve_pairs(
        *as_arrays(reference, target, T_tgt_ref, affine, loss, noise),
        known,
        1 / target.camera.pixel_angle,
        free.double().numpy(),
        tuple(rules),
        tuple(outcomes),
        torch.get_num_threads(),
    )
    numbers = torch.from_numpy(rows)
    equations = NormalEquations(
        numbers[:, :64].view(-1, 8, 8), numbers[:, 64:72], numbers[:, 72], numbers[:, 73], numbers[:, 74]
    )
    return Solved(
        torch.from_numpy(T),
        torch.from_numpy(ab),
        equations,
        torch.from_numpy(status),
        torch.from_numpy(steps),
    )
