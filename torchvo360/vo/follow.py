"""Following a map from frame to frame: predict, track, recover, fuse, and make keyframes."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.depth import InverseRange, fuse, search_great_circles, smooth
from torchvo360.vo.carry import CarriedPoints
from torchvo360.vo.cloud import PointCloud, to_cloud
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframe import Keyframe, KeyPoints, make_keyframe
from torchvo360.vo.recover import Recovery
from torchvo360.vo.track import Track, track

MAX_PREDICTED = 10
"""Frames in a row that are given the last motion; then the camera is taken to stand, or a prediction would run away."""


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
    key: Keyframe
    T_cam_key: Float64[Tensor, "4 4"] = field(default_factory=_identity)
    affine: Float64[Tensor, "2"] = field(default_factory=_no_change)
    motion: Float64[Tensor, "4 4"] = field(default_factory=_identity)
    """T_cam_last from one frame to the next, by the last two that were found."""
    age: int = 0
    """Frames since the keyframe."""
    placed: PyramidFrame | None = None
    """The last frame that was found, and `T_placed_key` where: frames lost or unusable since do not count."""
    T_placed_key: Float64[Tensor, "4 4"] = field(default_factory=_identity)
    unplaced: int = 0
    """Steps since that frame."""
    clouds: list[PointCloud] = field(default_factory=list)
    """Of the keyframes that were left behind."""

    @property
    def T_world_cam(self) -> Float64[Tensor, "4 4"]:
        """The present pose."""
        return lie.se3_normalized(self.key.T_world_key @ lie.se3_inverse(self.T_cam_key))

    def predict(self) -> None:
        """Move on by the last motion, for a frame that cannot be used; after a few of them, stand."""
        self.unplaced += 1
        if self.unplaced <= MAX_PREDICTED:
            self.T_cam_key = lie.se3_normalized(self.motion @ self.T_cam_key)
        else:
            self.stand()

    def stand(self) -> None:
        """Stop where the camera is, so that the error of a lost frame cannot run away."""
        self.motion = _identity()

    def place(self, frame: PyramidFrame) -> None:
        """Remember where a frame was found: the present pose."""
        self.placed, self.T_placed_key, self.unplaced = frame, self.T_cam_key, 0

    def follow(self, frame: PyramidFrame) -> tuple[Track | None, Float64[Tensor, "4 4"]]:
        """Find a frame, fuse it, and make it a keyframe where that is due.

        Returns:
            The track, None where the frame is lost, and T_world_cam.
        """
        config = self.config
        before = self.T_cam_key
        predicted = self.motion @ before
        hypotheses = torch.stack([predicted, before, self.motion @ predicted])
        limit = config.map.max_relative_variance
        found = track(self.key, frame, hypotheses, self.affine, config.track, limit)
        if found is None or found.inliers < config.weak_inliers:
            found = self.recovery.search(self.key, frame, self.placed, self.T_placed_key, self.affine, found)
        if found is None or found.inliers < config.lost_inliers:
            self.unplaced += 1
            return None, self.T_world_cam
        since = lie.se3_log(lie.se3_normalized(found.T_cam_key @ lie.se3_inverse(self.T_placed_key)))
        self.motion = lie.se3_exp(since / (self.unplaced + 1))
        self.T_cam_key, self.affine = found.T_cam_key, found.affine
        self.age += 1
        T_world_cam = self.T_world_cam
        if found.inliers >= config.weak_inliers:
            self.fuse(frame, found)
        if self._keyframe_due(found):
            self._new_keyframe(frame, found)
        self.place(frame)
        return found, T_world_cam

    def fuse(self, frame: PyramidFrame, found: Track) -> None:
        """Improve the keyframe's inverse ranges by a frame."""
        key = self.key
        rho, variance, _ = key.points
        match = search_great_circles(
            key.frame.targets[0],
            frame.targets[0],
            key.ray,
            rho,
            variance,
            key.slope,
            found.T_cam_key,
            found.affine,
            self.config.epipolar,
        )
        key.points = fuse(key.points, match, self.config.filter)

    def _keyframe_due(self, found: Track) -> bool:
        settings = self.config.map
        share = self.key.median_parallax(found.T_cam_key) / math.radians(settings.keyframe_parallax_deg)
        return share > 1 or (
            share > 0.2 and (self.age >= settings.max_keyframe_gap or found.inliers < settings.min_visible)
        )

    def _new_keyframe(self, frame: PyramidFrame, found: Track) -> None:
        key, config = self.key, self.config
        used = key.points.score > 0
        key.points = smooth(key.points, key.pixel, self.builder.cameras[0], used, config.filter)
        self.clouds.append(to_cloud(key, config.map.max_relative_variance))
        self.recovery.remember(key)
        self.key = carried_keyframe(key, frame, found, self.builder, config)
        self.T_cam_key, self.affine, self.age = _identity(), _no_change(), 0


def carried_keyframe(
    old: KeyPoints, frame: PyramidFrame, found: Track, builder: FrameBuilder, config: OdometryConfig
) -> Keyframe:
    """Make a frame a keyframe, with the points of an older one in which it was found.

    Points that are hidden in the frame, so that their intensity differs, stay behind.
    """
    camera = builder.cameras[0]
    ray, rho = old.moved(found.T_cam_key)
    # To first order V' = V (rho' / rho)^4.
    variance = old.points.variance * (rho / old.points.rho.clamp_min(1e-6)) ** 4
    variance = torch.maximum(variance, config.filter.variance_floor * rho * rho)
    uv, seen = camera.project(ray.T)
    gained = float(found.affine[0].exp()) * old.values[0] + float(found.affine[1])
    hidden = (frame.value(ray) - gained).abs() > config.track.cutoff
    column = uv[:, 0].long().clamp(0, camera.width - 1)
    row = uv[:, 1].long().clamp(0, camera.height - 1)
    everything = CarriedPoints(row * camera.width + column, ray, InverseRange(rho, variance, old.points.score))
    carried = everything.take(((old.points.score > 0) & seen & ~hidden).nonzero()[:, 0])
    T_world_key = lie.se3_normalized(old.T_world_key @ lie.se3_inverse(found.T_cam_key))
    return make_keyframe(frame, T_world_key, builder, config.map, carried)
