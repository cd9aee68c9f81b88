"""Selection of pixels that are spread evenly over the sphere and carry gradient."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.checks import check_shape


def equal_area_rows(
    camera: Camera, count: int, *, device: torch.device | str = "cpu"
) -> tuple[Int64[Tensor, "H"], Int64[Tensor, "H"]]:
    """Divide every row into cells of equal width, about `count` cells of nearly equal solid angle over the image.

    A full panorama is cut into bands of latitude, and each band into as many cells as its circumference asks for.
    Other cameras are cut into squares of the image, whose solid angle varies little.

    Returns:
        first: Number of each row's first cell.
        cells: How many there are in it; pixel u lies in the cell `first + u * cells // width`.
    """
    rows = torch.arange(camera.height, device=device)
    if camera.wraps:
        side = math.sqrt(4 * math.pi / count)
        bands = max(1, round(math.pi / side))
        band = (rows * bands) // camera.height
        middle = (torch.arange(bands, dtype=torch.float64, device=device) + 0.5) / bands * math.pi
        cells = (math.tau * middle.sin() / side).round().long().clamp_min(1)
        first = torch.cat([cells.new_zeros(1), cells.cumsum(0)])
        return first[band], cells[band]
    side_px = math.sqrt(camera.width * camera.height / count)
    across = max(1, round(camera.width / side_px))
    down = max(1, round(camera.height / side_px))
    return (rows * down) // camera.height * across, torch.full_like(rows, across)


def equal_area_cells(camera: Camera, count: int, *, device: torch.device | str = "cpu") -> Int64[Tensor, "H W"]:
    """Number the pixels' cells: about `count` cells of nearly equal solid angle over the image (`equal_area_rows`)."""
    first, cells = equal_area_rows(camera, count, device=device)
    columns = torch.arange(camera.width, device=device)
    return first[:, None] + (columns * cells[:, None]) // camera.width


def cell_of(camera: Camera, count: int, pixel: Int64[Tensor, "N"]) -> Int64[Tensor, "N"]:
    """Return the cells of flat pixels, as `equal_area_cells` numbers them."""
    first, cells = equal_area_rows(camera, count, device=pixel.device)
    row = pixel // camera.width
    return first[row] + (pixel % camera.width * cells[row]) // camera.width


def select_pixels(
    strength: Float[Tensor, "H W"],
    usable: Bool[Tensor, "H W"],
    camera: Camera,
    count: int,
    *,
    minimum: float,
) -> Int64[Tensor, "N"]:
    """Choose the strongest usable pixel of each equal-area cell.

    Args:
        strength: Gradient magnitude, for instance `gradient_magnitude`.
        usable: Pixels that may be chosen.
        camera: The image's camera.
        count: Number of cells over the whole image; cells without a usable, strong pixel give none.
        minimum: Strength below which a pixel is never chosen.

    Returns:
        Flat indices in increasing order, at most one for each cell.
    """
    check_shape("strength", strength, f"{camera.height} {camera.width}")
    check_shape("usable", usable, f"{camera.height} {camera.width}")
    cell = equal_area_cells(camera, count, device=strength.device).flatten()
    flat = strength.flatten().masked_fill(~(usable & (strength >= minimum)).flatten(), -torch.inf)
    most = flat.new_full((int(cell.max()) + 1,), -torch.inf).scatter_reduce(0, cell, flat, "amax")
    best = ((flat == most[cell]) & (flat > -torch.inf)).nonzero()[:, 0]
    # Equally strong pixels of a cell: the lowest index.
    lowest = torch.full_like(most, len(flat), dtype=torch.int64).scatter_reduce(0, cell[best], best, "amin")
    return best[lowest[cell[best]] == best]


def one_per_cell(cell: Int64[Tensor, "N"], cost: Float[Tensor, "N"]) -> Int64[Tensor, "M"]:
    """Return the index of the cheapest element of each cell, by increasing cell; of equals the first."""
    by_cost = cost.argsort(stable=True)
    order = by_cost[cell[by_cost].argsort(stable=True)]
    first = torch.ones_like(order, dtype=torch.bool)
    first[1:] = cell[order][1:] != cell[order][:-1]
    return order[first]


MOST_CELLS = 4
"""The number of cells grows at most by this factor to make up for those without a usable pixel."""


def select_about(
    strength: Float[Tensor, "H W"],
    usable: Bool[Tensor, "H W"],
    camera: Camera,
    count: int,
    *,
    minimum: float,
    select: Callable[..., Int64[Tensor, "N"]] = select_pixels,
) -> Int64[Tensor, "N"]:
    """Choose about `count` pixels as `select_pixels` does: the cells become smaller where many of them give none.

    A sky, a mask or a blank wall would otherwise take its share of the points with it.

    Args:
        strength: As of `select_pixels`, as are the others.
        usable: Likewise.
        camera: Likewise.
        count: How many pixels are wanted.
        minimum: Likewise.
        select: What chooses: `select_pixels`, or what does the same faster.
    """
    pixel = select(strength, usable, camera, count, minimum=minimum)
    if not 0 < len(pixel) < 0.9 * count:
        return pixel
    cells = round(count * min(MOST_CELLS, count / len(pixel)))
    return select(strength, usable, camera, cells, minimum=minimum)
