"""How a map begins: by corners' parallax, a rig's images of one moment, a depth sensor, or a depth network's ranges.

Corners need motion, and their start is checked later by their own fresh direction. A rig and a depth sensor give a map
in metres at once. A depth network does too, in its metre; the corners go on beside it, and the start they make, which
is more exact, takes its place.
"""

from enum import Enum
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe
from torchvo360.vo.keyframes.mapper import Mapper
from torchvo360.vo.start.initialise import Initialiser, Start
from torchvo360.vo.start.learned import LearnedRanges
from torchvo360.vo.start.pending import between, track_earlier, track_pending
from torchvo360.vo.start.sensor import SensorRanges
from torchvo360.vo.start.stereo import StereoRanges
from torchvo360.vo.track import Track, measure_keyframe

LEARNED = "learned_ranges"
"""The reason of a frame whose map is made of a depth network's ranges."""
STEREO = "stereo_ranges"
"""The reason of a frame whose map is made of a rig's images of one moment."""
SENSOR = "sensor_ranges"
"""The reason of a frame whose map is made of a depth sensor's ranges."""

MAX_EARLIER = 8
"""Frames kept of corners that ran out before there was a map."""


class Begun(NamedTuple):
    """A map that begins at the present frame."""

    mapper: Mapper
    newest: Keyframe
    """The present frame with the map's points."""
    motion: Float64[Tensor, "4 4"]
    """T_cam_last, as far as it is known."""
    key: int
    """The keyframe by which the frames since it stand."""
    T_key_cam: dict[int, Float64[Tensor, "4 4"]]
    """Of frames that were given out before, by index."""
    found: Track | None
    reason: str


class _Phase(Enum):
    WAITING = "no map yet"
    SETTLING = "a map of learned ranges, and corners that go on"
    CONFIRMING = "a start by corners, which they have not confirmed yet"
    DONE = "nothing to do until the next loss"


