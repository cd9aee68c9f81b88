"""Selected pixels are spread evenly over the sphere, strong, usable and the same every time."""

import math

import pytest
import torch

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import ShapeError
from torchvo360.image import equal_area_cells, one_per_cell, select_pixels

SPHERE = Equirectangular(512, 256)
PLANE = Pinhole(160, 120, 90.0, 85.0, 78.0, 61.5)
CAMERAS = pytest.mark.parametrize("camera", [SPHERE, PLANE], ids=["sphere", "pinhole"])


def noise(camera, seed: int = 0) -> torch.Tensor:
    return torch.rand(camera.height, camera.width, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("count", [100, 500, 2000])
def test_cells_of_a_panorama_have_nearly_equal_solid_angle(count):
    cells = equal_area_cells(SPHERE, count)
    area = SPHERE.solid_angle(SPHERE.pixel_grid(dtype=torch.float64))
    each = torch.zeros(int(cells.max()) + 1, dtype=torch.float64).index_add(0, cells.flatten(), area.flatten())
    assert abs(len(each) / count - 1) < 0.1
    torch.testing.assert_close(each.sum(), torch.tensor(4 * math.pi, dtype=torch.float64), rtol=1e-3, atol=0)
    # Whole rows and columns of pixels make cells: 2,000 of them hold 65 pixels each.
    assert each.std() / each.mean() < 0.25
    assert each.min() > 0.4 * each.mean()
    assert each.max() < 1.8 * each.mean()


@CAMERAS
@pytest.mark.parametrize("count", [1, 7, 300])
def test_every_cell_is_numbered_and_connected(camera, count):
    cells = equal_area_cells(camera, count)
    assert cells.shape == (camera.height, camera.width)
    assert torch.equal(cells.unique(), torch.arange(int(cells.max()) + 1))
    for cell in cells.unique().tolist()[:: max(1, count // 20)]:
        rows, columns = (cells == cell).nonzero(as_tuple=True)
        # A cell is a full rectangle of pixels.
        height, width = rows.max() - rows.min() + 1, columns.max() - columns.min() + 1
        assert len(rows) == height * width


@CAMERAS
def test_each_cell_gives_its_strongest_usable_pixel(camera):
    strength, usable = noise(camera), noise(camera, 1) > 0.3
    chosen = select_pixels(strength, usable, camera, 200, minimum=0.8)
    cells = equal_area_cells(camera, 200).flatten()
    flat = torch.where(usable, strength, -1.0).flatten()
    best = [int(flat.where(cells == cell, -2.0).argmax()) for cell in cells.unique().tolist()]
    expected = sorted(index for index in best if flat[index] >= 0.8)
    assert chosen.tolist() == expected


def test_nothing_usable_gives_nothing():
    none = torch.zeros(256, 512, dtype=torch.bool)
    assert len(select_pixels(noise(SPHERE), none, SPHERE, 100, minimum=0.0)) == 0
    assert len(select_pixels(noise(SPHERE), ~none, SPHERE, 100, minimum=2.0)) == 0
    assert len(select_pixels(noise(SPHERE) * torch.nan, ~none, SPHERE, 100, minimum=0.0)) == 0


def test_ties_go_to_the_first_pixel():
    flat = torch.ones(256, 512)
    chosen = select_pixels(flat, flat > 0, SPHERE, 100, minimum=0.5)
    cells = equal_area_cells(SPHERE, 100).flatten()
    expected = [int((cells == cell).nonzero()[0, 0]) for cell in cells.unique().tolist()]
    assert chosen.tolist() == sorted(expected)


def test_bad_input_is_named():
    with pytest.raises(ShapeError, match=r"^usable: expected shape \[256 512\], got \[256, 511\]\.$"):
        select_pixels(noise(SPHERE), torch.ones(256, 511, dtype=torch.bool), SPHERE, 10, minimum=0.0)


def test_each_cell_gives_its_cheapest_element_and_of_equals_the_first():
    cell, cost = torch.tensor([2, 0, 2, 0, 2, 5]), torch.tensor([3.0, 1.0, 1.0, 1.0, 1.0, 9.0])
    assert one_per_cell(cell, cost).tolist() == [1, 2, 5]
    assert one_per_cell(cell[:0], cost[:0]).tolist() == []
