"""Smoothing a finished trajectory: nearer to the truth where frames err by themselves, and nothing made up."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.motion import PoseFilterConfig
from torchvo360.vo import FrameEstimate, State
from torchvo360.vo.smooth import smoothed

N = 60
SIGMA = torch.tensor([5e-3] * 3 + [2e-3] * 3, dtype=torch.float64)
CALM = PoseFilterConfig(acceleration=0.05, turn_acceleration=0.05)


def true_poses() -> Tensor:
    """A camera that goes on and turns evenly."""
    twist = torch.tensor([0.02, 0.0, 0.03, 0.0, 0.01, 0.0], dtype=torch.float64)
    return lie.se3_exp(torch.arange(N, dtype=torch.float64)[:, None] * twist)


def estimates(scale: float = 1.0) -> list[FrameEstimate]:
    """The same with errors of every frame's own, in a map whose unit is `scale` units of the world."""
    noise = torch.randn(N, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * SIGMA
    noise[:, :3] *= scale
    T_cam_world = lie.se3_inverse(true_poses())
    T_cam_world[:, :3, 3] *= scale
    poses = lie.se3_inverse(lie.se3_exp(noise) @ T_cam_world)
    return [
        FrameEstimate(at, at * 33_333_333, T, State.TRACKING, "ok", 0.01, 0.9, 0.0, 0.0, 1.0, torch.diag(SIGMA**2))
        for at, T in enumerate(poses)
    ]


def error(frames: list[FrameEstimate], scale: float = 1.0) -> float:
    found = torch.stack([frame.T_world_cam[:3, 3] for frame in frames])
    return float((found / scale - true_poses()[:, :3, 3]).norm(dim=1).square().mean().sqrt())


def test_errors_of_single_frames_are_evened_out():
    frames = estimates()
    assert error(smoothed(frames, {}, CALM)) < 0.5 * error(frames)


def test_it_makes_no_difference_in_which_unit_the_world_is():
    scales = dict.fromkeys(range(N), 40.0)
    large, small = smoothed(estimates(40.0), scales, CALM), smoothed(estimates(), {}, CALM)
    for a, b in zip(large, small, strict=True):
        torch.testing.assert_close(a.T_world_cam[:3, 3] / 40, b.T_world_cam[:3, 3], rtol=0, atol=1e-9)
        torch.testing.assert_close(a.T_world_cam[:3, :3], b.T_world_cam[:3, :3], rtol=0, atol=1e-9)


def test_frames_that_were_not_tracked_come_between_their_neighbours():
    frames = estimates()
    for at in range(20, 25):
        aside = frames[at].T_world_cam.clone()
        aside[:3, 3] += 3.0
        state, covariance = (State.WEAK, None) if at < 22 else (State.LOST, frames[at].covariance)
        frames[at] = replace(frames[at], T_world_cam=aside, state=state, covariance=covariance)
    assert error(smoothed(frames, {}, CALM)) < 5e-3


def test_frames_before_the_first_that_was_tracked_stay_and_so_do_all_without_two():
    frames = [replace(frame, covariance=None) if frame.index < 10 else frame for frame in estimates()]
    out = smoothed(frames, {}, CALM)
    assert all(a is b for a, b in zip(out[:10], frames[:10], strict=True))
    assert not torch.equal(out[10].T_world_cam, frames[10].T_world_cam)
    none = [replace(frame, covariance=torch.full((6, 6), math.inf)) for frame in frames[:-1]] + [frames[-1]]
    assert smoothed(none, {}, CALM) is none
