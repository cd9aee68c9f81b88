"""The map: keyframes whose poses, brightness and points are adjusted together, and what they leave behind."""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.depth import InverseRange, guess_around
from torchvo360.image import equal_area_cells, select_pixels
from torchvo360.residuals.direct import look_up_value
from torchvo360.vo.candidates import Candidates
from torchvo360.vo.cloud import PointCloud, to_cloud
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframe import Keyframe
from torchvo360.vo.stereo import stereo_views
from torchvo360.window import (
    CENTRE,
    View,
    Window,
    WindowFrame,
    WindowPoints,
    make_points,
    trace,
)

START_STEPS = 15
"""Steps of the first adjustment of a start."""


def _identity() -> Float64[Tensor, "4 4"]:
    return torch.eye(4, dtype=torch.float64)


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
    _shown: Int64[Tensor, "N"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))
    """The points of the last `reference`, in its order."""

    @classmethod
    def begun(cls, key: Keyframe, builder: FrameBuilder, config: OdometryConfig, *, known: bool) -> "Mapper":
        """Begin with one keyframe and its points.

        Args:
            key: The keyframe, with inverse ranges.
            builder: Of the frames.
            config: Settings.
            known: Whether the ranges' variances are to be believed: they then hold the unit. Otherwise the second
                keyframe's distance does.
        """
        mapper = cls(builder, config, Window(config.window, builder.T_other_first))
        mapper._add(key.frame, lie.se3_inverse(key.T_world_key), torch.zeros(2, dtype=torch.float64))
        index = key.trusted(config.map.max_relative_variance).nonzero()[:, 0]
        rho, variance, _ = key.points
        cell = equal_area_cells(builder.cameras[0], config.map.points, device=rho.device).flatten()
        # By the gradient, not by V: a variance that goes with a noisy rho would prefer those that came out too near.
        index = index[_one_per_cell(cell[key.pixel[index]], -key.slope[index])]
        information = config.track.noise**2 / variance[index] if known else None
        target = key.frame.targets[0]
        ray, pixel = key.ray[:, index], key.pixel[index]
        points = make_points(target, pixel, ray, rho[index], config.window, information=information)
        if builder.T_other_first:
            points = mapper.window.refine_points(points)
        mapper.window.add_points(points)
        return mapper

    def _add(self, frame: PyramidFrame, T_cam_world: Float64[Tensor, "4 4"], affine: Float64[Tensor, "2"]) -> None:
        self.window.add_frame(WindowFrame(frame.index, frame.targets[0], T_cam_world, affine, frame.others))
        self.frames.append(frame)

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
            self._new_points(place, others[: self.config.trace.views])
        if self.window.points is None or len(self.window.points) < self.config.track.min_points:
            self.window.points = started
        self._adjust(START_STEPS)
        self._cull()

    def add_keyframe(
        self, frame: PyramidFrame, T_cam_world: Float64[Tensor, "4 4"], affine: Float64[Tensor, "2"]
    ) -> list[Keyframe]:
        """Make a tracked frame a keyframe: trace new points, adjust the window, let the oldest keyframe go.

        Args:
            frame: The frame.
            T_cam_world: Where it was tracked.
            affine: Its brightness, of the scene as the first keyframe sees it.

        Returns:
            The keyframes that have left the window, with the map's points as they see them.
        """
        self._add(frame, T_cam_world, affine)
        self._activate()
        place = len(self.frames) - 1
        others = list(range(place - 1, max(-1, place - 1 - self.config.trace.views), -1))
        # The middle one's great circles are walked: far enough to tell ranges apart, near enough to look alike.
        others.insert(0, others.pop(len(others) // 2))
        self._new_points(place, others)
        self._adjust()
        self._cull()
        left = []
        while len(self.frames) > self.config.window.keyframes:
            left.append(self.reference(0))
            self._drop(0)
        return left

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
        assert self.window.points is not None
        self.window.keep_points(self.window.points.inliers >= 1)

    def _drop(self, place: int) -> None:
        frame, points = self.window.drop_frame(place)
        gone = self.frames.pop(place)
        self.settled[gone.index] = lie.se3_inverse(frame.T_cam_world)
        self.clouds[gone.index] = self._cloud(gone, points)

    def _cloud(self, frame: PyramidFrame, points: WindowPoints) -> PointCloud:
        relative = self.config.track.noise**2 / points.curvature.clamp_min(1e-12) / points.rho.square().clamp_min(1e-12)
        keep = (points.inliers >= 2) & (relative < self.config.map.max_relative_variance)
        ray = points.ray[:, :, points.ray.shape[2] // 2] if points.ray.shape[2] == 1 else points.ray[:, :, CENTRE]
        return to_cloud(ray[:, keep], points.rho[keep], points.pixel[keep], frame)

    def _new_points(self, place: int, others: list[int]) -> None:
        """Choose pixels of a keyframe, one in each cell, and trace them into other keyframes.

        Those that are found become points at once, the others candidates, which the next frames search for.
        """
        config, window, frame = self.config, self.window, self.frames[place]
        strength = self.builder.strength(frame)
        pixel = select_pixels(
            strength,
            self.builder.usable(frame),
            self.builder.cameras[0],
            config.map.points,
            minimum=config.map.min_gradient,
        )
        ray, start = self.builder.rays(pixel), strength.new_ones(len(pixel))
        points = make_points(frame.targets[0], pixel, ray, start, config.window, place)
        points = points.take((points.weight.sum(1) > 0).nonzero()[:, 0])
        views, same_time = [self._view(place, other) for other in others], stereo_views(frame, self.builder)
        traced = trace(points, frame.targets[0], [*views, *same_time], config.trace)
        if same_time:
            # Along a rig's baseline some are found that the motion's own curves cannot tell apart.
            again = trace(points, frame.targets[0], [*same_time, *views], config.trace)
            rho = torch.where(traced.found, traced.rho, again.rho)
            traced = traced._replace(rho=rho, found=traced.found | again.found)
        known = replace(points, rho=traced.rho).take(traced.found.nonzero()[:, 0])
        known = window.refine_points(known)
        known = known.take((known.inliers >= 1).nonzero()[:, 0])
        window.add_points(known)
        self._keep_candidates(
            points.take(torch.isin(points.pixel, known.pixel, invert=True).nonzero()[:, 0]), known, strength, frame
        )

    def _keep_candidates(
        self, points: WindowPoints, known: WindowPoints, strength: Tensor, frame: PyramidFrame
    ) -> None:
        """Follow points that could not be traced in the frames to come, with a guess by the known ones around."""
        if len(points) == 0 or len(known) == 0:
            self.candidates = None
            return
        ray, known_ray = self.builder.rays(points.pixel), self.builder.rays(known.pixel)
        spacing = math.sqrt(4 * math.pi / self.config.map.points)
        guess = guess_around(ray, known_ray, known.rho, spacing)
        self.candidates = Candidates(frame, points.pixel, ray, strength.flatten()[points.pixel], guess)

    def observe(self, frame: PyramidFrame, T_cam_key: Float64[Tensor, "4 4"], affine: Float64[Tensor, "2"]) -> None:
        """Look for the newest keyframe's candidates in a tracked frame."""
        if self.candidates is not None:
            self.candidates.observe(frame, T_cam_key, affine, self.config.epipolar, self.config.filter)

    def _activate(self) -> None:
        """Make points of the candidates whose ranges have become known; each lies in a cell of its own."""
        candidates, config = self.candidates, self.config
        if candidates is None:
            return
        ripe = candidates.ripe(config.map.max_relative_variance)
        if len(ripe):
            place = self.frames.index(candidates.frame)
            ray, rho = candidates.ray[:, ripe], candidates.points.rho[ripe]
            points = make_points(candidates.frame.targets[0], candidates.pixel[ripe], ray, rho, config.window, place)
            points = self.window.refine_points(points)
            self.window.add_points(points.take((points.inliers >= 1).nonzero()[:, 0]))

    def _view(self, host: int, other: int) -> View:
        frames = self.window.frames
        T = frames[other].T_cam_world @ lie.se3_inverse(frames[host].T_cam_world)
        a = frames[other].affine[0] - frames[host].affine[0]
        b = frames[other].affine[1] - a.exp() * frames[host].affine[1]
        return View(frames[other].target, T, torch.stack([a, b]))

    def _project(self, place: int) -> tuple[Int64[Tensor, "N"], Tensor, Tensor, Bool[Tensor, "N"]]:
        """Return all points in one keyframe: pixel, unit ray, inverse distance, and whether they look alike there."""
        points, frames = self.window.points, self.window.frames
        assert points is not None
        camera, T_cam_world = self.builder.cameras[0], frames[place].T_cam_world
        T_host_world = torch.stack([frame.T_cam_world for frame in frames])
        T = (T_cam_world @ lie.se3_inverse(T_host_world)).to(points.rho)[points.host]
        centre = CENTRE if points.ray.shape[2] > 1 else 0
        Y = torch.einsum("nij,jn->in", T[:, :3, :3], points.ray[..., centre]) + points.rho * T[:, :3, 3].T
        inv_length = Y.square().sum(0).clamp_min(1e-24).rsqrt()
        ray, rho = Y * inv_length, points.rho * inv_length
        uv, seen = camera.project(ray.T)
        column = uv[:, 0].long().clamp(0, camera.width - 1)
        row = uv[:, 1].long().clamp(0, camera.height - 1)
        affine = torch.stack([frame.affine for frame in frames]).to(points.rho)[points.host]
        scene = (points.value[:, centre] - affine[:, 1]) * (-affine[:, 0]).exp()
        own = frames[place].affine.to(points.rho)
        expected = own[0].exp() * scene + own[1]
        alike = (self.frames[place].value(ray) - expected).abs() < self.config.map.max_difference
        return row * camera.width + column, ray, rho, seen & alike & (points.weight[:, centre] > 0)

    def reference(self, place: int = -1) -> Keyframe:
        """Return the window's points as one keyframe sees them: what the next frames are tracked against."""
        place %= len(self.frames)
        points, frame = self.window.points, self.frames[place]
        assert points is not None
        pixel, ray, rho, ok = self._project(place)
        variance = self.config.track.noise**2 / points.curvature.clamp_min(1e-9)
        variance = variance * (rho / points.rho.clamp_min(1e-6)) ** 4
        index = ok.nonzero()[:, 0]
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


def _one_per_cell(cell: Int64[Tensor, "N"], cost: Tensor) -> Int64[Tensor, "M"]:
    """Return the cheapest index of each cell."""
    by_cost = cost.argsort(stable=True)
    order = by_cost[cell[by_cost].argsort(stable=True)]
    first = torch.ones_like(order, dtype=torch.bool)
    first[1:] = cell[order][1:] != cell[order][:-1]
    return order[first]
