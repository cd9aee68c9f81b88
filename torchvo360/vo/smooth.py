"""Smoothing of a finished trajectory: each pose as sure as its alignment was, and a motion of small accelerations."""

from dataclasses import replace

import torch

from torchvo360.motion import PoseFilterConfig, smooth_trajectory
from torchvo360.vo.state import FrameEstimate, State


def smoothed(frames: list[FrameEstimate], scales: dict[int, float], config: PoseFilterConfig) -> list[FrameEstimate]:
    """Return the estimates with smoothed poses; those that were not tracked come out interpolated.

    Frames before the first that was tracked, and all of them where there are fewer than two, stay as they are.

    Args:
        frames: All of them, in order, with final poses.
        scales: By index: the world's units in one unit of the frame's map, where the covariances are at home.
        config: How much the motion may change. Accelerations are in median ranges of a map: in its units.
    """
    known = [_tracked(frame) for frame in frames]
    if sum(known) < 2:
        return frames
    first = known.index(True)
    covariances = torch.full((len(frames) - first, 6, 6), torch.inf, dtype=torch.float64)
    for at, frame in enumerate(frames[first:]):
        if known[first + at] and frame.covariance is not None:
            scale = covariances.new_tensor([scales.get(frame.index, 1.0)] * 3 + [1.0] * 3)
            covariances[at] = frame.covariance * scale * scale[:, None]
    result = smooth_trajectory(
        torch.tensor([frame.t_ns for frame in frames[first:]], dtype=torch.int64),
        torch.stack([frame.T_world_cam for frame in frames[first:]]),
        covariances,
        config,
        median_range=sorted(scales.values())[len(scales) // 2] if scales else 1.0,
    )
    poses = zip(frames[first:], result.T_world_cam, strict=True)
    return [*frames[:first], *(replace(frame, T_world_cam=T.clone()) for frame, T in poses)]


def _tracked(frame: FrameEstimate) -> bool:
    if frame.covariance is None or frame.state == State.LOST:
        return False
    return bool(torch.isfinite(frame.covariance).all())
