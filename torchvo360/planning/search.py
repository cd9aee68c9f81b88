"""The search as a function of arrays, on the fastest backend there is."""

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from torchvo360.checks import InputError, check_choice
from torchvo360.planning.astar import COLUMNS, NONE, ROWS, astar
from torchvo360.planning.config import BACKENDS

NUMBA_FROM = 250_000
"""Cells from which numba is worth its start of half a second; Python searches them in about two."""


@dataclass(frozen=True, eq=False)
class Search:
    """What a search found."""

    cells: Int64[np.ndarray, "N 2"] | None
    """Rows and columns from the start to the goal, both included; None where there is no way."""
    cost: float
    """Of the way, in cells; inf where there is none."""
    searched: int
    """Cells taken from the heap."""
    reopened: int
    """Cells among them that had been closed before."""
    nearest: tuple[int, int]
    """The searched cell nearest to the goal."""


def find_path(
    weight: Float[np.ndarray, "H W"],
    start: tuple[int, int],
    goal: tuple[int, int],
    *,
    bound: Float[np.ndarray, "H W"] | None = None,
    backend: str = "auto",
) -> Search:
    """Return the cheapest way between two cells by A*, over eight neighbours and without cutting corners.

    Args:
        weight: Cost of each cell per unit of length, at least 1; inf for blocked ones.
        start: Row and column, not blocked.
        goal: Row and column, not blocked.
        bound: Lower bounds of the cost to the goal in cells, consistent or not; the octile distance by default.
        backend: numba, python or auto, which is numba for large grids where it is installed; all find the same way.

    Raises:
        InputError: A cell lies outside or is blocked, a weight is below 1, the bound is negative or of another shape,
            or numba is asked for and missing; the extra `fast` brings it.
    """
    _check(weight, start, goal, bound)
    check_choice("backend", backend, BACKENDS)
    padded = np.pad(weight, 1, constant_values=np.inf)
    width = padded.shape[1]
    first, last = ((row + 1) * width + column + 1 for row, column in (start, goal))
    ahead = np.zeros(0) if bound is None else np.pad(bound.astype(np.float64), 1)
    arrays = (
        np.full(padded.size, np.inf),
        np.full(padded.size, NONE, np.uint8),
        np.zeros(padded.size, np.uint8),
    )
    run, as_sequence = _backend(backend, weight.size)
    cost, step_to, closed = map(as_sequence, arrays)
    searched, again, near = run(
        as_sequence(padded.ravel()), as_sequence(ahead.ravel()), width, first, last, cost, step_to, closed
    )
    nearest = (near // width - 1, near % width - 1)
    if not closed[last]:
        return Search(None, float("inf"), searched, again, nearest)
    cells, here = [last], last
    while here != first:
        step = step_to[here]
        here -= ROWS[step] * width + COLUMNS[step]
        cells.append(here)
    flat = np.array(cells[::-1], np.int64)
    return Search(np.stack([flat // width - 1, flat % width - 1], -1), float(cost[last]), searched, again, nearest)


def has_numba() -> bool:
    """Return whether numba is installed."""
    return importlib.util.find_spec("numba") is not None


def _check(weight: np.ndarray, start: tuple[int, int], goal: tuple[int, int], bound: np.ndarray | None) -> None:
    if weight.ndim != 2 or weight.size == 0 or not np.issubdtype(weight.dtype, np.floating):
        raise InputError(f"weight: expected floats [H, W], got {weight.dtype} {list(weight.shape)}.")
    if not bool((weight >= 1).all()):
        raise InputError("weight: expected at least 1 everywhere, got less.")
    for name, (row, column) in (("start", start), ("goal", goal)):
        if not (0 <= row < weight.shape[0] and 0 <= column < weight.shape[1]):
            raise InputError(f"{name}: expected a cell of the {list(weight.shape)} ones, got ({row}, {column}).")
        if weight[row, column] == np.inf:
            raise InputError(f"{name}: expected a cell that is not blocked, got ({row}, {column}).")
    if bound is not None and (bound.shape != weight.shape or not bool((bound >= 0).all())):
        raise InputError(f"bound: expected numbers of at least 0, {list(weight.shape)}, got others.")


def _backend(name: str, cells: int) -> tuple[Callable[..., tuple[int, int, int]], Callable[[np.ndarray], Any]]:
    """Return the loop, and what makes its sequences of arrays: lists, for Python reads them faster than arrays."""
    if name == "python" or (name == "auto" and (cells < NUMBA_FROM or not has_numba())):
        return astar, np.ndarray.tolist
    if not has_numba():
        raise InputError("backend: expected numba to be installed (pip install 'torchvo360[fast]'), got none.")
    return _compiled(), _same


def _same(array: np.ndarray) -> np.ndarray:
    return array


def _compiled() -> Callable[..., tuple[int, int, int]]:
    """Import what numba has compiled: half a second, and some more the first time of all."""
    return importlib.import_module("torchvo360.planning.compiled").astar
