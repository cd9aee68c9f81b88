"""A map of the floor in cells: which are free, which are not, and where they are."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int8, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_finite_number, check_shape

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of a cell. Source: nav_msgs/OccupancyGrid of ROS."""

MOST_CELLS = 25_000_000
"""A map of 5,000 x 5,000; more is a mistake in the resolution far sooner than a place."""


MOST_RESOLUTION = 1e6
"""Distances on any map stay finite in single precision."""


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """Cells of the floor, seen from above: x to the right, y upwards on the page; row 0 holds the lowest y."""

    states: Int8[Tensor, "H W"]
    """FREE, OCCUPIED or UNKNOWN."""
    resolution: float
    """Size of a cell, in the map's unit."""
    origin: tuple[float, float] = (0.0, 0.0)
    """x and y of the outer corner of cell (0, 0)."""

    def __post_init__(self) -> None:
        check_shape("states", self.states, "H W")
        if self.states.dtype != torch.int8 or self.states.numel() == 0:
            raise InputError(f"states: expected cells of int8, got {list(self.states.shape)} of {self.states.dtype}.")
        check_finite_number("resolution", self.resolution, above=0.0, at_most=MOST_RESOLUTION)
        for value in self.origin:
            check_finite_number("origin", value)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.states.shape[0], self.states.shape[1]

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Least x, greatest x, least y and greatest y."""
        (x, y), (rows, columns) = self.origin, self.shape
        return x, x + columns * self.resolution, y, y + rows * self.resolution

    def to_cells(self, xy: Float64[Tensor, "*batch 2"]) -> Float64[Tensor, "*batch 2"]:
        """Return continuous columns and rows of places; cell (0, 0) covers [0, 1) x [0, 1)."""
        return (xy - torch.tensor(self.origin, dtype=torch.float64)) / self.resolution

    def to_places(self, cells: Float64[Tensor, "*batch 2"]) -> Float64[Tensor, "*batch 2"]:
        """Return x and y of continuous columns and rows."""
        return cells * self.resolution + torch.tensor(self.origin, dtype=torch.float64)

    def cell_of(self, xy: tuple[float, float]) -> tuple[int, int] | None:
        """Return row and column of a place; None outside the map."""
        column, row = (math.floor(value) for value in self.to_cells(torch.tensor(xy, dtype=torch.float64)).tolist())
        rows, columns = self.shape
        return (row, column) if 0 <= row < rows and 0 <= column < columns else None

    def centres(self, row: Int64[Tensor, "N"], column: Int64[Tensor, "N"]) -> Float64[Tensor, "N 2"]:
        """Return x and y of cells' middles."""
        return self.to_places(torch.stack([column, row], -1).double() + 0.5)


def grid_around(
    xy: Float64[Tensor, "N 2"], resolution: float, margin: float
) -> tuple[tuple[float, float], tuple[int, int]]:
    """Return origin and shape of a grid that holds places with a margin, its lines at whole multiples of a cell.

    Raises:
        InputError: It would have too many cells.
    """
    low = ((xy.amin(0) - margin) / resolution).floor()
    high = ((xy.amax(0) + margin) / resolution).ceil()
    columns, rows = (high - low).clamp_min(1).tolist()
    if rows * columns > MOST_CELLS:
        least = resolution * math.sqrt(rows * columns / MOST_CELLS)
        raise InputError(f"resolution: expected at least {least:.3g} for what was seen, got {resolution:g}.")
    x, y = (low * resolution).tolist()
    return (x, y), (int(rows), int(columns))
