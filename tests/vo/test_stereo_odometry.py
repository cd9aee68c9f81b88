"""With a known rig the odometry is in metres from its first frame, and says what it cannot use."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchvo360.cameras import Rig
from torchvo360.checks import InputError
from torchvo360.data import Frame
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.evaluation import evaluate
from torchvo360.vo import State, VisualOdometry

PANORAMA = {"width": 256, "height": 128, "frames": 40, "stereo_baseline": 0.2}
PINHOLE = {"camera": "pinhole", "width": 320, "height": 240, "frames": 40, "stereo_baseline": 0.1}


def walk(**settings) -> SyntheticSequence:
    return SyntheticSequence(SyntheticConfig(**settings))


@pytest.fixture(scope="module")
def panorama() -> tuple[SyntheticSequence, list[Frame]]:
    sequence = walk(**PANORAMA)
    return sequence, list(sequence)


def errors(sequence: SyntheticSequence, frames: list[Frame]):
    odometry = VisualOdometry(sequence.camera, rig=sequence.rig)
    online = [odometry.step(frame) for frame in frames]
    result = odometry.finish()
    figures = evaluate(result.trajectory, sequence.truth, align="se3")
    scale = evaluate(result.trajectory, sequence.truth).scale
    return online, figures, scale


def test_two_panoramas_give_metres_from_the_first_frame(panorama):
    online, figures, scale = errors(*panorama)
    assert {estimate.state for estimate in online} == {State.TRACKING}
    assert online[0].reason == "stereo_ranges"
    assert abs(scale - 1) < 0.01
    assert figures.ate_percent < 0.6
    moved = torch.stack([estimate.T_world_cam[:3, 3] for estimate in online]).diff(dim=0).norm(dim=1)
    true = panorama[0].truth.T_world_cam[:, :3, 3].diff(dim=0).norm(dim=1)
    assert abs(float(moved.sum() / true.sum()) - 1) < 0.05


@pytest.mark.parametrize("axis", ["x", "y"])
def test_two_pinholes_give_metres(axis):
    sequence = walk(**PINHOLE, stereo_axis=axis)
    online, figures, scale = errors(sequence, list(sequence))
    assert {estimate.state for estimate in online} == {State.TRACKING}
    assert abs(scale - 1) < 0.01
    assert figures.ate_percent < 0.6


def test_frames_whose_second_image_is_missing_are_tracked_by_the_first(panorama):
    sequence, frames = panorama
    missing = [replace(f, others=(None,)) if f.index % 3 == 1 or 10 < f.index < 25 else f for f in frames]
    online, figures, scale = errors(sequence, missing)
    assert {estimate.state for estimate in online} == {State.TRACKING}
    assert abs(scale - 1) < 0.015
    assert figures.ate_percent < 0.9


def test_until_there_is_a_second_image_there_is_no_map(panorama):
    sequence, frames = panorama
    odometry = VisualOdometry(sequence.camera, rig=sequence.rig)
    first = [odometry.step(replace(frame, others=(None,))) for frame in frames[:3]]
    assert [(e.state, e.reason) for e in first] == [(State.INITIALISING, "few_ranges")] * 3
    assert odometry.step(frames[3]).state == State.TRACKING


@pytest.mark.parametrize(
    ("others", "complaint"),
    [
        ((), "others: expected the images of the rig's 1 further cameras, got 0"),
        ((np.zeros((128, 256, 3), np.uint8),) * 2, "1 further cameras, got 2"),
        ((np.zeros((64, 128, 3), np.uint8),), r"others: expected images of shape \[128, 256, 3\] of uint8, got \[64,"),
        ((np.zeros((128, 256, 3), np.float32),), "uint8, got .* of float32"),
        (("image.png",), "uint8, got .* of str"),
    ],
)
def test_frames_that_are_not_the_rigs_are_refused_by_name(panorama, others, complaint):
    sequence, frames = panorama
    odometry = VisualOdometry(sequence.camera, rig=sequence.rig)
    with pytest.raises(InputError, match=complaint):
        odometry.step(replace(frames[0], others=others))


def test_rigs_that_are_not_the_cameras_are_refused_by_name(panorama):
    sequence, _ = panorama
    camera, rig = sequence.camera, sequence.rig
    assert rig is not None
    with pytest.raises(InputError, match=r"rig: expected .* as its first camera"):
        VisualOdometry(camera.resized(128, 64), rig=rig)
    with pytest.raises(InputError, match="apart from the first"):
        VisualOdometry(camera, rig=Rig((camera, camera), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)))
    with pytest.raises(InputError, match="rig: expected none beside a depth network"):
        VisualOdometry(camera, rig=rig, depth=torch.nn.Identity())
