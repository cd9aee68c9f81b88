"""A* on a grid of eight neighbours: one loop, run by Python or compiled by numba.

Open cells lie in a binary heap by f = g + h, then h, then their number, which is a total order: every backend takes
them in the same one. A cell is closed when it leaves the heap; a cheaper way to a closed cell opens it again, which an
inconsistent bound needs. The search ends when the goal leaves the heap, not when it enters, and fails only when the
heap is empty: a dead end is no end (mathematics.md, section 9).

A step costs its length times the mean weight of its two cells. Weights are at least 1, so that the octile distance is a
lower bound, and a consistent one. A diagonal step needs both cells beside it: no corner is cut.
"""

import heapq
from typing import Any

DIAGONAL = 2**0.5

ROWS, COLUMNS = (0, 0, 1, -1, 1, 1, -1, -1), (1, -1, 0, 0, 1, -1, 1, -1)
"""Steps to the eight neighbours, the straight ones first."""

NONE = 8
"""The step that leads to the start, or to a cell that no way leads to."""

ROUNDING = 1e-9
"""In cells: ways whose costs differ by less are equal, or sums in another order would open closed cells again."""


def astar(
    weight: Any, bound: Any, width: int, start: int, goal: int, cost: Any, step_to: Any, closed: Any
) -> tuple[int, int, int]:
    """Search from a cell to another, over flat sequences of a grid whose border is blocked.

    Only what Python's lists and numpy's arrays share is used, so that the one source serves both.

    Args:
        weight: Cost of each cell per unit of length, at least 1; inf for blocked ones, the border among them.
        bound: A lower bound of the cost from each cell to the goal, consistent or not; empty for the octile distance.
        width: Columns of the grid.
        start: Flat number of the cell to begin with, not blocked.
        goal: Flat number of the cell to reach, not blocked.
        cost: Filled with inf; returns the least cost found to each cell, in cells.
        step_to: Filled with NONE; returns the step that leads to each cell.
        closed: Filled with 0; returns 1 for cells that were searched.

    Returns:
        Cells taken from the heap, cells opened again, and the searched cell nearest to the goal.
    """
    infinity = float("inf")
    goal_row, goal_column = goal // width, goal % width
    has_bound = len(bound) > 0
    cost[start] = 0.0
    heap = [(0.0, 0.0, start)]
    taken, again, nearest, least = 0, 0, start, infinity
    while len(heap) > 0:
        _, _, here = heapq.heappop(heap)
        if closed[here]:
            continue  # a dearer entry of a cell that has been searched since
        closed[here] = 1
        taken += 1
        row, column = here // width, here % width
        away = octile(row - goal_row, column - goal_column)
        if away < least:
            nearest, least = here, away
        if here == goal:
            break
        so_far, own = cost[here], weight[here]
        for step in range(8):
            along = ROWS[step] * width
            there = here + along + COLUMNS[step]
            other = weight[there]
            if other == infinity:
                continue
            half = 0.5
            if step > 3:
                if weight[here + along] == infinity or weight[here + COLUMNS[step]] == infinity:
                    continue
                half = 0.5 * DIAGONAL
            through = so_far + (half * own + half * other)
            if through + ROUNDING < cost[there]:
                cost[there] = through
                step_to[there] = step
                if closed[there]:
                    closed[there] = 0
                    again += 1
                if has_bound:
                    ahead = bound[there]
                else:
                    ahead = octile(row + ROWS[step] - goal_row, column + COLUMNS[step] - goal_column)
                heapq.heappush(heap, (through + ahead, ahead, there))
    return taken, again, nearest


def octile(rows: int, columns: int) -> float:
    """Return the least length of a way over eight neighbours, in cells."""
    rows, columns = abs(rows), abs(columns)
    return max(rows, columns) + (DIAGONAL - 1) * min(rows, columns)
