"""Straighter ways: a corner is left out where the line past it is clear and no dearer than the way it replaces."""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.mapping.traverse import cells_crossed

SAMPLES = 2
"""Places a cell at which the cost of a line is looked up."""

AHEAD = 128
"""Corners that are tried at once."""

SLACK = 1e-6
"""Relative difference of two costs that is rounding."""


def straightened(way: Float64[Tensor, "N 2"], weight: Float[Tensor, "H W"]) -> Float64[Tensor, "M 2"]:
    """Return a way with the same ends and fewer corners that touches no blocked cell and costs no more.

    Args:
        way: Columns and rows, continuous; itself clear.
        weight: Cost of each cell per unit of length; inf for blocked ones.
    """
    corners = _corners(way)
    costs = _line_costs(corners[:-1], corners[1:], weight)
    paid = torch.cat([costs.new_zeros(1), costs.cumsum(0)])
    kept, here = [0], 0
    while here < len(corners) - 1:
        ahead = torch.arange(here + 1, min(here + 1 + AHEAD, len(corners)))
        start, end = corners[here].expand(len(ahead), 2), corners[ahead]
        no_dearer = _line_costs(start, end, weight) <= (paid[ahead] - paid[here]) * (1 + SLACK)
        tried = ahead[no_dearer]  # few: most lines that are not clear cost inf already
        clear = tried[_is_clear(start[no_dearer], end[no_dearer], weight)]
        here = int(clear[-1]) if len(clear) else here + 1  # the way itself
        kept.append(here)
    return corners[kept]


def _corners(way: Float64[Tensor, "N 2"]) -> Float64[Tensor, "M 2"]:
    """Return the ends of a way and the places where it turns."""
    if len(way) < 3:
        return way
    before, after = way[1:-1] - way[:-2], way[2:] - way[1:-1]
    turns = (before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]).abs() > 1e-12
    back = (before * after).sum(-1) < 0
    return way[torch.cat([turns.new_ones(1), turns | back, turns.new_ones(1)])]


def _is_clear(start: Float64[Tensor, "N 2"], end: Float64[Tensor, "N 2"], weight: Float[Tensor, "H W"]) -> Tensor:
    segment, cell = cells_crossed(start, end, (weight.shape[0], weight.shape[1]), touching=True)
    blocked = torch.isinf(weight.reshape(-1)[cell])
    return torch.bincount(segment[blocked], minlength=len(start)) == 0


def _line_costs(
    start: Float64[Tensor, "N 2"], end: Float64[Tensor, "N 2"], weight: Float[Tensor, "H W"]
) -> Float64[Tensor, "N"]:
    """Return length times mean weight of lines, in cells."""
    length = torch.linalg.vector_norm(end - start, dim=-1)
    count = (length * SAMPLES).ceil().clamp_min(1).long()
    line = torch.repeat_interleave(torch.arange(len(start)), count)
    number = torch.arange(len(line)) - (count.cumsum(0) - count)[line]
    share = (number.double() + 0.5) / count[line]
    column, row = torch.lerp(start[line], end[line], share[:, None]).floor().long().unbind(-1)
    rows, columns = weight.shape
    looked_up = weight[row.clamp(0, rows - 1), column.clamp(0, columns - 1)].double()
    total = torch.zeros(len(start), dtype=torch.float64).index_add_(0, line, looked_up)
    return length * total / count
