"""Blurred images among others: found by their neighbours, whatever the brightness."""

import cv2
import numpy as np
import pytest

from torchvo360.export.sharpness import NEIGHBOURS, blurred, sharpness

PICTURE = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8), (0, 0), 0.7)


@pytest.mark.parametrize("sigma", [1.0, 2.0])
def test_blur_takes_sharpness_and_brightness_does_not(sigma):
    usual = sharpness(PICTURE)
    assert sharpness(cv2.GaussianBlur(PICTURE, (0, 0), sigma)) < 0.6 * usual
    assert sharpness((PICTURE * 0.5 + 60).astype(np.uint8)) == pytest.approx(usual, rel=0.05)
    assert sharpness(np.full((8, 16, 3), 90, np.uint8)) == 0.0


def test_an_image_is_judged_by_those_about_it():
    sharp = {10 * at: 1.0 - 0.01 * at for at in range(40)}  # the scene loses its texture slowly
    assert blurred(sharp) == set()
    assert blurred(sharp | {0: 0.5, 200: 0.4, 210: 0.4, 390: 0.3}) == {0, 200, 210, 390}
    step = {at: 1.0 if at < 20 else 0.2 for at in range(40)}
    assert blurred(step) <= set(range(20, 20 + NEIGHBOURS))


def test_a_few_images_and_none_are_never_blurred():
    assert blurred({}) == set()
    assert blurred({0: 1.0, 1: 0.1, 2: 1.0}) == set()
