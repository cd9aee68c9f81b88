"""Every step of a batched solve: for a caller who wants to see it, and to go through the steps again with gradients."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360.solve.step import Problem, State, Work, damped_step, pick


class Trace(NamedTuple):
    """The steps of all elements, in order; S is the number of the longest element's."""

    state: State
    """Before each step, [S, B, ...]."""
    cost: Float[Tensor, "S B"]
    """Mean robust cost before each step; 0 where none was tried."""
    damping: Float[Tensor, "S B"]
    """Lambda of each step; 0 where none was tried."""
    tried: Bool[Tensor, "S B"]
    """Whether the element had not ended before."""
    moved: Bool[Tensor, "S B"]
    """Whether the step was accepted."""


class TraceWriter:
    """Notes the steps of a solve as it goes."""

    def __init__(self, state: State) -> None:
        self._state = state
        self._rows: list[tuple[State, Tensor, Tensor, Tensor]] = []
        self._moved: list[Tensor] = []

    def begin(self, work: Work, going: Bool[Tensor, "B"] | None = None) -> None:
        """Note a step of the elements at work, or of those that are `going` where all are."""
        mean = work.equations.cost / work.equations.weight
        if going is not None:
            self._state = work.state
            row = (torch.where(going, mean, 0.0), torch.where(going, work.damping.value, 0.0), going)
        else:
            place = work.place
            self._state = tuple(old.index_copy(0, place, new) for old, new in zip(self._state, work.state, strict=True))
            nothing = mean.new_zeros(self._state[0].shape[0])
            tried = torch.zeros_like(nothing, dtype=torch.bool).index_fill(0, place, True)
            row = (nothing.index_copy(0, place, mean), nothing.index_copy(0, place, work.damping.value), tried)
        self._rows.append((self._state, *row))
        self._moved.append(torch.zeros_like(row[-1]))

    def move(self, place: Int64[Tensor, "A"]) -> None:
        """Note that the step of the elements at some places was accepted."""
        self._moved[-1] = self._moved[-1].index_fill(0, place, True)

    def move_where(self, mask: Bool[Tensor, "B"]) -> None:
        """Note which steps were accepted."""
        self._moved[-1] = mask

    def trace(self) -> Trace:
        """Return what was noted."""
        if not self._rows:
            B = self._state[0].shape[0]
            empty = self._state[0].new_zeros(0, B)
            none = torch.zeros_like(empty, dtype=torch.bool)
            return Trace(tuple(part.new_zeros(0, *part.shape) for part in self._state), empty, empty, none, none)
        states, cost, damping, tried = zip(*self._rows, strict=True)
        stacked = tuple(torch.stack(parts) for parts in zip(*states, strict=True))
        return Trace(stacked, *(torch.stack(rows) for rows in (cost, damping, tried, self._moved)))


def last_moves(trace: Trace, count: int, end: State) -> tuple[State, Trace]:
    """Return the states before the last `count` accepted steps of every element, and those steps.

    Args:
        trace: All steps.
        count: How many.
        end: The states after all steps.
    """
    if len(trace.moved) == 0:
        return end, trace
    left = trace.moved.flip(0).cumsum(0).flip(0)
    moved = trace.moved & (left <= count)
    first = moved.to(torch.int8).argmax(0)
    elements = torch.arange(moved.shape[1], device=moved.device)
    return tuple(part[first, elements] for part in trace.state), trace._replace(moved=moved)


def replay(problem: Problem, state: State, trace: Trace, *, masked: bool) -> State:
    """Go through the accepted steps again, so that gradients flow through them to the start and all else.

    Damping and acceptance are held as they came out: what a rejected step touched never enters.

    Args:
        problem: Must be differentiable.
        state: Where to start.
        trace: The steps.
        masked: Work on all elements at every step, as `LMConfig.fixed_steps` does.
    """
    everything = torch.arange(trace.moved.shape[1], device=trace.moved.device)
    for moved, damping in zip(trace.moved, trace.damping, strict=True):
        if masked:
            equations = problem.linearize(state, everything)
            equations = equations._replace(weight=torch.where(moved, equations.weight, 1.0))
            _, _, delta, _ = damped_step(equations, damping, problem.free)
            state = problem.retract(state, torch.where(moved[:, None], delta, 0.0))
        elif bool(moved.any()):
            index = everything[moved]
            part = pick(state, index)
            _, _, delta, _ = damped_step(problem.linearize(part, index), damping[index], problem.free)
            new = problem.retract(part, delta)
            state = tuple(old.index_copy(0, index, x) for old, x in zip(state, new, strict=True))
    return state
