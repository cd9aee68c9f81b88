"""The map: keyframes whose poses, brightness and points are adjusted together, and what they leave behind."""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.backends.numba.images import look_up_value
from torchvo360.depth import InverseRange
from torchvo360.image import cell_of, one_per_cell
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.inertial import InertialLink
from torchvo360.vo.keyframes.candidates import Candidates
from torchvo360.vo.keyframes.cloud import PointCloud, to_cloud
from torchvo360.vo.keyframes.fresh import fresh_points
from torchvo360.vo.keyframes.keyframe import Keyframe
from torchvo360.window import CENTRE, Window, WindowFrame, WindowPoints, make_points, project_points

MOST_COUPLED = 40
"""Keyframes from which scale and gravity are found, the newest."""
START_STEPS = 15
"""Steps of the first adjustment of a start."""


@dataclass
class Mapper:
    """Keyframes in the window, the newest last, and the tracking reference that they make together."""

    builder: FrameBuilder
    config: OdometryConfig
    window: Window
    frames: list[PyramidFrame] = field(default_factory=list)
    """Of the window's keyframes."""
    settled: dict[int, Float64[Tensor, "4 4"]] = field(default_factory=dict)
    """T_world_key of the keyframes that have left the window, by frame index."""
    clouds: dict[int, PointCloud] = field(default_factory=dict)
    """The points they left, in their own cameras."""
    candidates: Candidates | None = None
    """Of the newest keyframe."""
    metric: bool = False
    """Whether the unit is the metre, so that what a depth sensor says can be believed."""
    imu: InertialLink | None = None
    times_ns: dict[int, int] = field(default_factory=dict)
    """Of all keyframes so far, by frame index."""
    _shown: Int64[Tensor, "N"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))
    """The points of the last `reference`, in its order."""

    @classmethod
    def begun(
        cls, key: Keyframe, builder: FrameBuilder, config: OdometryConfig, *, known: bool, metric: bool = False
    ) -> "Mapper":
        """Begin with one keyframe and its points.

        Args:
            key: The keyframe, with inverse ranges.
            builder: Of the frames.
            config: Settings.
            known: Whether the ranges' variances are to be believed: they then hold the unit. Otherwise the second
                keyframe's distance does.
            metric: Whether the ranges are in metres.
        """
        mapper = cls(builder, config, Window(config.window, builder.T_other_first), metric=metric)
        mapper._add(key.frame, lie.se3_inverse(key.T_world_key), torch.zeros(2, dtype=torch.float64))
        index = key.trusted(config.map.max_relative_variance).nonzero()[:, 0]
        rho, variance, _ = key.points
        cell = cell_of(builder.cameras[0], config.map.points, key.pixel[index])
        # By the gradient, not by V: a variance that goes with a noisy rho would prefer those that came out too near.
        index = index[one_per_cell(cell, -key.slope[index])]
        information = config.track.noise**2 / variance[index] if known else None
        target = key.frame.targets[0]
        ray, pixel = key.ray[:, index], key.pixel[index]
        points = make_points(target, pixel, ray, rho[index], config.window, information=information)
        if builder.T_other_first:
            points = mapper.window.refine_points(points)
        mapper.window.add_points(points)
        return mapper

    def _add(self, frame: PyramidFrame, T_cam_world: Float64[Tensor, "4 4"], affine: Float64[Tensor, "2"]) -> None:
        segment = motion = None
        if self.imu is not None and self.window.coupling is not None:
            newest = self.window.frames[-1]
            assert newest.motion is not None
            segment = self.imu.between([self.frames[-1].t_ns, frame.t_ns], newest.motion[3:])
            motion = self.imu.motion_after(self.window, segment)
        placed = WindowFrame(frame.index, frame.targets[0], T_cam_world, affine, frame.others, motion=motion)
        self.window.add_frame(placed, segment)
        self.frames.append(frame)
        self.times_ns[frame.index] = frame.t_ns

    def open(self, placed: list[tuple[PyramidFrame, Float64[Tensor, "4 4"], Float64[Tensor, "2"]]]) -> None:
        """Add the further keyframes of a start; the newest one's distance from the first is the unit.

        Args:
            placed: Frames in their order, each with T_cam_world and (a, b).
        """
        for frame, T_cam_world, affine in placed:
            self._add(frame, T_cam_world, affine)
        newest = len(placed)
        self.window.hold_scale(newest)
        self._adjust(START_STEPS)
        # The start's points have given the pose; with it their ranges are found afresh, more exactly than the start's.
        started = self.window.points
        self.window.points = None
        everything = list(range(newest + 1))
        for place in everything:
            # The farthest keyframe's great circles are walked: its parallax says most.
            others = sorted((other for other in everything if other != place), key=lambda at: -abs(at - place))
            self._freshen(place, others[: self.config.trace.views])
        if self.window.points is None or len(self.window.points) < self.config.track.min_points:
            self.window.points = started
        self._adjust(START_STEPS)
        self._cull()

    def begin_keyframe(
        self, frame: PyramidFrame, T_cam_world: Float64[Tensor, "4 4"], affine: Float64[Tensor, "2"]
    ) -> None:
        """Make a tracked frame a keyframe, which has no points of its own yet.

        Args:
            frame: The frame.
            T_cam_world: Where it was tracked.
            affine: Its brightness, of the scene as the first keyframe sees it.
        """
        self._add(frame, T_cam_world, affine)

    def finish_keyframe(self) -> list[Keyframe]:
        """Trace new points of the newest keyframe, adjust the window, let the oldest keyframe go.

        Returns:
            The keyframes that have left the window, with the map's points as they see them.
        """
        self._activate()
        place = len(self.frames) - 1
        others = list(range(place - 1, max(-1, place - 1 - self.config.trace.views), -1))
        # The middle one's great circles are walked: far enough to tell ranges apart, near enough to look alike.
        others.insert(0, others.pop(len(others) // 2))
        self._freshen(place, others)
        self._adjust()
        if self.imu is not None and self._coupled(self.imu):
            self._adjust()
        self._cull()
        left = []
        while len(self.frames) > self.config.window.keyframes:
            left.append(self.reference(0))
            self._drop(0)
        return left

    def _coupled(self, imu: InertialLink) -> bool:
        """Couple the window with the IMU, if the keyframes so far tell the scale; again where its times were wrong."""
        if imu.retimed():
            self.window.uncouple()
        if self.window.coupling is not None:
            return False
        poses = self.poses()
        keys = sorted(poses)[-MOST_COUPLED:]
        T_cam_world = lie.se3_inverse(torch.stack([poses[key] for key in keys]))
        times_ns = [self.times_ns[key] for key in keys]
        return imu.couple(self.window, T_cam_world, times_ns, metric=self.metric)

    def _adjust(self, steps: int | None = None) -> None:
        """Optimise the window; where that estimates the intrinsics, all that follows uses the new ones."""
        self.window.optimise(steps)
        if self.window.intrinsics is None:
            return
        self.builder.recalibrate(self.window.intrinsics)
        self.frames = [self.builder.recalibrated(frame) for frame in self.frames]
        if (waiting := self.candidates) is not None:
            frame = next(frame for frame in self.frames if frame.index == waiting.frame.index)
            self.candidates = replace(waiting, frame=frame, ray=self.builder.rays(waiting.pixel))

    def discard(self, wrong: Bool[Tensor, "N"]) -> None:
        """Let points go that the frames since the newest keyframe contradict.

        Args:
            wrong: By the order of the last `reference`.
        """
        points = self.window.points
        if points is None or len(wrong) != len(self._shown):
            return
        keep = torch.ones(len(points), dtype=torch.bool, device=wrong.device)
        keep[self._shown[wrong]] = False
        self.window.keep_points(keep)

    def _cull(self) -> None:
        points = self.window.points
        assert points is not None
        # What a sensor knows stays without a second keyframe that sees it: after a quick turn it is all there is.
        self.window.keep_points((points.inliers >= 1) | ((points.information > 0) & self.metric))

    def _drop(self, place: int) -> None:
        gone = self.frames[place]
        # First, so that others find it here or there at any time.
        self.settled[gone.index] = lie.se3_inverse(self.window.frames[place].T_cam_world)
        _, points = self.window.drop_frame(place)
        self.frames.pop(place)
        self.clouds[gone.index] = self._cloud(gone, points)

    def _cloud(self, frame: PyramidFrame, points: WindowPoints) -> PointCloud:
        relative = self.config.track.noise**2 / points.curvature.clamp_min(1e-12) / points.rho.square().clamp_min(1e-12)
        keep = (points.inliers >= 2) & (relative < self.config.map.max_relative_variance)
        centre = CENTRE if points.ray.shape[2] > 1 else 0
        return to_cloud(points.ray[:, keep, centre], points.rho[keep], points.pixel[keep], frame)

    def _freshen(self, place: int, others: list[int]) -> None:
        """Give a keyframe points of its own."""
        frame = self.frames[place]
        fresh = fresh_points(self.window, place, others, frame, self.builder, self.config, metric=self.metric)
        self.window.add_points(fresh.points)
        self.candidates = fresh.candidates

    def observe(self, frame: PyramidFrame, T_cam_key: Float64[Tensor, "4 4"], affine: Float64[Tensor, "2"]) -> None:
        """Look for the newest keyframe's candidates in a tracked frame."""
        if self.candidates is not None:
            self.candidates.observe(frame, T_cam_key, affine, self.config.epipolar, self.config.filter)

    def _activate(self) -> None:
        """Make points of the candidates whose ranges have become known, where there are not many points yet."""
        candidates, config = self.candidates, self.config
        if candidates is None:
            return
        place = self.frames.index(candidates.frame)
        ripe = candidates.ripe(config.map.max_relative_variance)
        ripe = ripe[self._free(candidates.pixel[ripe], place)]
        ray, rho = candidates.ray[:, ripe], candidates.points.rho[ripe]
        points = make_points(candidates.frame.targets[0], candidates.pixel[ripe], ray, rho, config.window, place)
        points = self.window.refine_points(points)
        self.window.add_points(points.take((points.inliers >= 1).nonzero()[:, 0]))

    def _free(self, pixel: Int64[Tensor, "N"], place: int) -> Bool[Tensor, "N"]:
        """Return which pixels of a keyframe lie in cells that are not crowded with the map's points already."""
        points = self.window.points
        if points is None:
            return torch.ones_like(pixel, dtype=torch.bool)
        seen = project_points(points, self.window.frames, place, self.config.map.max_difference)
        camera, count = self.builder.cameras[0], self.config.map.points
        cell = cell_of(camera, count, pixel)
        taken = cell_of(camera, count, seen.pixel[seen.shown])
        crowd = torch.bincount(taken, minlength=int(cell.max()) + 1 if len(cell) else 0)
        return crowd[cell] < self.config.window.keyframes

    def reference(self, place: int = -1) -> Keyframe:
        """Return the window's points as one keyframe sees them: what the next frames are tracked against."""
        place %= len(self.frames)
        points, frame = self.window.points, self.frames[place]
        assert points is not None
        pixel, ray, rho, shown = project_points(points, self.window.frames, place, self.config.map.max_difference)
        variance = self.config.track.noise**2 / points.curvature.clamp_min(1e-9)
        variance = variance * (rho / points.rho.clamp_min(1e-6)) ** 4
        index = shown.nonzero()[:, 0]
        index = index[pixel[index].argsort(stable=True)]
        ray, rho = ray[:, index].contiguous(), rho[index]
        self._shown = index
        return Keyframe(
            index=frame.index,
            T_world_key=lie.se3_inverse(self.window.frames[place].T_cam_world),
            pixel=pixel[index],
            ray=ray,
            slope=torch.zeros_like(rho),
            values=[look_up_value(target, ray) for target in frame.targets],
            points=InverseRange(rho, variance[index], torch.ones_like(rho)),
            frame=frame,
        )

    def references(self) -> list[Keyframe]:
        """Return all keyframes in the window with the points as they see them, the oldest first."""
        return [self.reference(place) for place in range(len(self.frames))]

    def has(self, key: int) -> bool:
        """Return whether a frame is one of the keyframes."""
        return key in self.settled or any(frame.index == key for frame in self.frames)

    def poses(self) -> dict[int, Float64[Tensor, "4 4"]]:
        """Return T_world_key of all keyframes so far, by frame index."""
        inside = {frame.key: lie.se3_inverse(frame.T_cam_world) for frame in self.window.frames}
        return {**self.settled, **inside}

    def all_clouds(self) -> dict[int, PointCloud]:
        """Return the points of all keyframes so far, in their own cameras, by frame index."""
        out, points = dict(self.clouds), self.window.points
        if points is not None:
            for place, frame in enumerate(self.frames):
                out[frame.index] = self._cloud(frame, points.take((points.host == place).nonzero()[:, 0]))
        return out

    def close(self) -> None:
        """Settle all keyframes where they are and let images and points go: nothing is added any more."""
        self.settled, self.clouds = self.poses(), self.all_clouds()
        self.frames, self.candidates = [], None
        self.window = Window(self.window.config)
