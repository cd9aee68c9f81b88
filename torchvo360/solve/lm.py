"""Batched Levenberg-Marquardt: `(H + lambda diag H) delta = -g`, every element of the batch its own problem.

Each element has its own damping, its own acceptance and its own end; elements that have ended leave the work. One
linearisation a step: the candidate's serves as the next step's when it is accepted, and a step below the tolerance is
taken without one. Costs are compared as means over the samples' weights, because samples may leave the view.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_choice, check_finite_number
from torchvo360.residuals.normal import NormalEquations
from torchvo360.solve.linear import solve_ldl
from torchvo360.solve.status import Status

State = tuple[Tensor, ...]
"""Parameters, each with the batch as its first axis."""


@dataclass(kw_only=True)
class LMConfig:
    """Settings of one Levenberg-Marquardt solve."""

    max_steps: int = 30
    damping: str = "gain_ratio"
    """gain_ratio: Nielsen's rule, by how well the model predicted the cost; lsd: LSD-SLAM's (equations.md, 7)."""
    initial_damping: float = 1e-3
    """Lambda at the start, relative to the diagonal of H; the lsd schedule starts from 0."""
    max_damping: float = 1e5
    """A step refused at this damping ends the solve: no step in any direction lowers the cost."""
    step_tolerance: float = 0.01
    """A shorter step is taken and ends the solve; in the unit of `step_scale`, for alignment in pixels."""
    cost_tolerance: float = 1e-5
    """A step that lowers the cost by a smaller share has converged, as has a refused one that promised less."""

    def __post_init__(self) -> None:
        if self.max_steps < 1:
            raise InputError(f"max_steps: expected at least 1, got {self.max_steps}.")
        check_choice("damping", self.damping, ("gain_ratio", "lsd"))
        check_finite_number("initial_damping", self.initial_damping, above=0)
        check_finite_number("max_damping", self.max_damping, above=0)
        check_finite_number("step_tolerance", self.step_tolerance, above=0)
        check_finite_number("cost_tolerance", self.cost_tolerance, above=0)


class Damping(NamedTuple):
    """Lambda of each element and the growth that its next refusal brings."""

    value: Float[Tensor, "B"]
    growth: Float[Tensor, "B"]


def initial_damping(config: LMConfig, g: Float[Tensor, "B D"]) -> Damping:
    """Return the damping before the first step."""
    start = config.initial_damping if config.damping == "gain_ratio" else 0.0
    return Damping(g.new_full(g.shape[:1], start), g.new_full(g.shape[:1], 2.0))


def next_damping(config: LMConfig, damping: Damping, accepted: Bool[Tensor, "B"], gain: Float[Tensor, "B"]) -> Damping:
    """Return the damping after a step.

    Args:
        config: Names the policy.
        damping: Before the step.
        accepted: Whether the step lowered the cost.
        gain: Fall of the cost over the fall that the linear model promised.
    """
    value, growth = damping
    if config.damping == "gain_ratio":
        # Nielsen 1999: the better the model predicted, the less damping; refusals grow it ever faster.
        shrink = (1 - (2 * gain.clamp(0.0, 1.0) - 1) ** 3).clamp_min(1 / 3)
        lower = (value * shrink).clamp_min(1e-9)
    else:
        lower = torch.where(value <= 0.2, torch.zeros_like(value), value / 2)
    higher = torch.where(value == 0, torch.full_like(value, 0.2), value * growth)
    return Damping(
        torch.where(accepted, lower, higher), torch.where(accepted, torch.full_like(growth, 2.0), growth * 2)
    )


class Solution(NamedTuple):
    """The end of a batched solve."""

    state: State
    equations: NormalEquations
    """At the solution, or a step below the tolerance before it; undamped, with all parameters."""
    status: Int64[Tensor, "B"]
    steps: Int64[Tensor, "B"]
    """Steps tried, accepted or not."""


def minimize(
    linearize: Callable[[State, Int64[Tensor, "A"]], NormalEquations],
    retract: Callable[[State, Float[Tensor, "A D"]], State],
    state: State,
    config: LMConfig,
    *,
    step_scale: Float[Tensor, "B D"],
    free: Bool[Tensor, "D"],
    min_weight: float,
) -> Solution:
    """Minimise every element of a batch from its own start.

    Args:
        linearize: Gives the normal equations of the active elements: their states, and their places in the batch.
        retract: Applies tangent steps to states.
        state: Where to start.
        config: Settings.
        step_scale: Turns a step into comparable units, in which `config.step_tolerance` counts.
        free: Parameters to be estimated; the others stay as they are.
        min_weight: Elements whose samples weigh less in all end as TOO_FEW_PIXELS.

    Returns:
        States, equations, status and steps of all elements; what ended badly keeps its best state.
    """
    device, B = state[0].device, state[0].shape[0]
    active = torch.arange(B, device=device)
    equations = linearize(state, active)
    enough = equations.weight >= min_weight
    finite = torch.isfinite(equations.cost) & torch.isfinite(equations.g).all(-1)
    status = torch.where(enough & finite, int(Status.MAX_STEPS), int(Status.DIVERGED))
    status = torch.where(enough, status, int(Status.TOO_FEW_PIXELS))
    result = Solution(state, equations, status, torch.zeros(B, dtype=torch.int64, device=device))
    ready = enough & finite
    if not bool(ready.all()):
        active, state, equations = active[ready], _pick(state, ready), NormalEquations(*_pick(equations, ready))
    damping = initial_damping(config, equations.g)
    steps = torch.zeros_like(active)
    fixed = torch.diag((~free).to(equations.H.dtype))
    both_free = free[:, None] & free

    while active.numel():
        weight = equations.weight[:, None]
        H = equations.H / weight[..., None] * both_free + fixed
        g = equations.g / weight * free
        delta, solvable = solve_ldl(H + torch.diag_embed(damping.value[:, None] * H.diagonal(dim1=-2, dim2=-1)), -g)
        candidate = retract(state, delta)
        steps = steps + 1
        # The model is trusted for steps below the tolerance, unless it is the damping that made them short.
        length = torch.linalg.vector_norm(delta * step_scale[active], dim=-1)
        arrived = solvable & (length < config.step_tolerance) & (damping.value <= 1)
        if bool(arrived.any()):
            outcome = torch.full_like(steps, int(Status.CONVERGED))
            result = _write(result, active, arrived, candidate, equations, outcome, steps)
            going = ~arrived
            active, state, candidate = active[going], _pick(state, going), _pick(candidate, going)
            equations, damping = NormalEquations(*_pick(equations, going)), Damping(*_pick(damping, going))
            H, g, delta, solvable, steps = _pick((H, g, delta, solvable, steps), going)
            if active.numel() == 0:
                return result

        cost = equations.cost / equations.weight
        proposed = linearize(candidate, active)
        proposed_cost = proposed.cost / proposed.weight.clamp_min(min_weight)
        promised = -(delta * (g + 0.5 * (H @ delta[..., None])[..., 0])).sum(-1)
        gained = cost - proposed_cost
        usable = solvable & torch.isfinite(proposed_cost) & (proposed.weight >= min_weight)
        accepted = usable & (gained > 0)

        little = torch.where(accepted, gained, promised) <= config.cost_tolerance * cost
        # Under heavy damping every step promises little: that is no sign of a minimum.
        converged = solvable & little & (accepted | (promised >= 0)) & (damping.value <= 1)
        singular = ~solvable & (damping.value >= 1)
        stalled = ~accepted & (damping.value >= config.max_damping) & ~converged & ~singular
        spent = (steps >= config.max_steps) & ~converged & ~singular & ~stalled

        gain = gained / promised.clamp_min(torch.finfo(promised.dtype).tiny)
        damping = next_damping(config, damping, accepted, gain)
        if bool(accepted.all()):
            state, equations = candidate, proposed
        else:
            state = tuple(_choose(accepted, new, old) for new, old in zip(candidate, state, strict=True))
            chosen = (_choose(accepted, new, old) for new, old in zip(proposed, equations, strict=True))
            equations = NormalEquations(*chosen)
        ended = converged | singular | stalled | spent
        if bool(ended.any()):
            outcome = torch.where(converged, int(Status.CONVERGED), int(Status.STALLED))
            outcome = torch.where(singular, int(Status.SINGULAR), outcome)
            outcome = torch.where(spent, int(Status.MAX_STEPS), outcome)
            result = _write(result, active, ended, state, equations, outcome, steps)
            going = ~ended
            active, state, steps = active[going], _pick(state, going), steps[going]
            equations, damping = NormalEquations(*_pick(equations, going)), Damping(*_pick(damping, going))
    return result


def _pick(parts: tuple[Tensor, ...], index: Tensor) -> tuple[Tensor, ...]:
    return tuple(part[index] for part in parts)


def _choose(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)


def _write(
    result: Solution,
    active: Int64[Tensor, "A"],
    which: Bool[Tensor, "A"],
    state: State,
    equations: NormalEquations,
    status: Int64[Tensor, "A"],
    steps: Int64[Tensor, "A"],
) -> Solution:
    """Put what some active elements ended with into their places in the result."""
    place = active[which]
    return Solution(
        tuple(old.index_copy(0, place, new[which]) for old, new in zip(result.state, state, strict=True)),
        NormalEquations(
            *(old.index_copy(0, place, new[which]) for old, new in zip(result.equations, equations, strict=True))
        ),
        result.status.index_copy(0, place, status[which]),
        result.steps.index_copy(0, place, steps[which]),
    )
