"""Keyframes in the making: the same bits with a second thread and without, errors that arrive, losses in between."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvo360.data.frame import Frame
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.vo import OdometryConfig, State, VisualOdometry
from torchvo360.vo.keyframes.keyframe import MapConfig
from torchvo360.vo.keyframes.mapper import Mapper

SEQUENCE = SyntheticSequence(SyntheticConfig(width=256, height=128, frames=60, seed=2))


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(SEQUENCE)


def config(*, overlap: bool, lag: float = 0.5) -> OdometryConfig:
    return OdometryConfig(blur_px=0.5, overlap=overlap, map=MapConfig(lag=lag))


def run(frames: list[Frame], settings: OdometryConfig, *, look_at: int = -1) -> tuple[Tensor, Tensor, Tensor]:
    """Poses as given out, final poses and the map's points."""
    odometry, online = VisualOdometry(SEQUENCE.camera, settings), []
    with torch.inference_mode():
        for frame in frames:
            online.append(odometry.step(frame).T_world_cam)
            if frame.index == look_at:
                odometry.finish()
        result = odometry.finish()
    return torch.stack(online), result.trajectory.T_world_cam, result.points.xyz


def test_a_second_thread_changes_no_bit(frames):
    at_once, beside = (run(frames, config(overlap=overlap)) for overlap in (False, True))
    for one, other in zip(at_once, beside, strict=True):
        assert torch.equal(one, other)


def test_a_look_at_the_result_in_between_changes_no_bit(frames):
    plain, looked = (
        run(frames, config(overlap=True)),
        [run(frames, config(overlap=True), look_at=at) for at in (20, 21)],
    )
    for each in looked:
        assert torch.equal(plain[1], each[1])


def test_lag_changes_when_points_are_there_and_hardly_where_the_camera_was(frames):
    now, later = (run(frames, config(overlap=False, lag=lag)) for lag in (0.0, 0.5))
    assert not torch.equal(now[0], later[0])
    path = (now[1][1:, :3, 3] - now[1][:-1, :3, 3]).norm(dim=1).sum()
    assert (now[1][:, :3, 3] - later[1][:, :3, 3]).norm(dim=1).max() < 2e-3 * path


def test_an_error_of_the_mapper_arrives_in_a_step(frames, monkeypatch):
    def fails(mapper: Mapper) -> None:
        raise RuntimeError("a mapper's own")

    monkeypatch.setattr(Mapper, "finish_keyframe", fails)
    with pytest.raises(RuntimeError, match="a mapper's own"):
        run(frames, config(overlap=True))


@pytest.mark.parametrize("overlap", [False, True])
def test_a_loss_while_a_keyframe_is_made_keeps_the_keyframe(frames, overlap):
    odometry, made = VisualOdometry(SEQUENCE.camera, config(overlap=overlap)), []
    black = np.zeros((128, 256, 3), np.uint8)
    with torch.inference_mode():
        for frame in frames:
            follower = odometry._follower
            if not made and follower is not None and follower.making is not None and frame.index > 20:
                made.append(follower.key.index)
            shown = replace(frame, image=black) if made and len(made) < 4 else frame
            if made:
                made.append(frame.index)
            estimate = odometry.step(shown)
        result = odometry.finish()
    assert estimate.state in (State.TRACKING, State.RELOCALISED)
    assert made[0] in odometry._atlas.keyframes()
    assert torch.isfinite(result.trajectory.T_world_cam).all()
