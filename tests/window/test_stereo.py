"""Static stereo gives a window the metre, whatever scale it begins with, and is refused where it is wrong."""

import math
from dataclasses import replace

import pytest
import torch
from window_scenes import Scene, scene

from torchvo360 import lie
from torchvo360.checks import InputError
from torchvo360.window import Window, WindowConfig
from torchvo360.window.stereo import Other, fit_brightness

PLACES = (0, 8, 16)
CONFIG = WindowConfig(steps=40, tolerance=1e-7)


def pair(**settings: object) -> Scene:
    return scene(*PLACES, stereo_baseline=0.2, **settings)


def misscaled(truth: Scene, factor: float, config: WindowConfig = CONFIG) -> Window:
    """A window in which everything is a factor too far away, which only stereo can know."""
    window = truth.window(config)
    window.frames = [
        replace(f, T_cam_world=lie.se3(f.T_cam_world[:3, :3], f.T_cam_world[:3, 3] * factor)) for f in window.frames
    ]
    assert window.points is not None
    window.points.rho = window.points.rho / factor
    return window


def scale(window: Window, truth: Scene) -> float:
    lengths = [
        float(f.T_cam_world[:3, 3].norm() / T[:3, 3].norm())
        for f, T in zip(window.frames, truth.T_cam_world, strict=True)
        if float(T[:3, 3].norm()) > 0
    ]
    return sum(lengths) / len(lengths)


@pytest.mark.parametrize(
    "settings",
    [{"stereo_axis": "x"}, {"stereo_axis": "y"}, {"camera": "pinhole", "width": 320, "height": 240}],
    ids=["x", "y", "pinhole"],
)
@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_the_baseline_gives_the_metre(settings, factor):
    truth = pair(**settings)
    window = misscaled(truth, factor)
    window.optimise()
    # At 256 x 128; at 512 x 256 a fifth of it.
    assert abs(scale(window, truth) - 1) < 0.012
    alone = misscaled(truth, factor, replace(CONFIG, stereo_coupling=0.0))
    alone.hold_scale()
    alone.optimise()
    assert abs(scale(alone, truth) - factor) < 0.01


def test_a_keyframe_without_its_second_image_is_adjusted_by_the_others():
    truth = pair()
    window = misscaled(truth, 1.05)
    window.frames[1] = replace(window.frames[1], others=(None,))
    window.frames[2] = replace(window.frames[2], others=())
    window.optimise()
    assert abs(scale(window, truth) - 1) < 0.01


def test_second_images_of_something_else_are_refused_by_their_thresholds():
    truth = pair()
    window = truth.window(CONFIG)
    target = window.frames[1].others[0]
    assert target is not None
    g = torch.Generator().manual_seed(0)
    noise = replace(target, padded=torch.rand(target.padded.shape, generator=g))
    window.frames[1] = replace(window.frames[1], others=(noise,))
    window.optimise()
    assert abs(scale(window, truth) - 1) < 0.01


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.7, 0.05), (1.3, -0.04)])
def test_another_exposure_of_the_second_camera_is_found(gain, offset):
    truth = pair()
    window = truth.window(CONFIG)
    for place, frame in enumerate(window.frames):
        target = frame.others[0]
        assert target is not None
        other = replace(target, padded=target.padded * gain + offset, saturation=None)
        window.frames[place] = replace(frame, others=(other,))
    assert window.points is not None
    for other in window.others(window.points):
        a, b = other.affine.tolist()
        # Interpolation takes some contrast, which the fit sees as a gain of 0.97.
        assert abs(a - math.log(gain)) < 0.05
        assert abs(b - offset) < 0.025
    window.optimise()
    assert abs(scale(window, truth) - 1) < 0.005


def test_without_points_the_exposures_are_one():
    truth = pair()
    none = truth.points(0, 200, CONFIG).take(torch.zeros(0, dtype=torch.long))
    target = truth.frames[0].others[0]
    assert target is not None
    other = Other(0, target, truth.builder.T_other_first[0], torch.zeros(2, dtype=torch.float64))
    assert fit_brightness(other, none, CONFIG) == other


def test_marginalised_stereo_keeps_the_metre():
    truth = pair()
    window = truth.window(CONFIG)
    window.optimise()
    before = scale(window, truth)
    window.drop_frame(0)
    window.frames = [replace(frame, others=()) for frame in window.frames]
    poses = torch.stack([frame.T_cam_world for frame in window.frames])
    window.frames = [
        replace(f, T_cam_world=lie.se3(f.T_cam_world[:3, :3], f.T_cam_world[:3, 3] * 1.03)) for f in window.frames
    ]
    window.optimise()
    after = torch.stack([frame.T_cam_world for frame in window.frames])
    assert abs(before - 1) < 0.005
    assert float((after - poses).abs().max()) < 2e-3 < float((0.03 * poses[:, :3, 3]).norm(dim=1).max())


def test_a_rig_is_not_calibrated():
    with pytest.raises(InputError, match="calibrate: expected False with a rig"):
        Window(WindowConfig(calibrate=True), pair().builder.T_other_first)
