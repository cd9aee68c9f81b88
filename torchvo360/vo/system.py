"""The odometry: frames in, a pose and a state for every one of them out.

A step reads: build the pyramid, predict, track; if that is weak, search the rotation and look at earlier keyframes;
fuse the frame into the keyframe's inverse ranges; make a new keyframe where the parallax asks for one.
"""

import math
import time
from collections import deque
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_finite_number, check_shape
from torchvo360.data.frame import Frame
from torchvo360.data.trajectory import Trajectory
from torchvo360.depth import EpipolarConfig, FilterConfig, InverseRange, fuse, search_great_circles, smooth
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.initialise import InitialiseConfig, Initialiser, Start
from torchvo360.vo.map import (
    Keyframe,
    MapConfig,
    PointCloud,
    carry,
    make_keyframe,
    median_parallax,
    to_cloud,
)
from torchvo360.vo.recover import Recovery
from torchvo360.vo.state import FrameEstimate, State
from torchvo360.vo.track import Track, TrackConfig, track


@dataclass(kw_only=True)
class OdometryConfig:
    """Settings of the odometry."""

    coarsest_width: int = 64
    """Pyramid levels go down to about this width."""
    blur_px: float = 0.7
    """Smoothing of every frame: 0.5 for clean images, 0.7 for compressed video."""
    saturation: float = 252 / 255
    """Intensities at or above this are clipped and not used."""
    weak_inliers: float = 0.65
    """Share of agreeing gradient below which the other hypotheses are searched, and the frame is WEAK."""
    lost_inliers: float = 0.5
    """Share below which the frame is LOST: false minima reach 0.43."""
    remembered_keyframes: int = 8
    """Earlier keyframes that a lost frame is compared with."""
    restart_after: int = 15
    """Lost frames in a row after which a new map is started and joined to the old one."""
    initialise: InitialiseConfig = field(default_factory=InitialiseConfig)
    track: TrackConfig = field(default_factory=TrackConfig)
    map: MapConfig = field(default_factory=MapConfig)
    epipolar: EpipolarConfig = field(default_factory=EpipolarConfig)
    filter: FilterConfig = field(default_factory=FilterConfig)

    def __post_init__(self) -> None:
        check_finite_number("blur_px", self.blur_px, above=-1e-9)
        check_finite_number("saturation", self.saturation, above=0)
        check_finite_number("weak_inliers", self.weak_inliers, above=0, at_most=1)
        check_finite_number("lost_inliers", self.lost_inliers, above=0, at_most=self.weak_inliers)
        for name in ("coarsest_width", "remembered_keyframes", "restart_after"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected at least 1, got {getattr(self, name)}.")


@dataclass(frozen=True)
class OdometryResult:
    """What the odometry leaves."""

    frames: list[FrameEstimate]
    """One for every frame that was given, in order, with final poses."""
    trajectory: Trajectory
    points: PointCloud
    keyframes: int


class VisualOdometry:
    """Estimates a camera's motion from its frames, one step a frame."""

    def __init__(
        self,
        camera: Camera,
        config: OdometryConfig | None = None,
        *,
        mask: Bool[Tensor, "H W"] | None = None,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        """Prepare for frames of one camera.

        Args:
            camera: The camera of all frames.
            config: Settings.
            mask: Pixels that may be used; all by default.
            seed: Of the random samples at the start: equal seeds give equal trajectories.
            device: Where the images are kept.

        Raises:
            ShapeError: The mask is not of the camera's size.
        """
        self.config = config = OdometryConfig() if config is None else config
        if mask is not None:
            check_shape("mask", mask, f"{camera.height} {camera.width}")
        levels = 1 + max(0, round(math.log2(max(1.0, camera.width / config.coarsest_width))))
        self._builder = FrameBuilder(camera, levels, config.blur_px, mask, config.saturation, device)
        self._generator = torch.Generator().manual_seed(seed)
        self._estimates: list[FrameEstimate] = []
        self._clouds: list[PointCloud] = []
        self._keyframes = 0
        self._recent: deque[Keyframe] = deque(maxlen=config.remembered_keyframes)
        self._recovery = Recovery(self._builder, config.track, config.map.max_relative_variance)
        self._key: Keyframe | None = None
        self._initialiser = self._new_initialiser()
        self._T_world_ref = torch.eye(4, dtype=torch.float64)
        self._unit = 1.0
        self._T_cam_key = torch.eye(4, dtype=torch.float64)
        self._motion = torch.eye(4, dtype=torch.float64)
        self._affine = torch.zeros(2, dtype=torch.float64)
        self._last: PyramidFrame | None = None
        self._key_age = 0
        self._lost = 0

    def step(self, frame: Frame) -> FrameEstimate:
        """Estimate the pose of the next frame.

        A frame with a problem gets a predicted pose. While there is no map the pose is a rotation.

        Raises:
            InputError: The image is not of the camera's size, or the time does not increase.
        """
        began = time.perf_counter()
        if self._estimates and frame.t_ns <= self._estimates[-1].t_ns:
            raise InputError(f"t_ns: expected more than {self._estimates[-1].t_ns}, got {frame.t_ns}.")
        if frame.image is None or frame.problem:
            estimate = self._predicted(frame.index, frame.t_ns, f"bad_frame_{frame.problem or 'unreadable'}")
        else:
            camera = self._builder.cameras[0]
            if frame.image.shape != (camera.height, camera.width, 3):
                expected = f"{camera.height} x {camera.width} x 3"
                raise InputError(f"image: expected {expected}, got {' x '.join(map(str, frame.image.shape))}.")
            ready = self._builder.build(frame.image, frame.index, frame.t_ns)
            estimate = self._initialise(ready) if self._key is None else self._follow(self._key, ready)
            self._last = ready
        estimate = replace(estimate, milliseconds=1e3 * (time.perf_counter() - began))
        self._estimates.append(estimate)
        return estimate

    def finish(self) -> OdometryResult:
        """Return all poses and points found so far; more steps may follow."""
        limit = self.config.map.max_relative_variance
        clouds = self._clouds + ([to_cloud(self._key, limit)] if self._key is not None else [])
        xyz = torch.cat([cloud.xyz for cloud in clouds]) if clouds else torch.zeros(0, 3)
        rgb = torch.cat([cloud.rgb for cloud in clouds]) if clouds else torch.zeros(0, 3, dtype=torch.uint8)
        t_ns = torch.tensor([estimate.t_ns for estimate in self._estimates], dtype=torch.int64)
        poses = [estimate.T_world_cam for estimate in self._estimates]
        stacked = torch.stack(poses) if poses else torch.zeros(0, 4, 4, dtype=torch.float64)
        return OdometryResult(list(self._estimates), Trajectory(t_ns, stacked), PointCloud(xyz, rgb), self._keyframes)

    # The start

    def _new_initialiser(self) -> Initialiser:
        config = self.config
        return Initialiser(
            self._builder,
            config.initialise,
            config.map,
            config.track,
            config.epipolar,
            config.filter,
            self._generator,
        )

    def _initialise(self, frame: PyramidFrame) -> FrameEstimate:
        waiting = State.INITIALISING if self._keyframes == 0 else State.LOST
        starter = self._initialiser
        if not starter.pending:
            starter.begin(frame)
        else:
            before = starter.pending[0]
            last = starter.rotations[starter.pending[-1].index]
            start = starter.add(frame)
            if start is not None:
                return self._begin_map(start, frame)
            if starter.pending[0] is not before:
                # The corners ran out: go on from here, with the rotation reached so far.
                self._T_world_ref = self._T_world_ref @ lie.se3(last.mT, last.new_zeros(3))
        R_cam_ref = starter.rotations[frame.index]
        T = self._T_world_ref @ lie.se3(R_cam_ref.mT, R_cam_ref.new_zeros(3))
        if self._keyframes:
            found = self._relocalise(frame)
            if found is not None:
                return found
        return self._estimate(frame, T, waiting, starter.reason, None)

    def _begin_map(self, start: Start, frame: PyramidFrame) -> FrameEstimate:
        """Take over a start: fill in the poses of the frames that waited for it, and go on from its newest frame."""
        key, again = start.key, self._keyframes > 0
        key.T_world_key = self._T_world_ref
        rho, variance, score = key.points
        # A new map after a loss takes the old one's unit by its median range.
        key.points = InverseRange(rho * self._unit, variance * self._unit**2, score)
        known = {index: lie.se3(T[:3, :3], T[:3, 3] / self._unit) for index, T in start.T_cam_key.items()}
        self._key, self._keyframes, self._key_age, self._lost = key, self._keyframes + 1, 0, 0
        known[key.frame.index] = torch.eye(4, dtype=torch.float64)
        previous = known[key.frame.index]
        for pending in self._initialiser.pending[1:]:
            guess = known.get(pending.index, previous)
            found = track(
                key, pending, guess[None], torch.zeros(2, dtype=torch.float64), self.config.track, self._limit
            )
            if found is not None and found.inliers >= self.config.weak_inliers:
                known[pending.index] = found.T_cam_key
                if pending is not frame:
                    self._fuse(key, pending, found)
            previous = known.get(pending.index, previous)
        self._fill_in(key, known)
        self._initialiser = self._new_initialiser()
        self._T_cam_key = known[frame.index]
        self._affine = start.affine
        steps = sorted(known)
        before, gap = known[steps[-2]], steps[-1] - steps[-2]
        xi = lie.se3_log(self._T_cam_key @ lie.se3_inverse(before)) / gap
        self._motion = lie.se3_exp(xi)
        found = track(key, frame, self._T_cam_key[None], self._affine, self.config.track, self._limit)
        if found is not None and found.inliers >= self.config.weak_inliers:
            self._T_cam_key, self._affine = found.T_cam_key, found.affine
            self._fuse(key, frame, found)
        state = State.RELOCALISED if again else State.TRACKING
        return self._estimate(frame, self._T_world_cam(key), state, "new_map" if again else "ok", found)

    def _fill_in(self, key: Keyframe, known: dict[int, Tensor]) -> None:
        """Give the frames since the reference their poses: known ones, and between them interpolated positions."""
        indices = sorted(known)
        centres = torch.stack([lie.se3_inverse(known[index])[:3, 3] for index in indices])
        at = torch.tensor(indices, dtype=torch.float64)
        for place in range(len(self._estimates) - 1, -1, -1):
            estimate = self._estimates[place]
            if estimate.index < key.frame.index:
                break
            if estimate.index in known:
                T_key_cam = lie.se3_inverse(known[estimate.index])
            else:
                right = int(torch.searchsorted(at, float(estimate.index)).clamp(1, len(indices) - 1))
                share = (estimate.index - at[right - 1]) / (at[right] - at[right - 1])
                R = self._initialiser.rotations.get(estimate.index)
                R = known[indices[right]][:3, :3] if R is None else R
                T_key_cam = lie.se3(R.mT, torch.lerp(centres[right - 1], centres[right], share.clamp(0, 1)))
            self._estimates[place] = replace(estimate, T_world_cam=key.T_world_key @ T_key_cam)

    # Following

    @property
    def _limit(self) -> float:
        return self.config.map.max_relative_variance

    def _T_world_cam(self, key: Keyframe) -> Float64[Tensor, "4 4"]:
        return lie.se3_normalized(key.T_world_key @ lie.se3_inverse(self._T_cam_key))

    def _follow(self, key: Keyframe, frame: PyramidFrame) -> FrameEstimate:
        last = self._T_cam_key
        predicted = self._motion @ last
        hypotheses = torch.stack([predicted, last, self._motion @ predicted])
        found = track(key, frame, hypotheses, self._affine, self.config.track, self._limit)
        if found is None or found.inliers < self.config.weak_inliers:
            found = self._recovery.search(key, frame, self._last, last, self._affine, found)
        if found is None or found.inliers < self.config.lost_inliers:
            return self._lose(frame)
        was_lost, self._lost = self._lost > 0, 0
        self._motion = lie.se3_normalized(found.T_cam_key @ lie.se3_inverse(last))
        self._T_cam_key, self._affine = found.T_cam_key, found.affine
        self._key_age += 1
        T_world_cam = self._T_world_cam(key)
        weak = found.inliers < self.config.weak_inliers
        if not weak:
            self._fuse(key, frame, found)
        self._maybe_new_keyframe(key, frame, found)
        state = State.WEAK if weak else State.RELOCALISED if was_lost else State.TRACKING
        return self._estimate(frame, T_world_cam, state, "low_agreement" if weak else "ok", found)

    def _fuse(self, key: Keyframe, frame: PyramidFrame, found: Track) -> None:
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

    def _maybe_new_keyframe(self, key: Keyframe, frame: PyramidFrame, found: Track) -> None:
        settings = self.config.map
        parallax = median_parallax(key, found.T_cam_key, key.points.score > 0)
        share = parallax / math.radians(settings.keyframe_parallax_deg)
        wanted = share > 1 or (
            share > 0.2 and (self._key_age >= settings.max_keyframe_gap or found.inliers < settings.min_visible)
        )
        if not wanted:
            return
        camera = self._builder.cameras[0]
        key.points = smooth(key.points, key.pixel, camera, key.points.score > 0, self.config.filter)
        carried = carry(key, frame, found.T_cam_key, found.affine, camera, self.config.filter, self.config.track.cutoff)
        new = make_keyframe(frame, self._T_world_cam(key), self._builder, settings, carried)
        self._clouds.append(to_cloud(key, self._limit))
        self._unit = float(key.points.rho[key.points.score > 0].median())
        self._recent.append(key)
        self._key, self._keyframes, self._key_age = new, self._keyframes + 1, 0
        self._T_cam_key = torch.eye(4, dtype=torch.float64)
        self._affine = torch.zeros(2, dtype=torch.float64)

    # Losses

    def _lose(self, frame: PyramidFrame) -> FrameEstimate:
        self._lost += 1
        found = self._relocalise(frame)
        if found is not None:
            return found
        key = self._key
        assert key is not None
        # A prediction: the camera is taken to stand still, so that an error cannot run away.
        self._motion = torch.eye(4, dtype=torch.float64)
        T = self._T_world_cam(key)
        if self._lost >= self.config.restart_after:
            self._recent.append(key)
            self._clouds.append(to_cloud(key, self._limit))
            self._T_world_ref, self._key = T, None
            self._initialiser = self._new_initialiser()
            self._initialiser.begin(frame)
            return self._estimate(frame, T, State.LOST, "restarting", None)
        return self._estimate(frame, T, State.LOST, "no_agreement", None)

    def _relocalise(self, frame: PyramidFrame) -> FrameEstimate | None:
        """Look for a frame in the keyframes kept, the newest first; go on from the one it is found in."""
        for old in reversed(self._recent):
            found = self._recovery.relocalise(old, frame)
            if found is None or found.inliers < self.config.weak_inliers:
                continue
            self._recent.remove(old)
            if self._key is not None:
                self._recent.append(self._key)
            self._key, self._key_age, self._lost = old, 0, 0
            self._T_cam_key, self._affine = found.T_cam_key, found.affine
            self._motion = torch.eye(4, dtype=torch.float64)
            self._initialiser = self._new_initialiser()
            return self._estimate(frame, self._T_world_cam(old), State.RELOCALISED, "earlier_keyframe", found)
        return None

    def _predicted(self, index: int, t_ns: int, reason: str) -> FrameEstimate:
        if self._key is not None:
            self._T_cam_key = lie.se3_normalized(self._motion @ self._T_cam_key)
            return self._values(index, t_ns, self._T_world_cam(self._key), State.WEAK, reason, None)
        T = self._estimates[-1].T_world_cam if self._estimates else self._T_world_ref
        waiting = State.INITIALISING if self._keyframes == 0 else State.LOST
        return self._values(index, t_ns, T, waiting, reason, None)

    def _estimate(
        self, frame: PyramidFrame, T_world_cam: Tensor, state: State, reason: str, found: Track | None
    ) -> FrameEstimate:
        return self._values(frame.index, frame.t_ns, T_world_cam, state, reason, found)

    def _values(
        self, index: int, t_ns: int, T_world_cam: Tensor, state: State, reason: str, found: Track | None
    ) -> FrameEstimate:
        nan = math.nan
        residual, inliers = (nan, nan) if found is None else (found.residual, found.inliers)
        a, b = (nan, nan) if found is None else (float(found.affine[0]), float(found.affine[1]))
        return FrameEstimate(index, t_ns, T_world_cam, state, reason, residual, inliers, a, b, 0.0)
