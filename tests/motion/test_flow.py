"""Corners and their tracks: across the seam, checked backwards, and where there is nothing to follow."""

import cv2
import numpy as np
import pytest
import torch

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.data.synthetic import make_world
from torchvo360.data.synthetic.motion import trajectory
from torchvo360.motion.flow import bearings, find_corners, follow

CAMERA = Equirectangular(512, 256)
EVERYWHERE = np.ones((256, 512), bool)


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    world = make_world("room", seed=1)
    pose = trajectory("still", world.walkway, 1, 30.0, seed=1)
    colour = world.render(CAMERA, pose)[0][0].mul(255).byte().permute(1, 2, 0).numpy()
    return cv2.GaussianBlur(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY), (5, 5), 0.8)


@pytest.mark.parametrize("shift", [3, -7, 25])
def test_corners_are_followed_across_the_seam(image, shift):
    corners = find_corners(image, CAMERA, 800, EVERYWHERE)
    end, ok = follow(image, np.roll(image, shift, 1), corners, CAMERA)
    inner = (corners[:, 1] > 12) & (corners[:, 1] < 244)
    assert ok[inner].mean() > 0.9
    expected = (corners[:, 0] + shift) % 512
    error = (end[:, 0] - expected + 256) % 512 - 256
    assert np.median(np.abs(error[ok])) < 0.05
    assert (np.abs(error[ok]) < 0.5).mean() > 0.98
    assert np.median(np.abs(end[ok, 1] - corners[ok, 1])) < 0.05
    crossed = np.abs(end[:, 0] - corners[:, 0]) > 256
    assert (ok & crossed).sum() >= 3
    assert (np.abs(error[ok & crossed]) < 0.5).all()
    assert ((end[ok, 0] >= 0) & (end[ok, 0] <= 512)).all()


def test_corners_are_continuous_pixels_on_usable_places(image):
    usable = EVERYWHERE.copy()
    usable[:, 100:400] = False
    corners = find_corners(image, CAMERA, 300, usable)
    assert 20 < len(corners) <= 300
    column, row = np.floor(corners).astype(int).T
    assert usable[row, column].all()
    # one bright square: its outer corners lie half a pixel outside the centres of its pixels
    square = np.zeros((256, 512), np.uint8)
    square[100:120, 200:220] = 255
    found = find_corners(square, CAMERA, 4, EVERYWHERE)
    middle = found.mean(0)
    np.testing.assert_allclose(middle, [210, 110], atol=0.51)


def test_a_track_that_does_not_come_back_is_dropped(image):
    corners = find_corners(image, CAMERA, 500, EVERYWHERE)
    noise = np.random.default_rng(0).integers(0, 255, image.shape, dtype=np.uint8)
    _, ok = follow(image, noise, corners, CAMERA)
    assert ok.mean() < 0.1
    half = image.copy()
    half[:, 256:] = noise[:, 256:]
    _, ok = follow(image, half, corners, CAMERA)
    left = (corners[:, 0] > 20) & (corners[:, 0] < 236)
    assert ok[left].mean() > 0.9
    assert ok[(corners[:, 0] > 276) & (corners[:, 0] < 492)].mean() < 0.1


def test_a_blank_image_has_no_corners_and_none_are_followed(image):
    blank = np.full_like(image, 90)
    corners = find_corners(blank, CAMERA, 100, EVERYWHERE)
    assert corners.shape == (0, 2)
    end, ok = follow(blank, image, corners, CAMERA)
    assert end.shape == (0, 2)
    assert ok.shape == (0,)
    assert bearings(end, CAMERA).shape == (0, 3)
    assert find_corners(image, CAMERA, 100, ~EVERYWHERE).shape == (0, 2)


def test_corners_that_leave_a_pinhole_s_image_are_dropped(image):
    camera = Pinhole(512, 256, 300.0, 300.0, 256.0, 128.0)
    corners = find_corners(image, camera, 500, EVERYWHERE)
    shifted = np.concatenate([image[:, 25:], np.full((256, 25), 128, np.uint8)], 1)
    end, ok = follow(image, shifted, corners, camera)
    assert not ok[corners[:, 0] < 20].any()
    np.testing.assert_allclose(np.median((end - corners)[ok], axis=0), [-25, 0], atol=0.05)


@pytest.mark.parametrize("camera", [CAMERA, Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)], ids=["sphere", "pinhole"])
def test_bearings_are_unit_rays_of_their_pixels(camera):
    corners = np.array([[0.0, 10.0], [31.5, 20.0], [63.9, 47.0]], np.float32)
    ray = bearings(corners, camera)
    assert ray.dtype == torch.float64
    torch.testing.assert_close(ray.norm(dim=-1), torch.ones(3, dtype=torch.float64))
    uv, valid = camera.project(ray)
    assert bool(valid.all())
    np.testing.assert_allclose(uv.numpy(), corners, atol=1e-4)
