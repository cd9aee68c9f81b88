"""The cells of a grid that segments cross, exactly and for all segments at once, in any number of dimensions.

A segment enters a new cell where it crosses a line between two of them along one axis. All crossings are counted, laid
out in one flat array and turned into cells, without an order along the segment: a map needs the cells as a set.
Coordinates are in cells: cell (i, j) covers [i, i + 1) x [j, j + 1).
"""

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from torchvo360.checks import check_shape

TOUCH = 1e-9
"""Distance in cells at which a line touches a corner, by which rounding cannot lead a path through one."""


def cells_crossed(
    start: Float64[Tensor, "N D"], end: Float64[Tensor, "N D"], shape: tuple[int, ...], *, touching: bool = False
) -> tuple[Int64[Tensor, "M"], Int64[Tensor, "M"]]:
    """Return all cells that segments cross, those that hold their ends among them.

    Args:
        start: Where they begin, one coordinate for each axis of the grid, the last one's first: column, row, layer.
        end: Where they end; a segment may be a point.
        shape: Of the grid: rows and columns, with layers before them in three dimensions; others are left out.
        touching: Also the cells that a segment touches only, beside a line that it runs along or at a corner; in two
            dimensions.

    Returns:
        segment: Number of the segment of each crossing; a cell may come more than once.
        cell: Its flat cell, as in `tensor.view(-1)`.

    Raises:
        ShapeError: The ends are not [N, D] for a grid of D axes.

    Source: the set of Amanatides and Woo, A fast voxel traversal algorithm for ray tracing, 1987.
    """
    check_shape("start", start, f"N {len(shape)}")
    check_shape("end", end, f"{len(start)} {len(shape)}")
    sizes = shape[::-1]
    segments = [torch.arange(len(start))] * 2
    places = [start.floor().long(), end.floor().long()]
    for axis, size in enumerate(sizes):
        segment, place, line, forward = _crossings(start, end, axis, size)
        entered = _entered(place, start[segment], end[segment])
        entered[:, axis] = torch.where(forward, line, line - 1)
        segments.append(segment)
        places.append(entered)
        if touching:
            for along in (line, line - 1):
                for apart in (-TOUCH, TOUCH):
                    beside = (place + apart).floor().long()
                    beside[:, axis] = along
                    segments.append(segment)
                    places.append(beside)
    segment, place = torch.cat(segments), torch.cat(places)
    inside = ((place >= 0) & (place < torch.tensor(sizes))).all(-1)
    strides = torch.tensor([1, *sizes[:-1]]).cumprod(0)
    return segment[inside], (place[inside] * strides).sum(-1)


def _entered(
    place: Float64[Tensor, "M D"], start: Float64[Tensor, "M D"], end: Float64[Tensor, "M D"]
) -> Int64[Tensor, "M D"]:
    """Return the cells that segments go on in from places: on a line it is the lower one for those that go down."""
    down = (place.ceil() - 1).clamp_min(end.floor())
    return torch.where(end < start, down, place.floor()).long()


def _crossings(
    start: Float64[Tensor, "N D"], end: Float64[Tensor, "N D"], axis: int, size: int
) -> tuple[Int64[Tensor, "M"], Float64[Tensor, "M D"], Int64[Tensor, "M"], Bool[Tensor, "M"]]:
    """Return segment, place, line and direction of every crossing of the lines 0 .. size across an axis."""
    a, b = start[:, axis], end[:, axis]
    # a line at the near end is not crossed forwards, one at the far end is: [c, c + 1) holds its lower edge
    first = (torch.minimum(a, b).floor() + 1).clamp(0, size + 1).long()
    last = torch.maximum(a, b).floor().clamp(-1, size).long()
    count = (last - first + 1).clamp_min(0)
    segment = torch.repeat_interleave(torch.arange(len(a)), count)
    line = first[segment] + torch.arange(len(segment)) - (count.cumsum(0) - count)[segment]
    s, e = start[segment], end[segment]
    share = (line.double() - s[:, axis]) / (e[:, axis] - s[:, axis])
    place = s + share[:, None] * (e - s)
    place = torch.minimum(torch.maximum(place, torch.minimum(s, e)), torch.maximum(s, e))  # rounding stays inside
    return segment, place, line, e[:, axis] > s[:, axis]
