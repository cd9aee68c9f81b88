"""The start: from an unknown scene to a first keyframe with inverse ranges.

Corners are followed from frame to frame across the seam. Once they show enough parallax, a robust essential matrix
gives motion and ranges, the epipolar search makes them dense on the keyframe's points, and a joint photometric
refinement settles all. Until then every frame gets a rotation, and the initialiser says what it waits for.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.alignment import solve_level
from torchvo360.checks import InputError, check_finite_number
from torchvo360.depth import (
    EpipolarConfig,
    FilterConfig,
    InverseRange,
    fuse,
    guess_around,
    search_great_circles,
    smooth,
)
from torchvo360.motion.essential import TwoView
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.weights import LossConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe, MapConfig, make_keyframe
from torchvo360.vo.start.corners import CornerTracks
from torchvo360.vo.start.refine import refine_jointly
from torchvo360.vo.track import TrackConfig
from torchvo360.window import pattern_rays

CHECK_PARALLAX = 2.0
"""A start is checked once the parallax is this many times its own."""
CHECK_DIRECTION_DEG, CHECK_ROTATION_DEG = 8.0, 3.0
"""Differences between a map and fresh corners beyond which the map is wrong: corners are within 3 and 0.5 deg."""

CORNER_SPREAD_RAD = 0.06
"""How far a corner's range speaks for the points around it: 3.4 deg."""


@dataclass(kw_only=True)
class InitialiseConfig:
    """Settings of the start."""

    corners: int = 1000
    min_tracks: int = 60
    """Fewer living corner tracks start anew from the present frame."""
    parallax_deg: float = 1.8
    """Median parallax at which the essential matrix's direction is within 6 deg in every case measured."""
    min_inliers: float = 0.5
    """Share of the tracks that the motion must explain."""
    min_cheirality: float = 0.8
    """Share of the inliers that must lie in front of both cameras."""
    max_pending: int = 24
    """Frames kept while waiting; beyond, every second one is let go and gets an interpolated position."""
    targets: int = 6
    """Frames of the joint refinement."""

    def __post_init__(self) -> None:
        if self.corners < self.min_tracks or self.min_tracks < 16:
            raise InputError(f"min_tracks: expected 16 to {self.corners} (corners), got {self.min_tracks}.")
        if self.max_pending < 4 or self.targets < 1:
            raise InputError(
                f"max_pending, targets: expected at least 4 and 1, got {self.max_pending} and {self.targets}."
            )
        check_finite_number("parallax_deg", self.parallax_deg, above=0)
        check_finite_number("min_inliers", self.min_inliers, above=0, at_most=1)
        check_finite_number("min_cheirality", self.min_cheirality, above=0, at_most=1)


@dataclass(frozen=True)
class Start:
    """A first keyframe, and where the frames followed since stand against it."""

    key: Keyframe
    T_cam_key: dict[int, Float64[Tensor, "4 4"]]
    """By frame index, for some of the frames, the newest included."""
    affine: dict[int, Float64[Tensor, "2"]]
    """Of these frames."""

    def rescaled(self, unit: float) -> "Start":
        """Return the start with a median inverse range of `unit` instead of 1."""
        rho, variance, score = self.key.points
        self.key.points = InverseRange(rho * unit, variance * unit**2, score)
        poses = {index: lie.se3(T[:3, :3], T[:3, 3] / unit) for index, T in self.T_cam_key.items()}
        return replace(self, T_cam_key=poses)


