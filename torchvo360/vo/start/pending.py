"""What becomes of the frames that waited for a start: they are tracked against its keyframe, or interpolated."""

from bisect import bisect

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.frame import PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe
from torchvo360.vo.track import track


def track_pending(
    key: Keyframe,
    pending: list[PyramidFrame],
    guesses: dict[int, Float64[Tensor, "4 4"]],
    rotations: dict[int, Float64[Tensor, "3 3"]],
    config: OdometryConfig,
) -> tuple[dict[int, Float64[Tensor, "4 4"]], Float64[Tensor, "4 4"]]:
    """Track the frames that waited against a start's keyframe, between it and the newest, which the map has placed.

    Args:
        key: The start's keyframe with the map's points.
        pending: Its frame and those since.
        guesses: T_cam_key of some of them by index; the newest's is taken as it is.
        rotations: R_cam_key by index.
        config: Settings.

    Returns:
        T_cam_key of those that were found, by index, and the motion from the last but one to the newest, per frame.
    """
    eye, newest = torch.eye(4, dtype=torch.float64), pending[-1].index
    known, brightness = {key.index: eye}, torch.zeros(2, dtype=torch.float64)
    for frame in pending[1:-1]:
        last = known[max(known)]
        turned = lie.se3(rotations[frame.index], last[:3, 3])
        hypotheses = [turned, lie.se3(rotations[frame.index], eye[:3, 3]), guesses.get(frame.index, last)]
        found = track(key, frame, torch.stack(hypotheses), brightness, config.track, config.map.max_relative_variance)
        if found is not None and found.inliers >= config.weak_inliers:
            known[frame.index], brightness = found.T_cam_key, found.affine
    before = max(known)
    # Frames, not numbers: of a video only every so many may be given.
    count = max(1, sum(before < index <= newest for index in rotations))
    since = lie.se3_log(guesses[newest] @ lie.se3_inverse(known[before])) / count
    return {**known, newest: guesses[newest]}, lie.se3_exp(since)


def track_earlier(
    key: Keyframe,
    frames: list[PyramidFrame],
    rotations: dict[int, Float64[Tensor, "3 3"]],
    config: OdometryConfig,
) -> dict[int, Float64[Tensor, "4 4"]]:
    """Track frames before a start's keyframe, of which only the rotation is known; return T_cam_key of those found.

    Args:
        key: The keyframe with the map's points.
        frames: The frames.
        rotations: R_cam_key by index.
        config: Settings.
    """
    known, brightness, t = {}, torch.zeros(2, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    for frame in reversed(frames):
        guess = torch.stack([lie.se3(rotations[frame.index], at) for at in (t, torch.zeros_like(t))])
        found = track(key, frame, guess, brightness, config.track, config.map.max_relative_variance)
        if found is not None and found.inliers >= config.weak_inliers:
            known[frame.index], brightness, t = found.T_cam_key, found.affine, found.T_cam_key[:3, 3]
    return known


def between(
    indices: list[int],
    known: dict[int, Float64[Tensor, "4 4"]],
    rotations: dict[int, Float64[Tensor, "3 3"]],
) -> dict[int, Float64[Tensor, "4 4"]]:
    """Return T_key_cam of frames that waited for a start; positions that are not known are interpolated.

    Before the first and after the last that is known the camera is taken to stand.

    Args:
        indices: Frames.
        known: T_cam_key of some, by index.
        rotations: R_cam_key of the frames that waited.
    """
    at = sorted(known)
    centres = torch.stack([lie.se3_inverse(known[index])[:3, 3] for index in at])
    out = {}
    for index in indices:
        if index in known:
            out[index] = lie.se3_inverse(known[index])
            continue
        right = min(max(bisect(at, index), 1), len(at) - 1)
        share = min(max((index - at[right - 1]) / (at[right] - at[right - 1]), 0.0), 1.0)
        R = rotations.get(index, known[at[right]][:3, :3])
        out[index] = lie.se3(R.mT, torch.lerp(centres[right - 1], centres[right], share))
    return out
