"""With a depth sensor the odometry is in metres from its first frame, and goes on where the sensor sees nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchvo360 import lie
from torchvo360.checks import InputError
from torchvo360.data import Frame
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.evaluation import evaluate
from torchvo360.vo import SENSOR, OdometryConfig, State, VisualOdometry

PINHOLE = {"camera": "pinhole", "width": 240, "height": 180, "frames": 36, "depth_noise": 0.01, "depth_holes": 0.3}
PANORAMA = {"width": 256, "height": 128, "frames": 30, "depth_noise": 0.01, "depth_holes": 0.5}


def walk(**settings) -> SyntheticSequence:
    return SyntheticSequence(SyntheticConfig(**settings))


def run(sequence: SyntheticSequence, frames: list[Frame], config: OdometryConfig | None = None):
    odometry = VisualOdometry(sequence.camera, config)
    online = [odometry.step(frame) for frame in frames]
    result = odometry.finish()
    figures = evaluate(result.trajectory, sequence.truth, align="se3")
    return online, figures, evaluate(result.trajectory, sequence.truth).scale


@pytest.fixture(scope="module")
def room() -> tuple[SyntheticSequence, list[Frame]]:
    sequence = walk(**PINHOLE)
    return sequence, list(sequence)


def test_a_pinhole_with_a_depth_sensor_gives_metres_from_the_first_frame(room):
    online, figures, scale = run(*room)
    assert {estimate.state for estimate in online} == {State.TRACKING}
    assert online[0].reason == SENSOR
    assert abs(scale - 1) < 0.005
    assert figures.ate_percent < 0.3
    moved = torch.stack([estimate.T_world_cam[:3, 3] for estimate in online]).diff(dim=0).norm(dim=1)
    true = room[0].truth.T_world_cam[:, :3, 3].diff(dim=0).norm(dim=1)
    assert abs(float(moved.sum() / true.sum()) - 1) < 0.03


@pytest.mark.parametrize("settings", [{**PINHOLE, "world": "courtyard", "exposure": "steps"}, PANORAMA])
def test_any_camera_and_any_world_are_in_metres(settings):
    sequence = walk(**settings)
    online, figures, scale = run(sequence, list(sequence))
    assert {estimate.state for estimate in online} == {State.TRACKING}
    assert abs(scale - 1) < 0.005
    assert figures.ate_percent < 0.4


def test_a_camera_that_only_turns_away_from_all_it_knows_is_not_lost():
    sequence = walk(**{**PINHOLE, "frames": 60, "motion": "turn_first", "depth_holes": 0.0})
    online, _, _ = run(sequence, list(sequence))
    R, R_true = (torch.stack(list(T))[:, :3, :3] for T in ([e.T_world_cam for e in online], sequence.truth.T_world_cam))
    turned = lie.so3_angle(R_true[0].mT @ R_true).rad2deg()
    assert float(turned.max()) > 90, "farther than its view"
    assert {estimate.state for estimate in online} == {State.TRACKING}
    off = lie.so3_angle((R_true[0].mT @ R_true).mT @ R).rad2deg()
    assert float(off.max()) < 0.3


@pytest.mark.parametrize("nothing", [None, 0.0, np.nan])
def test_frames_without_depth_are_tracked_as_if_there_were_no_sensor(room, nothing):
    sequence, frames = room
    depth = None if nothing is None else np.full((180, 240), nothing, np.float32)
    blind = [replace(f, depth=depth) if f.index % 3 == 1 or 10 < f.index < 24 else f for f in frames]
    online, figures, scale = run(sequence, blind)
    assert {estimate.state for estimate in online} == {State.TRACKING}
    assert abs(scale - 1) < 0.01
    assert figures.ate_percent < 0.5


def test_frames_before_the_first_depth_are_placed_once_it_comes(room):
    sequence, frames = room
    online, figures, scale = run(sequence, [replace(f, depth=None) if f.index < 3 else f for f in frames])
    assert [estimate.state for estimate in online[:4]] == [State.INITIALISING] * 3 + [State.TRACKING]
    assert online[3].reason == SENSOR
    assert abs(scale - 1) < 0.01
    assert figures.ate_percent < 0.5
    torch.testing.assert_close(
        online[-1].T_world_cam[:3, 3],
        (torch.linalg.inv(sequence.pose(0)) @ sequence.pose(len(sequence) - 1))[:3, 3],
        rtol=0,
        atol=0.03,
    )


def test_a_map_after_a_loss_is_in_metres_at_once(room):
    sequence, frames = room
    other = walk(**{**PINHOLE, "world": "courtyard", "seed": 3, "frames": 16})
    given = [*frames[:6], *other]
    odometry = VisualOdometry(sequence.camera, OdometryConfig(restart_after=3))
    online = [odometry.step(replace(frame, index=at, t_ns=at * 33_333_333)) for at, frame in enumerate(given)]
    assert [estimate.state for estimate in online[6:8]] == [State.LOST] * 2
    again = next(at for at, estimate in enumerate(online) if estimate.reason == "new_map")
    assert again < 10
    T, true = odometry.finish().trajectory.T_world_cam[again:], other.truth.T_world_cam[again - 6 :]
    steps = [pose[:, :3, 3].diff(dim=0).norm(dim=1).sum() for pose in (T, true)]
    assert abs(float(steps[0] / steps[1]) - 1) < 0.03


@pytest.mark.parametrize(
    ("depth", "complaint"),
    [
        (np.ones((90, 120), np.float32), r"depth: expected metres of shape \[180, 240\] of float32, got \[90, 120\]"),
        (np.ones((180, 240), np.uint16), r"got \[180, 240\] of uint16"),
        (np.ones((180, 240), np.float64), "of float64"),
        ("depth.png", "of str"),
    ],
)
def test_depth_that_is_not_the_cameras_is_refused_by_name(room, depth, complaint):
    sequence, frames = room
    with pytest.raises(InputError, match=complaint):
        VisualOdometry(sequence.camera).step(replace(frames[0], depth=depth))