class Starter:
    """Makes maps, and watches over those that are young."""

    def __init__(
        self,
        builder: FrameBuilder,
        config: OdometryConfig,
        generator: torch.Generator,
        learned: LearnedRanges | None,
        stereo: StereoRanges | None,
    ) -> None:
        self._builder, self._config, self._generator = builder, config, generator
        self._learned, self._stereo = learned, stereo
        self._sensor = SensorRanges(builder, config.map, config.track.min_points)
        self.restart(torch.eye(4, dtype=torch.float64), 1.0)

    def restart(self, T_world_ref: Float64[Tensor, "4 4"], unit: float) -> None:
        """Wait for a new map.

        Args:
            T_world_ref: Where the next frame is taken to be.
            unit: Median inverse range that a map without a metre is to have.
        """
        self._T_world_ref, self._unit = T_world_ref, unit
        self._corners, self._phase = self._new_corners(), _Phase.WAITING
        self._earlier: list[PyramidFrame] = []
        self._turned: dict[int, Float64[Tensor, "3 3"]] = {}
        self.reason = "first_frame"

    def rest(self) -> None:
        """Stop watching: the map that was young is lost or stands."""
        self._corners, self._phase = self._new_corners(), _Phase.DONE

    @property
    def settling(self) -> bool:
        """Whether the present map is one of learned ranges that corners are to replace."""
        return self._phase is _Phase.SETTLING

    @property
    def confirming(self) -> bool:
        """Whether the present map rests on a start that its corners have not confirmed yet."""
        return self._phase is _Phase.CONFIRMING

    def _new_corners(self) -> Initialiser:
        config = self._config
        return Initialiser(
            self._builder, config.initialise, config.map, config.track, config.epipolar, config.filter, self._generator
        )

    def add(self, frame: PyramidFrame) -> Begun | None:
        """Take the next frame while there is no map; return the map that begins with it. `reason` says why not."""
        if self._stereo is not None:
            self.reason = "few_ranges"
            return self._by_stereo(self._stereo, frame) or self._by_sensor(frame)
        if (begun := self._by_sensor(frame)) is not None:
            return begun
        corners = self._corners
        pending, rotations = corners.pending, corners.rotations
        before = pending[0] if pending else None
        if before is None:
            corners.begin(frame)
        elif (start := corners.add(frame)) is not None:
            return self._by_corners(start, frame, "ok")
        elif corners.pending[0] is not before:
            # The corners ran out: go on from here, with the rotation reached so far.
            self._keep(pending, rotations)
            R = corners.R_ref_before
            self._T_world_ref = self._T_world_ref @ lie.se3(R.mT, R.new_zeros(3))
        self.reason = corners.reason
        return self._by_network(frame) if corners.pending[0] is not before else None

    def _keep(self, pending: list[PyramidFrame], rotations: dict[int, Float64[Tensor, "3 3"]]) -> None:
        """Keep a few frames of corners that ran out: the map will say where they were, if the camera moved already."""
        R_ref_world = self._T_world_ref[:3, :3].mT
        self._turned |= {index: R_cam_ref @ R_ref_world for index, R_cam_ref in rotations.items()}
        kept = [*self._earlier, pending[0], *pending[-2:][len(pending) < 3 :]]
        while len(kept) > MAX_EARLIER:
            kept = [*kept[:-2:2], *kept[-2:]]
        self._earlier = kept

    def pose(self, frame: PyramidFrame) -> Float64[Tensor, "4 4"]:
        """Return where a frame without a map is taken to be: where the last was, turned as the corners say."""
        R_cam_ref = self._corners.rotations.get(frame.index)
        if R_cam_ref is None:
            return self._T_world_ref
        return self._T_world_ref @ lie.se3(R_cam_ref.mT, R_cam_ref.new_zeros(3))

    def watch(self, frame: PyramidFrame, T_map_cam: Float64[Tensor, "4 4"]) -> Begun | None:
        """Follow the corners beside a young map; return the map that takes its place, once one does.

        Args:
            frame: The next frame.
            T_map_cam: Where the map has it.
        """
        if self._phase is _Phase.SETTLING:
            reference = self._corners.pending[0]
            start = self._corners.add(frame)
            if self._corners.pending[0] is not reference:
                self._T_world_ref = T_map_cam
            return None if start is None else self._by_corners(start, frame, "start_settled")
        if self._phase is _Phase.CONFIRMING:
            over, start = self._corners.check(frame, lie.se3_inverse(T_map_cam) @ self._T_world_ref)
            if start is not None:
                return self._by_corners(start, frame, "start_corrected")
            if over:
                self.rest()
        return None

    def _by_stereo(self, stereo: StereoRanges, frame: PyramidFrame) -> Begun | None:
        key = stereo.keyframe(frame, self._T_world_ref)
        if key is None:
            return None
        mapper = Mapper.begun(key, self._builder, self._config, known=False, metric=True)
        newest, limit = mapper.reference(), self._config.map.max_relative_variance
        if int(newest.trusted(limit).sum()) < self._config.track.min_points:
            return None
        self._phase = _Phase.DONE
        eye = torch.eye(4, dtype=torch.float64)
        found = measure_keyframe(newest, self._config.track, limit)
        return Begun(mapper, newest, eye, frame.index, {}, found, STEREO)

    def _by_sensor(self, frame: PyramidFrame) -> Begun | None:
        key = self._sensor.keyframe(frame, self._T_world_ref)
        if key is None:
            return None
        # Frames that brought no depth have waited for this one: the few last are found by its points.
        waiting, eye = self._corners.pending[-MAX_EARLIER:], torch.eye(4, dtype=torch.float64)
        turns = {earlier.index: eye[:3, :3] for earlier in waiting}
        known = {key.index: eye, **track_earlier(key, waiting, turns, self._config)}
        T_key_cam = between(sorted(turns), known, {})
        if waiting:
            key.T_world_key = self.pose(waiting[0]) @ lie.se3_inverse(T_key_cam[waiting[0].index])
        mapper = Mapper.begun(key, self._builder, self._config, known=True, metric=True)
        self.rest()
        found = measure_keyframe(key, self._config.track, self._config.map.max_relative_variance)
        return Begun(mapper, key, eye, key.index, T_key_cam, found, SENSOR)

    def _by_network(self, frame: PyramidFrame) -> Begun | None:
        key = None if self._learned is None else self._learned.keyframe(frame, self._T_world_ref)
        if key is None:
            return None
        self._phase = _Phase.SETTLING
        limit = self._config.map.max_relative_variance
        self._unit = float(key.points.rho[key.trusted(limit)].median())
        mapper = Mapper.begun(key, self._builder, self._config, known=True)
        eye = torch.eye(4, dtype=torch.float64)
        return Begun(mapper, key, eye, frame.index, {}, measure_keyframe(key, self._config.track, limit), LEARNED)

    def _between(self, start: Start, frame: PyramidFrame) -> list[PyramidFrame]:
        """Return a frame about half way to the newest, by distance, where a start has placed one.

        What moves by itself can pass for still in two images, hardly in three; a third without parallax says nothing.
        """
        way = float(torch.linalg.vector_norm(start.T_cam_key[frame.index][:3, 3]))
        share = {
            f.index: float(torch.linalg.vector_norm(start.T_cam_key[f.index][:3, 3])) / max(way, 1e-12)
            for f in self._corners.pending
            if f.index in start.T_cam_key
        }
        half_way = [f for f in self._corners.pending if abs(share.get(f.index, 0.0) - 0.5) < 0.25]
        return sorted(half_way, key=lambda f: abs(share[f.index] - 0.5))[:1]

    def _by_corners(self, start: Start, frame: PyramidFrame, reason: str) -> Begun:
        """Take over a start: adjust it, and find the frames that waited for it."""
        # A new map after a loss takes the old one's unit by its median range, unless a network knows the metre.
        unit = None if self._learned is None else self._learned.unit(start.key)
        start = start.rescaled(self._unit if unit is None else unit)
        start.key.T_world_key = self._T_world_ref
        mapper = Mapper.begun(start.key, self._builder, self._config, known=False)
        T_key_world = lie.se3_inverse(start.key.T_world_key)
        chosen = [*self._between(start, frame), frame]
        mapper.open([(f, start.T_cam_key[f.index] @ T_key_world, start.affine[f.index]) for f in chosen])
        first, newest = mapper.reference(0), mapper.reference()
        waiting, earlier = self._corners.pending, self._earlier
        if self._config.window.calibrate:
            waiting, earlier = ([self._builder.recalibrated(part) for part in parts] for parts in (waiting, earlier))
        T_newest = lie.se3_inverse(newest.T_world_key) @ first.T_world_key
        guesses = {**start.T_cam_key, frame.index: T_newest}
        known, motion = track_pending(first, waiting, guesses, self._corners.rotations, self._config)
        R_world_key = first.T_world_key[:3, :3]
        rotations = {index: R_cam_world @ R_world_key for index, R_cam_world in self._turned.items()}
        known |= track_earlier(first, earlier, rotations, self._config)
        rotations |= self._corners.rotations
        # A start that takes another map's place is not asked again.
        self._phase = _Phase.CONFIRMING if self._phase is not _Phase.CONFIRMING else _Phase.DONE
        since = sorted({*self._turned, *range(first.frame.index, frame.index)})
        found = measure_keyframe(newest, self._config.track, self._config.map.max_relative_variance)
        T_key_cam = between(since, known, rotations)
        self._earlier, self._turned = [], {}
        return Begun(mapper, newest, motion, first.frame.index, T_key_cam, found, reason)
