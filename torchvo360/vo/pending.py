"""What becomes of the frames that waited for a start: they are tracked against its keyframe, or interpolated."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.follow import Follower
from torchvo360.vo.frame import PyramidFrame
from torchvo360.vo.initialise import Start
from torchvo360.vo.keyframe import Keyframe
from torchvo360.vo.state import FrameEstimate
from torchvo360.vo.track import Track, track


def track_pending(
    start: Start, pending: list[PyramidFrame], follower: Follower, config: OdometryConfig
) -> tuple[dict[int, Float64[Tensor, "4 4"]], Track | None]:
    """Track the frames that waited against the start's keyframe, fusing each, and put the follower on the newest.

    Args:
        start: The start.
        pending: Its reference and the frames since.
        follower: Of the start's keyframe.
        config: Settings.

    Returns:
        T_cam_key by frame index, and the newest frame's track, None where only the start's own pose is known.
    """
    known = {**start.T_cam_key, pending[0].index: torch.eye(4, dtype=torch.float64)}
    previous, before, found = known[pending[0].index], pending[0].index, None
    brightness = torch.zeros(2, dtype=torch.float64)
    for frame in pending[1:]:
        guess = known.get(frame.index, previous)
        found = track(follower.key, frame, guess[None], brightness, config.track, config.map.max_relative_variance)
        if found is not None and found.inliers >= config.weak_inliers:
            known[frame.index], brightness = found.T_cam_key, found.affine
            follower.fuse(frame, found)
        else:
            found = None
        if frame.index in known:
            xi = lie.se3_log(known[frame.index] @ lie.se3_inverse(previous)) / (frame.index - before)
            follower.motion = lie.se3_exp(xi)
            previous, before = known[frame.index], frame.index
    follower.T_cam_key = previous
    follower.place(next(frame for frame in pending if frame.index == before))
    follower.affine = start.affine if found is None else found.affine
    return known, found


def fill_in(
    estimates: list[FrameEstimate],
    key: Keyframe,
    known: dict[int, Float64[Tensor, "4 4"]],
    rotations: dict[int, Float64[Tensor, "3 3"]],
) -> list[FrameEstimate]:
    """Return the estimates with the poses of all frames since a start's keyframe.

    Args:
        estimates: So far.
        key: The start's keyframe.
        known: T_cam_key of some frames, by index; between them positions are interpolated.
        rotations: R_cam_key of the frames that waited.
    """
    indices = sorted(known)
    centres = torch.stack([lie.se3_inverse(known[index])[:3, 3] for index in indices])
    at = torch.tensor(indices, dtype=torch.float64)
    out = list(estimates)
    for place, estimate in enumerate(estimates):
        if estimate.index < key.frame.index:
            continue
        if estimate.index in known:
            T_key_cam = lie.se3_inverse(known[estimate.index])
        else:
            right = int(torch.searchsorted(at, float(estimate.index)).clamp(1, len(indices) - 1))
            share = (estimate.index - at[right - 1]) / (at[right] - at[right - 1])
            R = rotations.get(estimate.index, known[indices[right]][:3, :3])
            T_key_cam = lie.se3(R.mT, torch.lerp(centres[right - 1], centres[right], share.clamp(0, 1)))
        # What was measured against another map says nothing of these poses.
        nothing = {"residual": math.nan, "inliers": math.nan, "a": math.nan, "b": math.nan}
        out[place] = replace(estimate, T_world_cam=lie.se3_normalized(key.T_world_key @ T_key_cam), **nothing)
    return out
