"""Following a map from frame to frame: predict, track, recover, and make keyframes."""

import math
from concurrent.futures import Executor
from dataclasses import dataclass, field

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.data.frame import Frame
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.foresee import MAX_PREDICTED, Expected, Foresight
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe, KeyPoints
from torchvo360.vo.keyframes.making import Made, Making, begin, make
from torchvo360.vo.keyframes.mapper import Mapper
from torchvo360.vo.recover import Recovery
from torchvo360.vo.track import Track, judge_points, track

LEAST_IN_VIEW = 0.7
"""A keyframe that has fewer of its points in view is followed by one without parallax, where a frame tells ranges."""
LEAST_CARRIED = 0.5
"""A new keyframe that shows less than this share of the points tracked so far does not wait for its own: the camera has
turned away, or the map is young."""
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
    foresight: Foresight
    key: Keyframe
    """What frames are tracked against: the map's points as its newest keyframe sees them."""
    T_cam_key: Float64[Tensor, "4 4"] = field(default_factory=_identity)
    affine: Float64[Tensor, "2"] = field(default_factory=_no_change)
    age: int = 0
    """Frames since the keyframe."""
    placed: PyramidFrame | None = None
    """The last frame that was found, and `T_placed_key` where: frames lost or unusable since do not count."""
    T_placed_key: Float64[Tensor, "4 4"] = field(default_factory=_identity)
    unplaced: dict[int, Float64[Tensor, "4 4"] | None] = field(default_factory=dict)
    """Frames since that one, by index: T_cam_key as the IMU carried them, None without it."""
    bridged: dict[int, Float64[Tensor, "4 4"]] = field(default_factory=dict)
    """T_cam_key of unusable frames between the last two that were found, by index: an even motion between these, or the
    IMU's with what it missed by spread over them."""
    inliers: float = 0.0
    """Of the last frame that was found."""
    elsewhere: tuple[KeyPoints, Track] | None = None
    """The earlier keyframe that knows the present frame better than this map does, if one was found."""
    left: list[Keyframe] = field(default_factory=list)
    """Keyframes that left the window with the last frame."""
    worker: Executor | None = None
    """What makes keyframes while frames are tracked; None to make them at once."""
    making: Making | None = None
    """The keyframe that is to take over."""

    @property
    def T_map_cam(self) -> Float64[Tensor, "4 4"]:
        """The present pose, in the map's own world and unit."""
        return lie.se3_normalized(self.key.T_world_key @ lie.se3_inverse(self.T_cam_key))

    def predict(self, frame: Frame | PyramidFrame) -> None:
        """Move on as expected, for a frame that cannot be used; without an IMU for a few of them, then stand."""
        expected = self._expected(frame.t_ns)
        if not expected.carried and len(self.unplaced) < MAX_PREDICTED:
            self.T_cam_key = lie.se3_normalized(self.foresight.motion @ self.T_cam_key)
        elif not expected.carried:
            self.stand()
        self._leave_unplaced(frame.index, expected)

    def _leave_unplaced(self, index: int, expected: Expected) -> None:
        """Note a frame that was not found; the IMU carries the camera on, where there is one."""
        if expected.carried:
            self.T_cam_key = expected.hypotheses[0]
        self.unplaced[index] = self.T_cam_key if expected.carried else None

    @property
    def carried(self) -> bool:
        """Whether the IMU alone has carried the camera to the last frame."""
        return bool(self.unplaced) and next(reversed(self.unplaced.values())) is not None

    def _expected(self, t_ns: int) -> Expected:
        assert self.placed is not None
        return self.foresight.expect(self.mapper, self.key, self.T_cam_key, self.placed, self.T_placed_key, t_ns)

    def stand(self) -> None:
        """Stop where the camera is, so that the error of a lost frame cannot run away."""
        self.foresight.rest()

    def place(self, frame: PyramidFrame) -> None:
        """Remember where a frame was found: the present pose."""
        self.placed, self.T_placed_key, self.unplaced = frame, self.T_cam_key, {}

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
        if self.making is not None and self.age >= self.making.frames:
            self.take_over()
        expected, limit = self._expected(frame.t_ns), config.map.max_relative_variance
        found = None
        for hypotheses in expected.hypotheses.split([1, len(expected.hypotheses) - 1]):
            if found is None or found.inliers < config.weak_inliers:
                attempt = track(self.key, frame, hypotheses, self.affine, config.track, limit, expected.prior)
                found = max((each for each in (found, attempt) if each), key=lambda each: each.inliers, default=None)
        if found is None or found.inliers < config.weak_inliers:
            found = self.recovery.search(self.key, frame, self.placed, self.T_placed_key, self.affine, found)
        corrected = None if found is None else self.foresight.corrected(expected, found)
        if found is not None and self._doubtful(found, corrected is not None):
            # What looks alike is not always the same place: after a jump an earlier keyframe may know the frame better.
            better = max(config.weak_inliers, found.inliers + CLEARLY)
            self.elsewhere = self.recovery.relocalise(frame, better, afresh=True) if better < 1 else None
            found = None if self.elsewhere is not None else found
        if found is None or found.inliers < config.lost_inliers:
            self._leave_unplaced(frame.index, expected)
            return None
        assert self.placed is not None
        since = lie.se3_log(lie.se3_normalized(found.T_cam_key @ lie.se3_inverse(self.T_placed_key)))
        self.bridged = self._bridged(expected, found, since)
        dt_s = (frame.t_ns - self.placed.t_ns) / 1e9
        self.foresight.learn(found, corrected, since, len(self.unplaced) + 1, dt_s, self.median_rho())
        self.T_cam_key, self.affine, self.inliers = found.T_cam_key, found.affine, found.inliers
        self.age += 1
        judge_points(self.key, frame, found, config.map.max_difference)
        self._note(frame, found)
        if self._keyframe_due(frame, found):
            self.take_over()
            self._make_keyframe(frame, found)
        self.place(frame)
        if self.foresight.imu is not None:
            self.foresight.imu.note(frame.t_ns, self.T_map_cam[:3, :3])
        return found

    def _bridged(
        self, expected: Expected, found: Track, since: Float64[Tensor, "6"]
    ) -> dict[int, Float64[Tensor, "4 4"]]:
        """Return T_cam_key of the frames between the last two that were found."""
        steps = len(self.unplaced) + 1
        shares = {index: (at + 1) / steps for at, index in enumerate(self.unplaced)}
        if expected.carried and all(T is not None for T in self.unplaced.values()):
            missed = lie.se3_log(lie.se3_normalized(found.T_cam_key @ lie.se3_inverse(expected.hypotheses[0])))
            return {
                index: lie.se3_normalized(lie.se3_exp(missed * shares[index]) @ T)
                for index, T in self.unplaced.items()
                if T is not None
            }
        return {index: lie.se3_exp(since * share) @ self.T_placed_key for index, share in shares.items()}

    def _doubtful(self, found: Track, credible: bool) -> bool:
        """Return whether a track is much worse than the last, or lies far from where the camera had been going."""
        if found.inliers < self.inliers - SUDDEN:
            return True
        if credible:
            return False
        T_cam_last = found.T_cam_key @ lie.se3_inverse(self.T_placed_key)
        usual = math.degrees(self.key.mean_flow(self.foresight.motion)) * JUMP * (len(self.unplaced) + 1)
        return math.degrees(self.key.mean_flow(T_cam_last)) > max(MIN_JUMP_DEG, usual)

    def _note(self, frame: PyramidFrame, found: Track) -> None:
        """Look for candidates in a frame that was found well; those of a keyframe in the making wait for it."""
        agrees = found.inliers >= self.config.weak_inliers
        if self.making is not None:
            self.making.tracked += [(frame, found)] * agrees
        elif agrees:
            self.mapper.observe(frame, found.T_cam_key, found.affine)

    def _keyframe_due(self, frame: PyramidFrame, found: Track) -> bool:
        settings = self.config.map
        if self.mapper.metric and frame.has_ranges:
            # Ranges without parallax: a camera that turns away from all it knows goes on.
            camera = self.builder.cameras[0]
            if not camera.wraps and self.key.share_in_view(found.T_cam_key, camera) < LEAST_IN_VIEW:
                return True
        share = self.key.mean_flow(found.T_cam_key) / math.radians(settings.keyframe_flow_deg)
        return share > 1 or (
            share > 0.2
            and (
                self.age >= settings.max_keyframe_gap
                or found.inliers < settings.min_visible
                or abs(float(found.affine[0])) > settings.max_keyframe_gain
            )
        )

    def _make_keyframe(self, frame: PyramidFrame, found: Track) -> None:
        """Go on against the present frame, with the points known so far until the mapper has made it a keyframe."""
        self.recovery.remember(self.key)
        mapper, newest, T_new_old = self.mapper, self.mapper.window.frames[-1], found.T_cam_key
        a, b = newest.affine + found.affine
        b = b + (float(found.affine[0].exp()) - 1) * newest.affine[1]
        mapper.discard(self.key.points.score <= DISCARDED)
        mapper.begin_keyframe(frame, T_new_old @ newest.T_cam_world, torch.stack([a, b]))
        settings = self.config.map
        frames = math.floor(settings.lag * min(self.age, settings.max_keyframe_gap))
        # What takes part in every prediction cannot wait: an IMU's states, estimated intrinsics.
        can_wait = self.foresight.imu is None and not self.config.window.calibrate and frames > 0
        waiting = mapper.reference() if can_wait else None
        if waiting is None or self._trusted(waiting) < LEAST_CARRIED * self._trusted(self.key):
            self._take(make(mapper))
        else:
            self.key, self.making = waiting, begin(mapper, frames, self.worker)
        # What was bridged stays where it is, against the keyframe that is now the newest.
        self.bridged = {index: T @ lie.se3_inverse(T_new_old) for index, T in self.bridged.items()}
        self.T_cam_key, self.affine, self.age = _identity(), _no_change(), 0
        self.foresight.rekeyed(T_new_old, self.median_rho())

    def _trusted(self, key: Keyframe) -> int:
        return int(key.trusted(self.config.map.max_relative_variance).sum())

    def _take(self, made: Made) -> None:
        self.key = made.key
        self.left += made.left

    def wait(self) -> list[Keyframe]:
        """Wait until the mapper is at rest; what it makes still takes over at its time.

        Returns:
            The keyframes that will then have left the window.
        """
        return [] if self.making is None else self.making.work.result().left

    def take_over(self) -> None:
        """Go on against the points of the keyframe in the making, if there is one; wait for it where it must be."""
        if (making := self.making) is None:
            return
        self.making = None
        self._take(making.work.result())
        for frame, found in making.tracked:
            self.mapper.observe(frame, found.T_cam_key, found.affine)
