"""Compiled levels, gradients and selections of whole images are those of eager torch."""

import math

import numpy as np
import pytest
import torch

from torchvo360.backends import backend
from torchvo360.backends.numba import pictures
from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import ShapeError
from torchvo360.image import gradient_magnitude, level_camera, select_about, select_pixels
from torchvo360.residuals.direct import make_target

pytest.importorskip("numba")

EVERY = {
    "full": Equirectangular(128, 64),
    "rolled": Equirectangular(128, 64, cx=20.0),
    "partial": Equirectangular(96, 40, 128 / math.tau, -64 / math.pi, 40.0, 21.0),
    "over the pole": Equirectangular(96, 44, 128 / math.tau, -64 / math.pi, 40.0, 31.7),
    "pinhole": Pinhole(94, 70, 80.0, 84.0, 47.1, 36.4),
}
CAMERAS = pytest.mark.parametrize("camera", list(EVERY.values()), ids=list(EVERY))
CPU = torch.device("cpu")


def grey(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)


@CAMERAS
@pytest.mark.parametrize("blur_px", [0.0, 0.5, 1.7])
def test_levels_are_the_same_up_to_rounding_borders_included(camera, blur_px):
    cameras = [level_camera(camera, level) for level in range(4)]
    image = grey(camera.height, camera.width)
    found = pictures.padded_levels(image, cameras, blur_px, CPU)
    with backend("eager"):
        truth = pictures.padded_levels(image, cameras, blur_px, CPU)
    for level, expected in zip(found, truth, strict=True):
        torch.testing.assert_close(level, expected, rtol=0, atol=1e-6)


def test_an_image_that_is_not_contiguous_and_one_smaller_than_the_filter_are_taken():
    camera = EVERY["full"]
    image = grey(64, 256)[:, ::2]
    (found,) = pictures.padded_levels(image, [camera], 0.5, CPU)
    (again,) = pictures.padded_levels(image.copy(), [camera], 0.5, CPU)
    assert torch.equal(found, again)
    small = Pinhole(6, 4, 5.0, 5.0, 3.0, 2.0)
    assert pictures.padded_levels(grey(4, 6), [small], 3.0, CPU)[0].shape == (1, 1, 6, 8)


@CAMERAS
def test_gradients_are_as_strong(camera):
    image = torch.from_numpy(grey(camera.height, camera.width)).float() / 255
    rays = camera.ray_grid()
    found = pictures.gradient_strength(make_target(image[None, None], camera), rays)
    exact = gradient_magnitude(image.double(), camera, camera.ray_grid(dtype=torch.float64))
    torch.testing.assert_close(found.double(), exact, rtol=1e-5, atol=1e-6)


@CAMERAS
@pytest.mark.parametrize("count", [1, 40, 700])
def test_the_same_pixels_are_chosen_ties_included(camera, count):
    generator = torch.Generator().manual_seed(count)
    size = camera.height, camera.width
    # Of few steps, so that many pixels of a cell are equally strong.
    strength = torch.randint(0, 6, size, generator=generator) / 8
    strength[torch.rand(size, generator=generator) < 0.1] = torch.nan
    usable = torch.rand(size, generator=generator) < 0.5
    usable[: camera.height // 3] = False
    for minimum in (0.125, 0.3, 2.0):
        found = pictures.select_pixels(strength, usable, camera, count, minimum=minimum)
        assert torch.equal(found, select_pixels(strength, usable, camera, count, minimum=minimum))
        about = select_about(strength, usable, camera, count, minimum=minimum, select=pictures.select_pixels)
        assert torch.equal(about, select_about(strength, usable, camera, count, minimum=minimum))


def test_shapes_that_do_not_belong_together_are_refused():
    camera = EVERY["full"]
    whole, half = torch.ones(64, 128), torch.ones(32, 128, dtype=torch.bool)
    with pytest.raises(ShapeError, match="usable"):
        pictures.select_pixels(whole, half, camera, 40, minimum=0.1)
