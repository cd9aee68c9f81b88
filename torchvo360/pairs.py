"""Direct alignment of pairs as one compiled call: the same steps as `solve.minimize` takes, up to rounding.

On a keyframe's few thousand points a step's hundred small tensor operations cost twenty times its arithmetic.
"""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from torchvo360.backends import numba, use_numba
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import COST_ROUNDING, GOING_ON, PIVOT_TOLERANCE, LMConfig, Solution, Status

OUTCOMES = numba.Outcomes(
    GOING_ON,
    int(Status.CONVERGED),
    int(Status.MAX_STEPS),
    int(Status.STALLED),
    int(Status.SINGULAR),
    int(Status.TOO_FEW_PIXELS),
    int(Status.DIVERGED),
)


def serves(reference: Reference, target: Target, *float64: Tensor) -> bool:
    """Return whether `solve` takes these points, images, and poses, brightness and prior."""
    return (
        use_numba(*float64)
        and all(value.dtype == torch.float64 for value in float64)
        and numba.serves(reference, target, *float64[:2])
    )


def solve(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float64[Tensor, "B 4 4"],
    affine: Float64[Tensor, "B 2"],
    loss: LossConfig,
    config: LMConfig,
    *,
    noise: float,
    free: Bool[Tensor, "8"],
    min_weight: float,
    prior: tuple[Float64[Tensor, "B 4 4"], Float64[Tensor, "B 6 6"]] | None,
    max_translation: float,
    max_log_gain: float,
) -> Solution:
    """Align every pair from its own start.

    Args:
        reference: Points.
        target: Images of one pyramid level.
        T_tgt_ref: Starts.
        affine: (a, b) to start from.
        loss: The robust loss.
        config: Of the solver.
        noise: Standard deviation of an intensity.
        free: Which of (v, w, a, b) are estimated.
        min_weight: Pairs whose samples weigh less in all end as TOO_FEW_PIXELS.
        prior: Poses and their information, where something is known.
        max_translation: Positions farther away are not gone to.
        max_log_gain: Nor gains beyond this.
    """
    solved = numba.solve_pairs(
        reference,
        target,
        T_tgt_ref,
        affine,
        loss,
        noise=noise,
        free=free,
        rules=rules_of(config, min_weight, max_translation, max_log_gain),
        outcomes=OUTCOMES,
        prior=prior,
    )
    return Solution((solved.T_tgt_ref, solved.affine), solved.equations, solved.status, solved.steps)


def rules_of(config: LMConfig, min_weight: float, max_translation: float, max_log_gain: float) -> numba.Rules:
    """Return settings of the solver as compiled solves take them."""
    by_gain_ratio = config.damping == "gain_ratio"
    return numba.Rules(
        max_steps=config.max_steps,
        by_gain_ratio=by_gain_ratio,
        initial_damping=float(config.initial_damping) if by_gain_ratio else 0.0,
        max_damping=float(config.max_damping),
        step_tolerance=float(config.step_tolerance),
        cost_tolerance=float(config.cost_tolerance),
        least_promise=float(max(config.cost_tolerance, COST_ROUNDING)),
        min_weight=float(min_weight),
        max_translation=max_translation,
        max_log_gain=max_log_gain,
        pivot_tolerance=PIVOT_TOLERANCE,
    )