@dataclass
class Initialiser:
    """Follows corners from a reference frame until a start can be made."""

    builder: FrameBuilder
    config: InitialiseConfig
    map: MapConfig
    track: TrackConfig
    epipolar: EpipolarConfig
    filter: FilterConfig
    generator: torch.Generator
    tracks: CornerTracks = field(default_factory=CornerTracks)
    pending: list[PyramidFrame] = field(default_factory=list)
    """The reference and the frames since."""
    rotations: dict[int, Float64[Tensor, "3 3"]] = field(default_factory=dict)
    """R_cam_ref by frame index, of all frames since the reference."""
    R_ref_before: Float64[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))
    """Where the reference had to be changed: the rotation since the one before, as far as it is known."""
    reason: str = "first_frame"
    """What the start waits for."""

    def begin(self, frame: PyramidFrame) -> None:
        """Take a frame as the reference."""
        self.tracks = CornerTracks.found_in(frame, self.builder, self.config.corners)
        self.pending, self.rotations = [frame], {frame.index: torch.eye(3, dtype=torch.float64)}
        self.reason = "first_frame"

    def _begin_anew(self, frame: PyramidFrame, R_ref_before: Float64[Tensor, "3 3"], reason: str) -> None:
        self.begin(frame)
        self.R_ref_before, self.reason = R_ref_before, reason

    def add(self, frame: PyramidFrame) -> Start | None:
        """Follow the corners into a frame; return a start once one can be made.

        `reason` then says why not: few_tracks, low_parallax, few_inliers, low_cheirality or refinement_failed;
        `pending[0]` is another frame if the reference had to be changed.
        """
        turned = self.rotations[self.pending[-1].index]
        if not self._follow(frame):
            self._begin_anew(frame, turned, "few_tracks")
            return None
        view = self._view()
        gate = math.radians(self.config.parallax_deg)
        if view is None and self.reason == "few_inliers" and self.tracks.moved() > gate:
            # The corners have drifted, for instance through a long turn, and will not get better: take fresh ones.
            self._begin_anew(frame, self.rotations[frame.index], "few_inliers")
            return None
        start = None if view is None else self._start(view)
        if start is None:
            self._let_go()
        return start

    def check(self, frame: PyramidFrame, T_cam_key: Float64[Tensor, "4 4"]) -> tuple[bool, Start | None]:
        """Check a map by the corners' own direction, once they show more parallax than the start had.

        A wrong start stays self-consistent for a hundred frames, and its residual hardly shows it (measured): only a
        fresh, independent direction tells.

        Args:
            frame: The next frame.
            T_cam_key: Where the map has it, against the start's keyframe.

        Returns:
            Whether the check is over (the map is confirmed or contradicted, or the corners have run out), and the start
            that takes the map's place if it is contradicted.
        """
        gate = CHECK_PARALLAX * math.radians(self.config.parallax_deg)
        if not self._follow(frame):
            return True, None
        if self.tracks.moved() < 0.3 * gate:
            self._let_go()
            return False, None
        view = self.tracks.two_view(self.generator)
        if view is None or float(view.inlier.double().mean()) < self.config.min_inliers:
            return True, None
        if view.parallax < gate:
            self._let_go()
            return False, None
        t = T_cam_key[:3, 3]
        cosine = float((view.t_tgt_ref * t).sum() / torch.linalg.vector_norm(t).clamp_min(1e-12))
        turn = float(lie.so3_angle(view.R_tgt_ref @ T_cam_key[:3, :3].mT))
        agrees = cosine > math.cos(math.radians(CHECK_DIRECTION_DEG)) and turn < math.radians(CHECK_ROTATION_DEG)
        if agrees or view.cheirality < self.config.min_cheirality:
            return True, None
        return True, self._start(view)

    def _follow(self, frame: PyramidFrame) -> bool:
        """Follow the corners into a frame and keep it; False where too few are left."""
        if self.tracks.follow(self.pending[-1], frame) < self.config.min_tracks:
            return False
        self.rotations[frame.index] = self.tracks.rotation(self.rotations[self.pending[-1].index])
        self.pending.append(frame)
        return True

    def _let_go(self) -> None:
        """Let every second of too many waiting frames go; the newest stays: the corners are in it."""
        if len(self.pending) > self.config.max_pending:
            self.pending = self.pending[::2] + ([] if len(self.pending) % 2 else self.pending[-1:])

    def _view(self) -> TwoView | None:
        """Return the motion of the newest frame if it can be trusted with a start; else `reason` says why not."""
        gate = math.radians(self.config.parallax_deg)
        # What a rotation cannot explain is a lower bound of the parallax: far below the gate, spare the RANSAC.
        if self.tracks.moved() < 0.3 * gate:
            self.reason = "low_parallax"
            return None
        view = self.tracks.two_view(self.generator)
        if view is None or float(view.inlier.double().mean()) < self.config.min_inliers:
            self.reason = "few_inliers"
        elif view.parallax < gate:
            self.reason = "low_parallax"
        elif view.cheirality < self.config.min_cheirality:
            self.reason = "low_cheirality"
        else:
            return view
        return None

    def _start(self, view: TwoView) -> Start | None:
        reference, newest = self.pending[0], self.pending[-1]
        key = make_keyframe(reference, torch.eye(4, dtype=torch.float64), self.builder, self.map)
        ahead = view.inlier & (view.rho > 0)
        unit = view.rho[ahead].median()
        t = view.t_tgt_ref * unit
        rho = view.rho[ahead] / unit
        near = (rho > 0.02) & (rho < 10)
        corners = self.tracks.origins[ahead][near].to(key.ray)
        key.points = guess_around(key.ray, corners.T, rho[near].to(key.ray), CORNER_SPREAD_RAD)
        T_last = lie.se3(view.R_tgt_ref, t)
        affine = torch.zeros(2, dtype=torch.float64)
        for _ in range(2):
            self._search(key, newest, T_last, affine)
        key.points = smooth(key.points, key.pixel, self.builder.cameras[0], key.points.score > 0, self.filter)

        frames = self._spaced()
        T, ab = self._interpolated(key, frames, T_last)
        chosen = key.trusted(self.map.max_relative_variance).nonzero()[:, 0]
        if chosen.numel() < self.track.min_points:
            self.reason = "refinement_failed"
            return None
        rays = pattern_rays(key.ray[:, chosen], self.builder.cameras[0].pixel_angle)
        joint = refine_jointly(
            rays,
            key.points.rho[chosen],
            reference.value(rays),
            _together([frame.targets[0] for frame in frames]),
            T,
            ab,
            LossConfig(scale=self.track.huber, cutoff=self.track.cutoff),
        )
        rho, variance, score = key.points
        key.points = InverseRange(rho.index_copy(0, chosen, joint.rho), variance, score)
        # Points that the search had missed get a second chance with the better pose.
        self._search(key, newest, joint.T_tgt_ref[-1], joint.affine[-1])
        self.reason = "ok"
        poses = {frame.index: T for frame, T in zip(frames, joint.T_tgt_ref, strict=True)}
        return Start(key, poses, {frame.index: ab for frame, ab in zip(frames, joint.affine, strict=True)})

    def _search(self, key: Keyframe, frame: PyramidFrame, T_cam_key: Tensor, affine: Tensor) -> None:
        rho, variance, _ = key.points
        match = search_great_circles(
            key.frame.targets[0], frame.targets[0], key.ray, rho, variance, key.slope, T_cam_key, affine, self.epipolar
        )
        key.points = fuse(key.points, match, self.filter)

    def _spaced(self) -> list[PyramidFrame]:
        """Return frames spread evenly over those since the reference, the newest last."""
        later = self.pending[1:]
        count = min(self.config.targets, len(later))
        places = np.linspace(len(later) - 1, 0, count, endpoint=count > 1).round().astype(int)
        return [later[place] for place in sorted(set(places.tolist()))]

    def _interpolated(
        self, key: Keyframe, frames: list[PyramidFrame], T_last: Float64[Tensor, "4 4"]
    ) -> tuple[Float64[Tensor, "K 4 4"], Float64[Tensor, "K 2"]]:
        """Return poses of frames between the reference and the newest, aligned from an even motion.

        Each is solved for on a coarse level with the ranges found so far, which absorbs uneven motion.
        """
        first, last = self.pending[0].index, self.pending[-1].index
        xi = lie.se3_log(T_last)
        T = torch.stack([lie.se3_exp(xi * ((frame.index - first) / (last - first))) for frame in frames])
        usable = key.trusted(self.map.max_relative_variance).nonzero()[:, 0]
        K, level = len(frames), min(1, len(self.builder.cameras) - 1)
        affine = torch.zeros(K, 2, dtype=torch.float64)
        if usable.numel() < self.track.min_points:
            return T, affine
        rho, variance, _ = key.points
        reference = Reference(
            ray=key.ray[None, :, usable],
            rho=rho[usable].expand(K, -1),
            value=key.values[level][usable].expand(K, 1, -1),
            weight=torch.ones_like(rho[usable]).expand(K, -1),
            variance=variance[usable].expand(K, -1),
        )
        targets = _together([frame.targets[level] for frame in frames])
        device = key.ray.device
        settings = self.track.align_config(coarsest=True)
        solution = solve_level(reference, targets, T.to(device), affine.to(device), settings, max_steps=20)
        T, affine = (part.to(T.device) for part in solution.state)
        # The newest keeps the essential matrix's baseline, which is the unit.
        length = torch.linalg.vector_norm(T_last[:3, 3]) / torch.linalg.vector_norm(T[-1, :3, 3]).clamp_min(1e-9)
        T[-1, :3, 3] *= length
        return T, affine


def _together(targets: list[Target]) -> Target:
    """Put one-image targets of one camera into one batch."""
    confidence = targets[0].confidence
    if confidence is not None:
        confidence = confidence.expand(len(targets), -1, -1, -1).contiguous()
    padded = torch.cat([target.padded for target in targets])
    return Target(targets[0].camera, padded, confidence, targets[0].saturation)
