"""The odometry finds the intrinsics that its frames were taken with, while it runs."""

import pytest
import torch

from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.evaluation import evaluate
from torchvo360.vo import OdometryConfig, VisualOdometry
from torchvo360.window import WindowConfig


def run(settings: dict, share: tuple[float, ...], *, calibrate: bool):
    sequence = SyntheticSequence(SyntheticConfig(**settings))
    true = torch.tensor(sequence.camera.intrinsics, dtype=torch.float64)
    camera = sequence.camera.recalibrated(*(true * (1 + torch.tensor(share, dtype=torch.float64))).tolist())
    odometry = VisualOdometry(camera, OdometryConfig(window=WindowConfig(calibrate=calibrate)))
    for frame in sequence:
        odometry.step(frame)
    result = odometry.finish()
    error = (
        None if result.intrinsics is None else 100 * (torch.tensor(result.intrinsics, dtype=torch.float64) / true - 1)
    )
    return error, evaluate(result.trajectory, sequence.truth)


def test_a_panorama_two_percent_off_is_put_right():
    settings = {"width": 512, "height": 256, "frames": 50}
    error, right = run(settings, (0.0, 0.02, 0.0, 0.02), calibrate=True)
    assert error is not None
    assert float(error.abs().max()) < 0.15
    none, wrong = run(settings, (0.0, 0.02, 0.0, 0.02), calibrate=False)
    assert none is None
    assert right.rpe_translation_percent < 0.5 * wrong.rpe_translation_percent


@pytest.mark.slow
@pytest.mark.parametrize("world", ["room", "courtyard"])
def test_a_pinhole_two_percent_off_is_put_right(world):
    settings = {"camera": "pinhole", "width": 640, "height": 480, "frames": 150, "world": world}
    error, _ = run(settings, (0.02, -0.02, 0.02, -0.02), calibrate=True)
    assert error is not None
    # Measured: focal lengths 0.27 % off at most, the centre 0.04 %; a window from the truth reaches 0.1 % and 0.03 %.
    assert float(error[[2, 3]].abs().max()) < 0.1
    assert float(error[:2].abs().max()) < 0.5


def test_a_map_that_is_taken_back_leaves_no_intrinsics_behind():
    """A start that is lost before it is confirmed was a wrong one, and so are the intrinsics it led to."""
    sequence = SyntheticSequence(SyntheticConfig(width=256, height=128, frames=1))
    odometry = VisualOdometry(sequence.camera, OdometryConfig(window=WindowConfig(calibrate=True)))
    given = sequence.frame(0)
    assert given.image is not None
    fx, fy, cx, cy = sequence.camera.intrinsics
    builder = odometry._builder
    builder.recalibrate(torch.tensor([fx, 1.1 * fy, cx, cy], dtype=torch.float64))
    frame = odometry._as_before(builder.build(given.image, 0, 0))
    assert frame.targets[0].camera.intrinsics == pytest.approx((fx, fy, cx, cy))
    assert builder.cameras[0].intrinsics == pytest.approx((fx, fy, cx, cy))
