"""Smoothing of a finished trajectory: each pose as sure as its alignment was, and a motion of small accelerations."""

from dataclasses import replace
from itertools import groupby
from typing import NamedTuple

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.motion import PoseFilterConfig, smooth_trajectory
from torchvo360.vo.state import FrameEstimate, State


class Standing(NamedTuple):
    """What a frame stands on."""

    group: int
    """Maps of one group are joined: a motion goes on from one to the other."""
    scale: float
    """The world's units in one unit of the frame's map, where its covariance is at home."""
    median_range: float
    """Of the map's points from their keyframes, in the world's unit: the length that accelerations are measured in."""


def smoothed(
    frames: list[FrameEstimate], standing: dict[int, Standing], config: PoseFilterConfig
) -> list[FrameEstimate]:
    """Return the estimates with smoothed poses.

    Those that were not tracked, such as frames that an IMU has carried, keep their shape: they move along with the
    tracked ones before and after. What stands on nothing stays, and nothing is smoothed over from one map to another
    that it is not joined with.

    Args:
        frames: All of them, in order, with final poses.
        standing: What they stand on, by index.
        config: How much the motion may change.
    """
    out: list[FrameEstimate] = []
    for group, run in groupby(frames, lambda frame: standing[frame.index].group if frame.index in standing else -1):
        part = list(run)
        out += part if group < 0 else _smoothed(part, standing, config)
    return out


def _smoothed(
    frames: list[FrameEstimate], standing: dict[int, Standing], config: PoseFilterConfig
) -> list[FrameEstimate]:
    tracked = [frame for frame in frames if _is_tracked(frame)]
    if len(tracked) < 2:
        return frames
    scale = torch.tensor([standing[frame.index].scale for frame in tracked], dtype=torch.float64)
    both = torch.cat([scale[:, None].expand(-1, 3), torch.ones(len(tracked), 3, dtype=torch.float64)], 1)
    covariance = torch.stack([frame.covariance for frame in tracked if frame.covariance is not None])
    t_ns, T_world_cam = _times(tracked), torch.stack([frame.T_world_cam for frame in tracked])
    result = smooth_trajectory(
        t_ns,
        T_world_cam,
        covariance * both[:, :, None] * both[:, None],
        config,
        median_range=standing[tracked[0].index].median_range,
    )
    C = result.T_world_cam @ lie.se3_inverse(T_world_cam)
    all_ns = _times(frames)
    after = torch.searchsorted(t_ns, all_ns).clamp(1, len(tracked) - 1)
    share = ((all_ns - t_ns[after - 1]).double() / (t_ns[after] - t_ns[after - 1]).double()).clamp(0, 1)
    step = lie.se3_log(C[after] @ lie.se3_inverse(C[after - 1]))
    moved = lie.se3_exp(step * share[:, None]) @ C[after - 1] @ torch.stack([frame.T_world_cam for frame in frames])
    return [replace(frame, T_world_cam=T.clone()) for frame, T in zip(frames, lie.se3_normalized(moved), strict=True)]


def _times(frames: list[FrameEstimate]) -> Int64[Tensor, "N"]:
    return torch.tensor([frame.t_ns for frame in frames], dtype=torch.int64)


def _is_tracked(frame: FrameEstimate) -> bool:
    covariance: Float64[Tensor, "6 6"] | None = frame.covariance
    return covariance is not None and frame.state != State.LOST and bool(torch.isfinite(covariance).all())
