"""Cells that segments cross, against a walk from cell to cell and against dense samples."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvo360.checks import ShapeError
from torchvo360.mapping.traverse import cells_crossed


def walked(start, end, shape):
    """Follow one segment from cell to cell: the next one is behind the nearest line. Amanatides and Woo."""
    sizes = shape[::-1]
    cell = [math.floor(value) for value in start]
    last = [math.floor(value) for value in end]
    found = []
    for _ in range(1000):
        if all(0 <= c < size for c, size in zip(cell, sizes, strict=True)):
            found.append(tuple(cell))
        if cell == last:
            return set(found)
        shares = []
        for c, stop, s, e in zip(cell, last, start, end, strict=True):
            line = c + 1 if e > s else c
            shares.append(math.inf if c == stop else (line - s) / (e - s))
        axis = shares.index(min(shares))
        cell[axis] += 1 if end[axis] > start[axis] else -1
    raise AssertionError


def unflattened(cells, shape):
    found = set()
    for cell in cells.tolist():
        place = []
        for size in shape[::-1]:
            place.append(cell % size)
            cell //= size
        found.add(tuple(place))
    return found


@pytest.mark.parametrize("shape", [(7, 9), (4, 7, 9), (1, 12), (12, 1)])
def test_the_cells_are_those_of_a_walk_from_line_to_line(shape):
    generator = torch.Generator().manual_seed(1)
    ends = torch.rand(2, 300, len(shape), generator=generator, dtype=torch.float64) * 14 - 2  # some lie outside
    segment, cell = cells_crossed(ends[0], ends[1], shape)
    for k in range(300):
        assert unflattened(cell[segment == k], shape) == walked(ends[0, k].tolist(), ends[1, k].tolist(), shape)


@given(st.lists(st.integers(0, 24), min_size=4, max_size=4))
@settings(max_examples=200, deadline=None)
def test_along_lines_and_through_corners_no_cell_is_missed_and_none_is_strange(quarters):
    start, end = torch.tensor(quarters, dtype=torch.float64).view(2, 2) / 4
    shape = (7, 7)
    _, cell = cells_crossed(start[None], end[None], shape)
    found = unflattened(cell, shape)
    samples = start + torch.linspace(0, 1, 961, dtype=torch.float64)[:, None] * (end - start)
    between = (samples + 1e-12 * (end - start))[:-1]  # a sample on a line belongs to where the segment goes
    assert {tuple(place) for place in between.floor().long().tolist() if max(place) < 7} <= found
    for column, row in found:
        low = torch.tensor([column, row], dtype=torch.float64)
        assert bool(((samples >= low - 0.03) & (samples <= low + 1.03)).all(-1).any())


def test_touching_adds_both_cells_beside_a_corner_and_a_line():
    start = torch.tensor([[0.5, 0.5], [2.0, 0.5]], dtype=torch.float64)
    end = torch.tensor([[1.5, 1.5], [2.0, 1.5]], dtype=torch.float64)
    segment, cell = cells_crossed(start, end, (3, 3), touching=True)
    assert unflattened(cell[segment == 0], (3, 3)) == {(0, 0), (1, 0), (0, 1), (1, 1)}
    assert unflattened(cell[segment == 1], (3, 3)) >= {(1, 0), (2, 0), (1, 1), (2, 1)}


def test_a_far_end_costs_no_more_than_the_grid():
    start, end = torch.tensor([[0.5, 0.5]], dtype=torch.float64), torch.tensor([[1e12, 2e12]], dtype=torch.float64)
    _, cell = cells_crossed(start, end, (5, 5))
    assert unflattened(cell, (5, 5)) == {(0, 0), (0, 1), (1, 1), (1, 2), (1, 3), (2, 3), (2, 4)}


def test_a_point_is_in_one_cell_and_no_segment_in_none():
    place = torch.tensor([[1.5, 2.5]], dtype=torch.float64)
    assert unflattened(cells_crossed(place, place, (4, 4))[1], (4, 4)) == {(1, 2)}
    assert len(cells_crossed(place[:0], place[:0], (4, 4))[1]) == 0


def test_ends_of_another_dimension_are_refused():
    with pytest.raises(ShapeError, match="start"):
        cells_crossed(torch.zeros(3, 2), torch.zeros(3, 2), (2, 3, 4))
