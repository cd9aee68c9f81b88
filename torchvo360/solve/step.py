"""One Levenberg-Marquardt step of a batch, without branches: propose, evaluate, judge."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360.residuals.normal import NormalEquations
from torchvo360.solve.config import LMConfig
from torchvo360.solve.damping import Damping, next_damping
from torchvo360.solve.linear import solve_ldl
from torchvo360.solve.status import Status

State = tuple[Tensor, ...]
"""Parameters, each with the batch as its first axis."""

COST_ROUNDING = 1e-6
"""A refused step that promised less than this share of the cost was refused by the rounding of float32 sums."""

GOING_ON = -1
"""In place of a status: the element has not ended."""


@dataclass(frozen=True)
class Problem:
    """What is minimised."""

    linearize: Callable[[State, Int64[Tensor, "A"]], NormalEquations]
    """Gives the normal equations of the active elements: their states, and their places in the batch."""
    retract: Callable[[State, Float[Tensor, "A D"]], State]
    """Applies tangent steps to states."""
    free: Bool[Tensor, "D"]
    """Parameters to be estimated; the others stay as they are."""
    sensible: Callable[[State], Bool[Tensor, "A"]] | None = None
    """Which states may be gone to; all that are finite by default."""


class Work(NamedTuple):
    """The elements at work; every part has them as its first axis."""

    place: Int64[Tensor, "A"]
    """Their places in the batch."""
    state: State
    equations: NormalEquations
    damping: Damping
    steps: Int64[Tensor, "A"]
    """Steps tried, accepted or not."""

    def pick(self, which: Tensor) -> "Work":
        """Return the work of some of the elements."""
        return Work(
            self.place[which],
            pick(self.state, which),
            NormalEquations(*pick(self.equations, which)),
            Damping(*pick(self.damping, which)),
            self.steps[which],
        )


class Proposal(NamedTuple):
    """A step, before it is known what it costs."""

    H: Float[Tensor, "A D D"]
    """Per unit of weight, with ones on the diagonal for parameters that are not free."""
    g: Float[Tensor, "A D"]
    delta: Float[Tensor, "A D"]
    solvable: Bool[Tensor, "A"]
    candidate: State

    def pick(self, which: Tensor) -> "Proposal":
        """Return the proposals of some of the elements."""
        H, g, delta, solvable = pick((self.H, self.g, self.delta, self.solvable), which)
        return Proposal(H, g, delta, solvable, pick(self.candidate, which))


class Verdict(NamedTuple):
    """What became of a step."""

    accepted: Bool[Tensor, "A"]
    outcome: Int64[Tensor, "A"]
    """A `Status`, or `GOING_ON`."""
    damping: Damping


def pick(parts: tuple[Tensor, ...], index: Tensor) -> tuple[Tensor, ...]:
    """Return some elements of every part."""
    return tuple(part[index] for part in parts)


def choose(mask: Bool[Tensor, "A"], new: tuple[Tensor, ...], old: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return the new elements where the mask says so."""
    return tuple(torch.where(mask.reshape(-1, *[1] * (x.ndim - 1)), x, y) for x, y in zip(new, old, strict=True))


def damped_step(
    equations: NormalEquations, damping: Float[Tensor, "A"], free: Bool[Tensor, "D"]
) -> tuple[Float[Tensor, "A D D"], Float[Tensor, "A D"], Float[Tensor, "A D"], Bool[Tensor, "A"]]:
    """Return H and g per unit of weight, the step, and whether the damped H is positive definite (mathematics.md 7)."""
    weight = equations.weight[:, None]
    fixed = torch.diag((~free).to(equations.H.dtype))
    H = equations.H / weight[..., None] * (free[:, None] & free) + fixed
    g = equations.g / weight * free
    damped = H + torch.diag_embed(damping[:, None] * H.diagonal(dim1=-2, dim2=-1))
    return H, g, *solve_ldl(damped, -g)


def propose(problem: Problem, work: Work) -> Proposal:
    """Return the damped Gauss-Newton step of every element; where it leads to nothing sensible, the state itself."""
    H, g, delta, solvable = damped_step(work.equations, work.damping.value, problem.free)
    candidate = problem.retract(work.state, delta)
    finite = torch.stack([torch.isfinite(part).flatten(1).all(1) for part in candidate]).all(0)
    candidate = choose(finite, candidate, work.state)
    if problem.sensible is not None:
        candidate = choose(problem.sensible(candidate), candidate, work.state)
    return Proposal(H, g, delta, solvable, candidate)


def has_arrived(proposal: Proposal, work: Work, scale: Float[Tensor, "A D"], config: LMConfig) -> Bool[Tensor, "A"]:
    """Return which steps are so short that they are taken and end the solve.

    The model is trusted for steps below the tolerance, unless it is the damping that made them short.
    """
    length = torch.linalg.vector_norm(proposal.delta * scale, dim=-1)
    return proposal.solvable & (length < config.step_tolerance) & (work.damping.value <= 1)


def judge(proposal: Proposal, work: Work, proposed: NormalEquations, config: LMConfig, min_weight: float) -> Verdict:
    """Decide about steps whose candidates have been evaluated; costs compare as means over the samples' weights."""
    damping, equations = work.damping, work.equations
    cost = equations.cost / equations.weight
    proposed_cost = proposed.cost / proposed.weight.clamp_min(min_weight)
    predicted = proposal.g + 0.5 * (proposal.H @ proposal.delta[..., None])[..., 0]
    promised = -(proposal.delta * predicted).sum(-1)
    gained = cost - proposed_cost
    accepted = proposal.solvable & torch.isfinite(proposed_cost) & (proposed.weight >= min_weight) & (gained > 0)

    least = max(config.cost_tolerance, COST_ROUNDING)
    little = torch.where(accepted, gained <= config.cost_tolerance * cost, promised <= least * cost)
    # Under heavy damping every step promises little: that is no sign of a minimum.
    converged = proposal.solvable & little & (accepted | (promised >= 0)) & (damping.value <= 1)
    singular = ~proposal.solvable & (damping.value >= 1)
    stalled = ~accepted & (damping.value >= config.max_damping)
    outcome = torch.where(work.steps >= config.max_steps, int(Status.MAX_STEPS), GOING_ON)
    for ended, status in ((stalled, Status.STALLED), (singular, Status.SINGULAR), (converged, Status.CONVERGED)):
        outcome = torch.where(ended, int(status), outcome)
    gain = gained / promised.clamp_min(torch.finfo(promised.dtype).tiny)
    return Verdict(accepted, outcome, next_damping(config, damping, accepted, gain))
