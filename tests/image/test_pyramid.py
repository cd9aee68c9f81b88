"""Levels keep the mean, the sphere and the place of every pixel."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.image import blur, level_camera, masked_pyramid, pyramid, resample

SPHERE = Equirectangular(32, 16)
PLANE = Pinhole(32, 24, 30.0, 28.0, 15.0, 12.5)


def noise(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)


@pytest.mark.parametrize("camera", [SPHERE, PLANE], ids=["sphere", "pinhole"])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)], ids=str)
def test_a_level_is_the_mean_of_four_pixels(camera, batch):
    image = noise(*batch, camera.height, camera.width)
    levels = pyramid(image, camera, 3)
    assert levels[0][1] is image
    for (_, fine), (small, coarse) in pairwise(levels):
        expected = sum(fine[..., i::2, j::2] for i in (0, 1) for j in (0, 1)) / 4
        torch.testing.assert_close(coarse, expected, atol=1e-14, rtol=0)
        assert coarse.shape == (*batch, small.height, small.width)


@pytest.mark.parametrize("camera", [SPHERE, PLANE], ids=["sphere", "pinhole"])
def test_a_pixel_at_uv_lies_at_half_of_uv_on_the_next_level(camera):
    uv = noise(50, 2) * torch.tensor([camera.width, camera.height])
    torch.testing.assert_close(level_camera(camera, 1).ray(uv / 2), camera.ray(uv), atol=1e-12, rtol=0)
    torch.testing.assert_close(level_camera(camera, 2).ray(uv / 4), camera.ray(uv), atol=1e-12, rtol=0)


def test_sizes_that_do_not_halve_keep_the_whole_sphere_and_an_even_width():
    camera = Equirectangular(642, 322)
    for level in range(1, 5):
        small = level_camera(camera, level)
        assert small.wraps
        assert small.width % 2 == 0
        assert abs(small.width - 642 / 2**level) <= 1
    image = noise(322, 642)
    for small, value in pyramid(image, camera, 5):
        assert value.shape == (small.height, small.width)
        torch.testing.assert_close(value.mean(), image.mean(), atol=5e-3, rtol=0)


def test_the_area_mean_equals_opencvs():
    camera, small = Equirectangular(60, 30), Equirectangular(26, 13)
    image = cv2.GaussianBlur(noise(30, 60).numpy(), (0, 0), 3)
    expected = cv2.resize(image, (26, 13), interpolation=cv2.INTER_AREA)
    # torch's area mode takes whole pixels, OpenCV's shares of them: alike for images that are smooth.
    actual = resample(torch.from_numpy(image), small)
    assert np.abs(actual.numpy() - expected).max() < 0.02
    assert torch.equal(resample(torch.from_numpy(image), camera), torch.from_numpy(image))


@pytest.mark.parametrize("sigma", [0.5, 0.7, 1.6])
def test_blur_equals_opencvs_gaussian_inside(sigma):
    image = noise(24, 32)
    radius = max(1, round(3 * sigma))
    expected = cv2.GaussianBlur(image.numpy(), (2 * radius + 1,) * 2, sigma, borderType=cv2.BORDER_REPLICATE)
    torch.testing.assert_close(blur(image, PLANE, sigma), torch.from_numpy(expected), atol=1e-12, rtol=0)


@pytest.mark.parametrize("k", [1, 7, 16])
def test_blur_and_levels_commute_with_rolling(k):
    image = noise(16, 32)
    torch.testing.assert_close(
        blur(image.roll(k, -1), SPHERE, 1.0), blur(image, SPHERE, 1.0).roll(k, -1), atol=1e-14, rtol=0
    )
    turned = pyramid(image.roll(2 * k, -1), SPHERE, 2)[1][1]
    torch.testing.assert_close(turned, pyramid(image, SPHERE, 2)[1][1].roll(k, -1), atol=1e-14, rtol=0)


def test_blur_of_an_upside_down_panorama_is_the_upside_down_blur():
    # Half a turn about the forward axis maps (u, v) to (-u, -v): poles must be treated alike.
    image = noise(16, 32)
    turned = blur(image.flip(-1, -2), SPHERE, 1.0)
    torch.testing.assert_close(turned, blur(image, SPHERE, 1.0).flip(-1, -2), atol=1e-14, rtol=0)
    # A tilt by 180 deg about the right axis goes over both poles: (u, v) -> (u + w / 2 mirrored back, -v).
    over = image.flip(-2).roll(16, -1)
    torch.testing.assert_close(
        blur(over, SPHERE, 1.0), blur(image, SPHERE, 1.0).flip(-2).roll(16, -1), atol=1e-14, rtol=0
    )


def test_no_blur_leaves_the_image_as_it_is():
    image = noise(16, 32)
    assert blur(image, SPHERE, 0.0) is image


def test_levels_of_a_masked_image_are_means_of_what_is_known():
    camera = Equirectangular(8, 4)
    value = noise(2, 4, 8)
    known = noise(4, 8, 2).permute(2, 0, 1) > 0.4
    value[~known] = torch.nan
    levels = masked_pyramid(value, known, [level_camera(camera, level) for level in range(3)])
    assert torch.equal(levels[0][1], known)
    for level, (mean, certain) in enumerate(levels):
        size = 2**level
        cells = value.reshape(2, 4 // size, size, 8 // size, size).transpose(2, 3).flatten(3)
        share = (~cells.isnan()).double().mean(-1)
        assert torch.equal(certain, (share >= 0.5) if level else known)
        assert torch.isfinite(mean).all()
        torch.testing.assert_close(mean[certain], cells.nanmean(-1)[certain], atol=1e-12, rtol=0)
