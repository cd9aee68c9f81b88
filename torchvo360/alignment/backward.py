"""How gradients flow from a solution to what it was computed from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import TypeVar

from jaxtyping import Bool
from torch import Tensor

from torchvo360.alignment.config import AlignConfig
from torchvo360.alignment.level import level_problem, retract
from torchvo360.alignment.pyramid import Level
from torchvo360.backends import OpenLinearization
from torchvo360.residuals.direct import Reference, Target
from torchvo360.solve import (
    Solution,
    State,
    Stationarity,
    attach_implicit,
    attach_newton_step,
    last_moves,
    replay,
)

Part = TypeVar("Part", Reference, Target)


def attach_solution(
    level: Level, solution: State, converged: Bool[Tensor, "B"], config: AlignConfig, free: Bool[Tensor, "8"]
) -> State:
    """Return poses and brightness with the gradients of the implicit function theorem, zero where not converged."""

    def rebuilt(parameters: tuple[Tensor, ...]) -> tuple[Reference, Target]:
        values = iter(parameters)
        return _refilled(level.reference, values), _refilled(level.target, values)

    def opened(state: State, parameters: tuple[Tensor, ...]) -> OpenLinearization:
        (reference, target), (T, affine) = rebuilt(parameters), state
        return OpenLinearization.at(reference, target, T, affine, config.loss, config.noise)

    problem = Stationarity(
        gradient=lambda state, parameters: opened(state, parameters).gradient(),
        linearize=opened,
        retract=retract,
        free=free,
        where=converged,
        exact=config.hessian == "exact",
    )
    attach = attach_newton_step if config.solver.fixed_steps else attach_implicit
    return attach(problem, solution, (*_tensors(level.reference), *_tensors(level.target)))


def attach_steps(
    level: Level,
    start: State,
    solution: Solution,
    config: AlignConfig,
    free: Bool[Tensor, "8"],
    *,
    last: int | None = None,
) -> State:
    """Return a level's poses and brightness with the gradients of its steps, or of the last few of them.

    Args:
        level: What was aligned.
        start: Where the steps began, with its gradients.
        solution: What came out, with its trace.
        config: Settings.
        free: Which of (v, w, a, b) the steps moved.
        last: How many accepted steps; all of them, from `start` on, by default.
    """
    assert solution.trace is not None
    trace = solution.trace
    if last is not None:
        start, trace = last_moves(trace, last, solution.state)
    problem = level_problem(level.reference, level.target, config, free)
    again = replay(problem, start, trace, masked=config.solver.fixed_steps)
    # The values stay those of the solve: summing in another order could change their last digits. What no step leads
    # to still hangs on its inputs, with gradients of zero: a batch that fails as a whole can be gone back through.
    link = sum(0.0 * x.sum() for x in (*_tensors(level.reference), *_tensors(level.target)) if x.requires_grad)
    return tuple(value + (x - x.detach()) + link for value, x in zip(solution.state, again, strict=True))


def has_gradient(level: Level, start: State, config: AlignConfig) -> bool:
    """Return whether anything that gradients can reach asks for them: the start only where all steps are unrolled.

    Inside the transforms of `torch.func` tensors do not tell: where steps are fixed, the answer is yes.
    """
    tensors = [*_tensors(level.reference), *_tensors(level.target), *(start if config.backward == "unroll" else ())]
    return config.solver.fixed_steps or any(tensor.requires_grad for tensor in tensors)


def _tensors(part: Reference | Target) -> list[Tensor]:
    return [value for field in fields(part) if isinstance(value := getattr(part, field.name), Tensor)]


def _refilled(part: Part, values: Iterator[Tensor]) -> Part:
    names = [field.name for field in fields(part) if isinstance(getattr(part, field.name), Tensor)]
    return replace(part, **{name: next(values) for name in names})
