"""The window finds the intrinsics that its images were taken with."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from window_scenes import Scene, perturbed, scene

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.window import Window, WindowConfig
from torchvo360.window.calibration import HELD, at_intrinsics, prior_weights

PLACES = (0, 14, 28, 42, 56, 70, 84)
CONFIG = WindowConfig(calibrate=True, steps=20, tolerance=1e-5)


@cache
def off(truth: Scene, share: tuple[float, float, float, float]) -> Window:
    """An adjusted window whose camera erred by shares of each parameter, and its poses and ranges as well."""
    true = torch.tensor(truth.camera.intrinsics, dtype=torch.float64)
    wrong = true * (1 + torch.tensor(share, dtype=torch.float64))
    window = truth.window(CONFIG, 400, at_intrinsics(truth.camera, wrong))
    perturbed(window, 0, 0.005, 0.002, 0.02)
    window.hold_scale()
    for _ in range(3):
        # Points that were out of place at first are outliers no longer.
        window.optimise()
    return window


def errors_percent(window: Window, truth: Scene) -> torch.Tensor:
    assert window.intrinsics is not None
    true = torch.tensor(truth.camera.intrinsics, dtype=torch.float64)
    return 100 * (window.intrinsics / true - 1)


def test_a_pinholes_intrinsics_come_back_from_two_percent():
    truth = scene(*PLACES, camera="pinhole", width=640, height=480)
    error = errors_percent(off(truth, (0.02, -0.02, 0.02, -0.02)), truth)
    assert float(error[[0, 2, 3]].abs().max()) < 0.1
    assert abs(float(error[1])) < 0.25


def test_a_panoramas_vertical_ones_come_back_and_the_others_are_held():
    truth = scene(*PLACES, width=512, height=256)
    error = errors_percent(off(truth, (0.0, 0.02, 0.0, -0.02)), truth)
    assert float(error[[1, 3]].abs().max()) < 0.1
    assert float(error[[0, 2]].abs().max()) < 1e-6


def test_two_keyframes_do_not_move_the_intrinsics():
    truth = scene(*PLACES[:2], camera="pinhole", width=320, height=240)
    window = truth.window(CONFIG, 300)
    perturbed(window, 0, 0.005, 0.002, 0.05)
    window.hold_scale()
    window.optimise()
    assert float(errors_percent(window, truth).abs().max()) < 1e-6


def test_points_and_keyframes_follow_the_intrinsics():
    truth = scene(*PLACES[:4], camera="pinhole", width=320, height=240)
    window = off(truth, (0.01, 0.01, 0.0, 0.0))
    assert window.intrinsics is not None
    assert window.points is not None
    camera = window.frames[0].target.camera
    assert camera.intrinsics == tuple(window.intrinsics.tolist())
    uv = torch.stack(camera.pixel_of(*window.points.ray))
    torch.testing.assert_close(uv, window.points.uv, atol=1e-3, rtol=0)


def test_intrinsics_stay_right_when_keyframes_leave():
    truth = scene(*PLACES, width=512, height=256)
    window = replace(off(truth, (0.0, 0.02, 0.0, -0.02)))
    for _ in range(4):
        window.drop_frame(0)
        window.optimise()
    assert float(errors_percent(window, truth).abs().max()) < 0.1


def test_too_few_keyframes_for_it_are_refused():
    with pytest.raises(InputError, match="keyframes: expected at least 4 with calibrate, got 3"):
        WindowConfig(calibrate=True, keyframes=3)


@pytest.mark.parametrize(
    ("camera", "held"),
    [
        (Pinhole(640, 480, 300.0, 310.0, 320.0, 240.0), []),
        (Equirectangular(512, 256), [0, 2]),
        (Equirectangular(512, 256, 512 / 6.283185307, -80.0, 256.0, 130.0), [0, 2]),
        (Equirectangular(300, 200, 100.0, -100.0, 150.0, 100.0), [2]),
    ],
)
def test_what_images_cannot_say_is_held(camera, held):
    weights = prior_weights(camera, young=False)
    assert [i for i in range(4) if float(weights[i]) == HELD] == held
    assert bool((prior_weights(camera, young=True) == HELD).all())
