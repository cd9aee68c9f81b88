"""Following a map from frame to frame: predict, track, recover, and make keyframes."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe, KeyPoints
from torchvo360.vo.keyframes.mapper import Mapper
from torchvo360.vo.recover import Recovery
from torchvo360.vo.track import Track, judge_points, track

MAX_PREDICTED = 10
"""Frames in a row that are given the last motion; then the camera is taken to stand, or a prediction would run away."""
DISCARDED = -1.0
"""Points of this score or less when a keyframe is made leave the map."""
CLEARLY = 0.15
"""An earlier keyframe with this many more inliers than the present one is where a jump has led."""
SUDDEN = 0.15
"""A fall of inliers from one frame to the next by this much makes a track doubtful."""
MIN_JUMP_DEG, JUMP = 3.0, 3.0
"""A frame that its translation moves by more than this angle, and by this many times the last motion, has jumped."""


def _identity() -> Float64[Tensor, "4 4"]:
    return torch.eye(4, dtype=torch.float64)


def _no_change() -> Float64[Tensor, "2"]:
    return torch.zeros(2, dtype=torch.float64)


@dataclass
class Follower:
    """The present keyframe and where the camera stands against it."""

    builder: FrameBuilder
    config: OdometryConfig
    recovery: Recovery
    mapper: Mapper
    key: Keyframe
    """What frames are tracked against: the map's points as its newest keyframe sees them."""
    T_cam_key: Float64[Tensor, "4 4"] = field(default_factory=_identity)
    affine: Float64[Tensor, "2"] = field(default_factory=_no_change)
    motion: Float64[Tensor, "4 4"] = field(default_factory=_identity)
    """T_cam_last from one frame to the next, by the last two that were found."""
    age: int = 0
    """Frames since the keyframe."""
    placed: PyramidFrame | None = None
    """The last frame that was found, and `T_placed_key` where: frames lost or unusable since do not count."""
    T_placed_key: Float64[Tensor, "4 4"] = field(default_factory=_identity)
    unplaced: list[int] = field(default_factory=list)
    """Frames since that one, by index."""
    bridged: dict[int, Float64[Tensor, "4 4"]] = field(default_factory=dict)
    """T_cam_key of unusable frames between the last two that were found, by index: an even motion between these."""
    inliers: float = 0.0
    """Of the last frame that was found."""
    elsewhere: tuple[KeyPoints, Track] | None = None
    """The earlier keyframe that knows the present frame better than this map does, if one was found."""
    left: list[Keyframe] = field(default_factory=list)
    """Keyframes that left the window with the last frame."""

    @property
    def T_map_cam(self) -> Float64[Tensor, "4 4"]:
        """The present pose, in the map's own world and unit."""
        return lie.se3_normalized(self.key.T_world_key @ lie.se3_inverse(self.T_cam_key))

    def predict(self, index: int) -> None:
        """Move on by the last motion, for a frame that cannot be used; after a few of them, stand."""
        self.unplaced.append(index)
        if len(self.unplaced) <= MAX_PREDICTED:
            self.T_cam_key = lie.se3_normalized(self.motion @ self.T_cam_key)
        else:
            self.stand()

    def stand(self) -> None:
        """Stop where the camera is, so that the error of a lost frame cannot run away."""
        self.motion = _identity()

    def place(self, frame: PyramidFrame) -> None:
        """Remember where a frame was found: the present pose."""
        self.placed, self.T_placed_key, self.unplaced = frame, self.T_cam_key, []

    def median_rho(self) -> float:
        """Return the median inverse distance of the points in use: the map's unit, as the camera sees it."""
        used = self.key.points.score > 0
        return float(self.key.points.rho[used].median()) if bool(used.any()) else 1.0

    def follow(self, frame: PyramidFrame) -> Track | None:
        """Find a frame, search the map's candidates in it, and make it a keyframe where that is due.

        Returns:
            The track, None where the frame is lost.
        """
        self.bridged, self.left, self.elsewhere = {}, [], None
        config = self.config
        before = self.T_cam_key
        predicted = self.motion @ before
        hypotheses = torch.stack([predicted, before, self.motion @ predicted])
        limit = config.map.max_relative_variance
        found = track(self.key, frame, hypotheses, self.affine, config.track, limit)
        if found is None or found.inliers < config.weak_inliers:
            found = self.recovery.search(self.key, frame, self.placed, self.T_placed_key, self.affine, found)
        if found is not None and self._doubtful(found):
            # What looks alike is not always the same place: after a jump an earlier keyframe may know the frame better.
            better = max(config.weak_inliers, found.inliers + CLEARLY)
            self.elsewhere = self.recovery.relocalise(frame, better, afresh=True) if better < 1 else None
            found = None if self.elsewhere is not None else found
        if found is None or found.inliers < config.lost_inliers:
            self.unplaced.append(frame.index)
            return None
        since = lie.se3_log(lie.se3_normalized(found.T_cam_key @ lie.se3_inverse(self.T_placed_key)))
        steps = len(self.unplaced) + 1
        self.motion = lie.se3_exp(since / steps)
        self.bridged = {
            index: lie.se3_exp(since * ((at + 1) / steps)) @ self.T_placed_key for at, index in enumerate(self.unplaced)
        }
        self.T_cam_key, self.affine, self.inliers = found.T_cam_key, found.affine, found.inliers
        self.age += 1
        if found.inliers >= config.weak_inliers:
            self.mapper.observe(frame, found.T_cam_key, found.affine)
        judge_points(self.key, frame, found, config.map.max_difference)
        if self._keyframe_due(found):
            self._new_keyframe(frame, found)
        self.place(frame)
        return found

    def _doubtful(self, found: Track) -> bool:
        """Return whether a track is much worse than the last, or lies far from where the camera had been going."""
        if found.inliers < self.inliers - SUDDEN:
            return True
        T_cam_last = found.T_cam_key @ lie.se3_inverse(self.T_placed_key)
        usual = max(MIN_JUMP_DEG, math.degrees(self.key.mean_flow(self.motion)) * JUMP * (len(self.unplaced) + 1))
        return math.degrees(self.key.mean_flow(T_cam_last)) > usual

    def _keyframe_due(self, found: Track) -> bool:
        settings = self.config.map
        share = self.key.mean_flow(found.T_cam_key) / math.radians(settings.keyframe_flow_deg)
        return share > 1 or (
            share > 0.2
            and (
                self.age >= settings.max_keyframe_gap
                or found.inliers < settings.min_visible
                or abs(float(found.affine[0])) > settings.max_keyframe_gain
            )
        )

    def _new_keyframe(self, frame: PyramidFrame, found: Track) -> None:
        self.recovery.remember(self.key)
        newest = self.mapper.window.frames[-1]
        a, b = newest.affine + found.affine
        b = b + (float(found.affine[0].exp()) - 1) * newest.affine[1]
        T_new_old = found.T_cam_key
        self.mapper.discard(self.key.points.score <= DISCARDED)
        self.left = self.mapper.add_keyframe(frame, T_new_old @ newest.T_cam_world, torch.stack([a, b]))
        # What was bridged stays where it is, against the keyframe that is now the newest.
        self.bridged = {index: T @ lie.se3_inverse(T_new_old) for index, T in self.bridged.items()}
        self.key = self.mapper.reference()
        self.T_cam_key, self.affine, self.age = _identity(), _no_change(), 0
