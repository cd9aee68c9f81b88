"""Smoothing a finished trajectory: nearer to the truth where frames err by themselves, and nothing made up."""

import math
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.motion import PoseFilterConfig
from torchvo360.vo import FrameEstimate, State
from torchvo360.vo.smooth import Standing, smoothed

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


def standing(scale: float = 1.0) -> dict[int, Standing]:
    """All on one map."""
    return dict.fromkeys(range(N), Standing(0, scale, scale))


def error(frames: list[FrameEstimate], scale: float = 1.0) -> float:
    found = torch.stack([frame.T_world_cam[:3, 3] for frame in frames])
    return float((found / scale - true_poses()[:, :3, 3]).norm(dim=1).square().mean().sqrt())


def test_errors_of_single_frames_are_evened_out():
    frames = estimates()
    assert error(smoothed(frames, standing(), CALM)) < 0.5 * error(frames)


def test_it_makes_no_difference_in_which_unit_the_world_is():
    large, small = (smoothed(estimates(scale), standing(scale), CALM) for scale in (40.0, 1.0))
    for a, b in zip(large, small, strict=True):
        torch.testing.assert_close(a.T_world_cam[:3, 3] / 40, b.T_world_cam[:3, 3], rtol=0, atol=1e-9)
        torch.testing.assert_close(a.T_world_cam[:3, :3], b.T_world_cam[:3, :3], rtol=0, atol=1e-9)


def test_frames_that_were_not_tracked_keep_their_shape_between_their_neighbours():
    """As an IMU has carried them: only how they lie between the tracked ones changes."""
    frames, true = estimates(), true_poses()
    for at in range(20, 40):
        state, covariance = (State.WEAK, None) if at < 30 else (State.LOST, frames[at].covariance)
        frames[at] = replace(frames[at], T_world_cam=true[at].clone(), state=state, covariance=covariance)
    out = smoothed(frames, standing(), CALM)
    for a, b in pairwise(range(20, 40)):
        step, same = (lie.se3_inverse(f[a].T_world_cam) @ f[b].T_world_cam for f in (out, frames))
        torch.testing.assert_close(step, same, rtol=0, atol=2e-3)
    assert error(out) < 0.75 * error(frames)


def test_nothing_is_smoothed_over_from_a_map_to_one_that_it_is_not_joined_with():
    frames = estimates()
    aside = motion_aside()
    for at in range(30, N):
        frames[at] = replace(frames[at], T_world_cam=aside @ frames[at].T_world_cam)
    apart = {at: Standing(at // 30, 1.0, 1.0) for at in range(N)}
    out = smoothed(frames, apart, CALM)
    back = lie.se3_inverse(aside)
    joined = out[:30] + [replace(frame, T_world_cam=back @ frame.T_world_cam) for frame in out[30:]]
    assert error(joined) < 0.6 * error(estimates())


def motion_aside() -> Tensor:
    return lie.se3_exp(torch.tensor([5.0, 0.0, 0.0, 0.0, 1.0, 0.0], dtype=torch.float64))


def test_frames_that_stand_on_nothing_stay_and_so_do_all_where_fewer_than_two_were_tracked():
    frames = estimates()
    some = {at: where for at, where in standing().items() if at >= 10}
    out = smoothed(frames, some, CALM)
    assert all(a is b for a, b in zip(out[:10], frames[:10], strict=True))
    assert not torch.equal(out[10].T_world_cam, frames[10].T_world_cam)
    none = [replace(frame, covariance=torch.full((6, 6), math.inf)) for frame in frames[:-1]] + [frames[-1]]
    assert all(a is b for a, b in zip(smoothed(none, standing(), CALM), none, strict=True))
