"""Batched Levenberg-Marquardt: `(H + lambda diag H) delta = -g`, every element of the batch its own problem.

Each element has its own damping, its own acceptance and its own end; elements that have ended leave the work, or are
masked where branches are not allowed. One linearisation a step: the candidate's serves as the next step's when it is
accepted, and a step below the tolerance is taken without one.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360.residuals.normal import NormalEquations
from torchvo360.solve.config import LMConfig
from torchvo360.solve.damping import Damping, initial_damping
from torchvo360.solve.status import Status
from torchvo360.solve.step import GOING_ON, Problem, State, Work, choose, has_arrived, judge, propose
from torchvo360.solve.trace import Trace, TraceWriter


class Solution(NamedTuple):
    """The end of a batched solve."""

    state: State
    equations: NormalEquations
    """At the solution, or a step below the tolerance before it; undamped, with all parameters."""
    status: Int64[Tensor, "B"]
    steps: Int64[Tensor, "B"]
    """Steps tried, accepted or not."""
    trace: Trace | None = None
    """Every step, where it was asked for."""


def minimize(
    linearize: Callable[[State, Int64[Tensor, "A"]], NormalEquations],
    retract: Callable[[State, Float[Tensor, "A D"]], State],
    state: State,
    config: LMConfig,
    *,
    step_scale: Float[Tensor, "B D"],
    free: Bool[Tensor, "D"],
    min_weight: float,
    sensible: Callable[[State], Bool[Tensor, "A"]] | None = None,
    traced: bool = False,
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
        sensible: Which states may be gone to; all that are finite by default.
        traced: Whether every step is noted.

    Returns:
        States, equations, status and steps of all elements; what ended badly keeps its best state.
    """
    problem = Problem(linearize, retract, free, sensible)
    place = torch.arange(state[0].shape[0], device=state[0].device)
    equations = linearize(state, place)
    enough = equations.weight >= min_weight
    finite = torch.isfinite(equations.cost) & torch.isfinite(equations.g).all(-1)
    status = torch.where(enough, torch.where(finite, GOING_ON, int(Status.DIVERGED)), int(Status.TOO_FEW_PIXELS))
    work = Work(place, state, equations, initial_damping(config, equations.g), torch.zeros_like(place))
    writer = TraceWriter(state) if traced else None
    if config.fixed_steps:
        return _work_masked(problem, work, status, config, step_scale, min_weight, writer)
    return _work_compacted(problem, work, status, config, step_scale, min_weight, writer)


def _work_compacted(
    problem: Problem,
    work: Work,
    status: Int64[Tensor, "B"],
    config: LMConfig,
    step_scale: Float[Tensor, "B D"],
    min_weight: float,
    writer: TraceWriter | None,
) -> Solution:
    """Work on those elements that have not ended, fewer and fewer."""
    result = Solution(work.state, work.equations, status, work.steps)
    going = status == GOING_ON
    work = work if bool(going.all()) else work.pick(going)
    while work.place.numel():
        proposal = propose(problem, work)
        work = work._replace(steps=work.steps + 1)
        arrived = has_arrived(proposal, work, step_scale[work.place], config)
        if writer is not None:
            writer.begin(work)
        if bool(arrived.any()):
            outcome = torch.full_like(work.steps, int(Status.CONVERGED))
            result = _write(result, work._replace(state=proposal.candidate), outcome, arrived)
            if writer is not None:
                writer.move(work.place[arrived])
            work, proposal = work.pick(~arrived), proposal.pick(~arrived)
            if work.place.numel() == 0:
                break
        proposed = problem.linearize(proposal.candidate, work.place)
        verdict = judge(proposal, work, proposed, config, min_weight)
        if writer is not None:
            writer.move(work.place[verdict.accepted])
        work = _advanced(work, verdict.accepted, proposal.candidate, proposed, verdict.damping)
        ended = verdict.outcome != GOING_ON
        if bool(ended.any()):
            result = _write(result, work, verdict.outcome, ended)
            work = work.pick(~ended)
    return result if writer is None else result._replace(trace=writer.trace())


def _work_masked(
    problem: Problem,
    work: Work,
    status: Int64[Tensor, "B"],
    config: LMConfig,
    step_scale: Float[Tensor, "B D"],
    min_weight: float,
    writer: TraceWriter | None,
) -> Solution:
    """Work on all elements for all steps; those that have ended stay where they are."""
    # Without weight there is no mean: what has ended already works on numbers that are never used.
    start, began = work.equations, status == GOING_ON
    work = work._replace(equations=start._replace(weight=torch.where(began, start.weight, 1.0)))
    for _ in range(config.max_steps):
        going = status == GOING_ON
        proposal = propose(problem, work)
        work = work._replace(steps=work.steps + going)
        arrived = going & has_arrived(proposal, work, step_scale, config)
        proposed = problem.linearize(proposal.candidate, work.place)
        verdict = judge(proposal, work, proposed, config, min_weight)
        accepted = going & ~arrived & verdict.accepted
        if writer is not None:
            writer.begin(work, going)
            writer.move_where(arrived | accepted)
        moved = choose(arrived, proposal.candidate, work.state)
        work = _advanced(work._replace(state=moved), accepted, proposal.candidate, proposed, verdict.damping)
        status = torch.where(going, torch.where(arrived, int(Status.CONVERGED), verdict.outcome), status)
    solution = Solution(work.state, NormalEquations(*choose(began, work.equations, start)), status, work.steps)
    return solution if writer is None else solution._replace(trace=writer.trace())


def _advanced(
    work: Work, accepted: Bool[Tensor, "A"], candidate: State, proposed: NormalEquations, damping: Damping
) -> Work:
    return work._replace(
        state=choose(accepted, candidate, work.state),
        equations=NormalEquations(*choose(accepted, proposed, work.equations)),
        damping=damping,
    )


def _write(result: Solution, work: Work, outcome: Int64[Tensor, "A"], which: Bool[Tensor, "A"]) -> Solution:
    """Put what some active elements ended with into their places in the result."""
    place = work.place[which]

    def put(old: tuple[Tensor, ...], new: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        return tuple(a.index_copy(0, place, b[which]) for a, b in zip(old, new, strict=True))

    status, steps = put((result.status, result.steps), (outcome, work.steps))
    return Solution(
        put(result.state, work.state), NormalEquations(*put(result.equations, work.equations)), status, steps
    )
