"""The odometry: frames in, a pose and a state for every one of them out.

A step builds the frame's pyramid. Without a map the starter waits until it can make one; with a map the follower
predicts, tracks, and makes keyframes, which the mapper adjusts together with their points. A frame that is lost is
looked for in the earlier keyframes, and after a while a new map is started. Keyframes that leave the window are
compared with the places seen before: loops correct the trajectory in the end, and join a new map to the old one at
once.
"""

import math
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor, nn

from torchvo360 import lie
from torchvo360.cameras import Camera, Rig
from torchvo360.checks import InputError, check_shape
from torchvo360.data.frame import Frame
from torchvo360.data.trajectory import Trajectory
from torchvo360.inertial import ImuSensor
from torchvo360.motion import PoseFilter
from torchvo360.vo.atlas import Atlas
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.follow import Follower
from torchvo360.vo.foresee import Foresight
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.inertial import InertialLink
from torchvo360.vo.keyframes.cloud import PointCloud
from torchvo360.vo.keyframes.keyframe import Keyframe, carried_keyframe
from torchvo360.vo.keyframes.mapper import Mapper
from torchvo360.vo.loops import LoopCloser, LoopEdge
from torchvo360.vo.modes import do
from torchvo360.vo.recover import Recovery
from torchvo360.vo.sensor import check_depth
from torchvo360.vo.smooth import smoothed
from torchvo360.vo.start.begin import LEARNED, Begun, Starter
from torchvo360.vo.start.learned import LearnedRanges
from torchvo360.vo.start.stereo import StereoRanges, check_others, check_rig
from torchvo360.vo.state import FrameEstimate, State
from torchvo360.vo.track import Track
from torchvo360.window import Metric, intrinsics_of


@dataclass(frozen=True)
class OdometryResult:
    """What the odometry leaves."""

    frames: list[FrameEstimate]
    """One for every frame that was given, in order, with final poses."""
    trajectory: Trajectory
    points: PointCloud
    keyframes: int
    before_loops: Trajectory
    """The trajectory without the loops' corrections; the same where none was closed."""
    loops: list[LoopEdge]
    """Verified loops, those that join maps included."""
    maps: int
    """Maps begun; more than one after losses."""
    intrinsics: tuple[float, float, float, float] | None = None
    """(fx, fy, cx, cy) as estimated, pixels; None where they were taken as given."""
    metric: bool = False
    """Whether the unit is the metre: by a rig, a depth sensor, an IMU or a depth network."""
    gravity: tuple[float, float, float] | None = None
    """In the world's axes, m/s^2, as the IMU told; None without it, or where the motion did not tell."""
    imu_offset_s: float | None = None
    """What was added to the IMU's times; None without one."""
    imu_reason: str = ""
    """A sentence on why an IMU told neither scale nor gravity."""


class VisualOdometry:
    """Estimates a camera's motion from its frames, one step a frame."""

    def __init__(
        self,
        camera: Camera,
        config: OdometryConfig | None = None,
        *,
        mask: Bool[Tensor, "H W"] | None = None,
        depth: nn.Module | None = None,
        seed: int = 0,
        device: torch.device | str = "cpu",
        rig: Rig | None = None,
        imu: ImuSensor | None = None,
    ) -> None:
        """Prepare for frames of one camera.

        Args:
            camera: The camera of all frames.
            config: Settings.
            mask: Pixels that may be used; all by default.
            depth: A network that fulfils `DepthEstimator`, on `device`: the odometry then begins with the first frame,
                and its unit is the network's metre.
            seed: Of the random samples at the start: equal seeds give equal trajectories.
            device: Where the images are kept.
            rig: The camera, first, and those fixed to it: the unit is then its metre, and every frame brings their
                images as `others`, None for one that is missing.
            imu: An IMU beside the camera, with its samples of the whole time: it carries the camera where images fail,
                and once it has moved enough the unit is the metre.

        Raises:
            ShapeError: The mask is not of the camera's size.
            InputError: The rig's first camera is another one, or all its centres are one.
        """
        self.config = config = OdometryConfig() if config is None else config
        if mask is not None:
            check_shape("mask", mask, f"{camera.height} {camera.width}")
            mask = mask.bool()
        if camera.wraps and camera.width % 2:
            raise InputError(f"camera: expected an even width for a full panorama, got {camera.width}.")
        levels = 1 + max(0, round(math.log2(max(1.0, camera.width / config.coarsest_width))))
        if rig is not None:
            check_rig(rig, camera)
            if depth is not None:
                raise InputError("rig: expected none beside a depth network: either gives the unit.")
        self._builder = FrameBuilder(
            camera, levels, config.blur_px, mask, config.saturation, device, rig, config.sensor
        )
        self._recovery = Recovery(self._builder, config.track, config.map.max_relative_variance)
        self._loops = LoopCloser(self._builder, config.loop)
        learned = stereo = None
        if depth is not None:
            learned = LearnedRanges(depth, self._builder, config.map, config.track.min_points)
        if rig is not None:
            stereo = StereoRanges(self._builder, config.map, config.trace, config.window, config.track.min_points)
        self._imu = None if imu is None else InertialLink(imu, config.inertial, config.track.noise)
        self._metrics: dict[int, Metric] = {}
        """Scale and gravity by map, as the IMU told."""
        self._starter = Starter(self._builder, config, torch.Generator().manual_seed(seed), learned, stereo)
        self._atlas = Atlas()
        self._follower: Follower | None = None
        self._worker = ThreadPoolExecutor(1, "keyframes") if config.overlap else None
        self._searching: Future[list[LoopEdge]] | None = None
        self._joined = False
        """Whether maps were joined of which no frame has told yet."""
        self._remembered_before, self._cameras_before = 0, self._builder.cameras
        self._lost = 0

    def step(self, frame: Frame) -> FrameEstimate:
        """Estimate the pose of the next frame.

        A frame with a problem gets a predicted pose. While there is no map the pose is a rotation.

        Raises:
            InputError: The image or the depth image is not of the camera's size, or index or time do not increase, or
                the depth network does not give ranges.
        """
        began = time.perf_counter()
        self._check(frame)
        if frame.image is None or frame.problem:
            estimate = self._predict(frame)
        else:
            ready = self._builder.build(frame.image, frame.index, frame.t_ns, frame.others, frame.depth)
            estimate = self._begin(ready) if self._follower is None else self._follow(self._follower, ready)
        estimate = replace(estimate, milliseconds=1e3 * (time.perf_counter() - began))
        self._atlas.estimates.append(estimate)
        if self._follower is not None:
            self._atlas.anchor(frame.index, self._follower.key.frame.index, lie.se3_inverse(self._follower.T_cam_key))
        return estimate

    def finish(self) -> OdometryResult:
        """Return all poses and points found so far; more steps may follow."""
        self._joined |= self._take_in_loops()
        atlas, loops = self._atlas, list(self._loops.edges)
        if self._follower is not None:
            leaving = self._follower.wait()
            loops += self._loops.search([*leaving, *self._follower.mapper.references()])
        before = atlas.keyframes()
        metric = self._is_metric()
        after = atlas.corrected(loops, self.config.loop.graph, metric=metric)
        frames, earlier, points = atlas.final(after), atlas.final(before), atlas.points(after)
        if self.config.smooth:
            frames = smoothed(frames, atlas.standing(after, points), self.config.motion)
        return OdometryResult(
            frames=frames,
            trajectory=_trajectory(frames),
            points=points,
            keyframes=len(after),
            before_loops=_trajectory(earlier),
            loops=loops,
            maps=len(atlas.S_world_map),
            intrinsics=self._builder.cameras[0].intrinsics if self.config.window.calibrate else None,
            metric=metric or any(estimate.reason == LEARNED for estimate in frames),
            gravity=self._gravity(),
            imu_offset_s=None if self._imu is None else self._imu.sensor.offset_s,
            imu_reason="" if self._imu is None or self._metrics else self._imu.reason,
        )

    def _is_metric(self) -> bool:
        """Return whether the first map, with those joined to it, is in metres: by a rig, a sensor or an IMU."""
        atlas = self._atlas
        first = [session for session in atlas.sessions if atlas.oldest[session.map] == 0]
        return any(session.mapper.metric or session.map in self._metrics for session in first)

    def _gravity(self) -> tuple[float, float, float] | None:
        """Return gravity in the world, by the oldest map that knows it."""
        if not self._metrics:
            return None
        map = min(self._metrics)
        S, gravity = self._atlas.S_world_map[map][:3, :3], self._metrics[map].gravity
        x, y, z = (S @ gravity * (gravity.norm() / (S @ gravity).norm())).tolist()
        return x, y, z

    def _check(self, frame: Frame) -> None:
        if self._atlas.estimates:
            last = self._atlas.estimates[-1]
            if frame.t_ns <= last.t_ns:
                raise InputError(f"t_ns: expected more than {last.t_ns}, got {frame.t_ns}.")
            if frame.index <= last.index:
                raise InputError(f"index: expected more than {last.index}, got {frame.index}.")
        camera = self._builder.cameras[0]
        expected = (camera.height, camera.width, 3)
        if frame.image is None or frame.problem:
            return
        if not isinstance(frame.image, np.ndarray) or frame.image.dtype != np.uint8:
            kind = getattr(frame.image, "dtype", type(frame.image).__name__)
            raise InputError(f"image: expected a NumPy array of uint8, got {kind}.")
        if frame.image.shape != expected:
            raise InputError(f"image: expected shape {list(expected)}, got {list(frame.image.shape)}.")
        check_others(frame, self._builder)
        check_depth(frame, camera)

    # Without a map

    @property
    def _waiting(self) -> State:
        return State.LOST if self._atlas.sessions else State.INITIALISING

    def _begin(self, frame: PyramidFrame) -> FrameEstimate:
        found = self._relocalised(frame)
        if found is not None:
            return found
        begun = self._starter.add(frame)
        if begun is not None:
            return self._take_over(begun, frame)
        return _estimate(frame, self._starter.pose(frame), self._waiting, self._starter.reason, None)

    def _take_over(self, begun: Begun, frame: PyramidFrame) -> FrameEstimate:
        """Go on with a map that has just begun, in place of a young one if there is one."""
        atlas, first = self._atlas, not self._atlas.sessions
        if begun.reason == "start_corrected":
            self._forget_map()
            atlas.begin(begun.mapper)
        elif begun.reason == "start_settled":
            earlier = [key for key in atlas.sessions[-1].mapper.poses() if key < begun.key]
            atlas.sessions[-1].mapper.close()
            atlas.begin(begun.mapper, map=atlas.sessions[-1].map, after=max(earlier, default=None))
        else:
            atlas.begin(begun.mapper)
        atlas.fill_in(begun.key, begun.T_key_cam)
        self._remembered_before, self._cameras_before = len(self._recovery), self._builder.cameras
        for key in begun.mapper.references()[:-1]:
            self._recovery.remember(key)
        self._follow_on(begun.mapper, begun.newest, frame, begun.motion)
        replaced = begun.reason in ("start_corrected", "start_settled")
        state = State.TRACKING if first or replaced else State.RELOCALISED
        reason = begun.reason if first or replaced else "new_map"
        return _estimate(frame, atlas.in_world(begun.newest.T_world_key), state, reason, begun.found)

    def _follow_on(
        self, mapper: Mapper, key: Keyframe, frame: PyramidFrame, motion: Float64[Tensor, "4 4"] | None = None
    ) -> None:
        foresight = Foresight(PoseFilter(self.config.motion), self._imu)
        if motion is not None:
            foresight.motion = motion
        mapper.imu = self._imu
        if self._imu is not None:
            self._imu.begin_map()
        self._follower = Follower(
            self._builder, self.config, self._recovery, mapper, foresight, key, worker=self._worker
        )
        self._follower.place(frame)
        self._lost = 0

    # With a map

    def _follow(self, follower: Follower, frame: PyramidFrame) -> FrameEstimate:
        found = follower.follow(frame)
        if found is None:
            return self._lose(follower, frame)
        for index, T_cam_key in follower.bridged.items():
            self._atlas.anchor(index, follower.key.frame.index, lie.se3_inverse(T_cam_key))
        if (begun := self._starter.watch(frame, follower.T_map_cam)) is not None:
            follower.take_over()
            self._close_loops(follower)
            self._take_in_loops()
            return self._take_over(begun, frame)
        if (metric := follower.mapper.window.metric) is not None:
            self._measured(follower, metric)
        joined = self._close_loops(follower) or self._joined
        self._joined = False
        T_world_cam = self._atlas.in_world(follower.T_map_cam)
        was_lost, self._lost = self._lost > 0, 0
        if joined:
            return _estimate(frame, T_world_cam, State.RELOCALISED, "maps_joined", found)
        if found.inliers < self.config.weak_inliers:
            return _estimate(frame, T_world_cam, State.WEAK, "low_agreement", found)
        state, reason = (State.RELOCALISED, "present_keyframe") if was_lost else (State.TRACKING, "ok")
        return _estimate(frame, T_world_cam, state, reason, found)

    def _close_loops(self, follower: Follower) -> bool:
        """Take in the loops of the keyframes that left the window before; return whether they joined maps.

        The keyframes that have left it since are compared with the places seen before until the next ones leave it.
        """
        left, follower.left = follower.left, []
        if not left:
            return False
        joined = self._take_in_loops()
        self._searching = do(self._worker, lambda: [edge for key in left for edge in self._loops.add(key)])
        return joined

    def _take_in_loops(self) -> bool:
        """Wait for loops that are being looked for, and join the maps that they connect; return whether any were."""
        if self._searching is None:
            return False
        edges, self._searching = self._searching.result(), None
        return any([self._atlas.join(edge) for edge in edges])  # noqa: C419  all of them, not the first

    def _measured(self, follower: Follower, metric: Metric) -> None:
        """Take in what the IMU says of the present map: its scale, unless that is known otherwise."""
        map = self._atlas.sessions[-1].map
        self._metrics[map] = metric
        oldest = self._atlas.oldest[map]
        if not follower.mapper.metric and (map == oldest or oldest not in self._metrics):
            self._atlas.rescale(float(metric.log_scale.exp()))

    def _predict(self, frame: Frame) -> FrameEstimate:
        reason = f"bad_frame_{frame.problem or 'unreadable'}"
        if self._follower is not None:
            self._follower.predict(frame)
            state = State.LOST if self._lost else State.WEAK
            return _estimate(frame, self._atlas.in_world(self._follower.T_map_cam), state, reason, None)
        last = self._atlas.estimates[-1].T_world_cam if self._atlas.estimates else torch.eye(4, dtype=torch.float64)
        return _estimate(frame, last, self._waiting, reason, None)

    # Losses

    def _lose(self, follower: Follower, frame: PyramidFrame) -> FrameEstimate:
        follower.take_over()
        self._close_loops(follower)
        self._take_in_loops()
        if self._starter.settling and not follower.mapper.settled:
            # The network misjudged its first keyframes: the corners have to do without.
            self._forget_map()
            return self._begin(self._as_before(frame))
        if self._starter.confirming:
            # Lost before the start was confirmed: a wrong start ends so, and nothing may be found again in its map.
            T_world_cam = self._atlas.in_world(follower.T_map_cam)
            unit = self._unit(follower)
            self._forget_map()
            self._starter.restart(T_world_cam, unit)
            return self._begin(self._as_before(frame))
        self._starter.rest()
        self._lost += 1
        found = self._relocalised(frame)
        if found is not None:
            return found
        if not follower.carried:
            follower.stand()
        T_world_cam = self._atlas.in_world(follower.T_map_cam)
        if self._lost < self.config.restart_after or follower.carried:
            return _estimate(frame, T_world_cam, State.LOST, "no_agreement", None)
        unit = self._unit(follower)
        self._retire(follower)
        self._follower = None
        self._starter.restart(T_world_cam, unit)
        begun = self._starter.add(frame)
        return self._take_over(begun, frame) if begun else _estimate(frame, T_world_cam, State.LOST, "restarting", None)

    def _unit(self, follower: Follower) -> float:
        """Return the median inverse distance that a follower sees, in the world's unit."""
        return follower.median_rho() / self._atlas.scale_of(self._atlas.sessions[-1].map)

    def _forget_map(self) -> None:
        """Take back the present map, which turned out wrong, and all that was kept of it."""
        gone = self._atlas.sessions[-1].map
        if sum(session.map == gone for session in self._atlas.sessions) == 1:
            self._metrics.pop(gone, None)
        self._recovery.forget(self._remembered_before)
        self._loops.forget(set(self._atlas.sessions[-1].mapper.poses()))
        self._atlas.drop_session()
        self._follower = None

    def _as_before(self, frame: PyramidFrame) -> PyramidFrame:
        """Return a frame with the intrinsics that held before a map that was taken back, and hold to them."""
        if not self.config.window.calibrate:
            return frame
        self._builder.recalibrate(intrinsics_of(self._cameras_before[0]))
        return self._builder.recalibrated(frame)

    def _relocalised(self, frame: PyramidFrame) -> FrameEstimate | None:
        """Look for a frame in the earlier keyframes, and go on from where it is found."""
        if not self._atlas.sessions:
            return None
        answer = None if self._follower is None else self._follower.elsewhere
        answer = answer or self._recovery.relocalise(frame, self.config.weak_inliers)
        if answer is None:
            return None
        old, found = answer
        lost, config = self._follower, self.config
        key = carried_keyframe(
            old,
            frame,
            found.T_cam_key,
            found.affine,
            self._builder,
            config.map,
            variance_floor=config.filter.variance_floor,
            max_difference=config.track.cutoff,
        )
        metric = self._atlas.mapper_of(old.index).metric
        mapper = Mapper.begun(key, self._builder, self.config, known=True, metric=metric)
        map = self._atlas.map_of(old.index)
        if self._imu is not None and map in self._metrics:
            velocity = None if lost is None else self._carried_velocity(self._imu, lost, key)
            self._imu.recouple(mapper.window, self._metrics[map], velocity)
        if lost is not None:
            self._retire(lost)
        self._atlas.begin(mapper, map=map, after=old.index)
        self._follow_on(mapper, key, frame)
        self._starter.rest()
        return _estimate(frame, self._atlas.in_world(key.T_world_key), State.RELOCALISED, "earlier_keyframe", found)

    def _carried_velocity(self, imu: InertialLink, lost: Follower, key: Keyframe) -> Float64[Tensor, "3"] | None:
        """Return the velocity that the IMU has carried on from a lost map, in the axes of a keyframe's map."""
        mapper = lost.mapper
        velocity = imu.velocity_at(mapper.window, mapper.frames[-1].t_ns, key.frame.t_ns) if lost.carried else None
        return None if velocity is None else key.T_world_key[:3, :3] @ lost.T_map_cam[:3, :3].mT @ velocity

    def _retire(self, follower: Follower) -> None:
        """Keep what a follower leaves: its keyframes, for relocalisation and for loops, and their points."""
        self._recovery.remember(follower.key)
        for key in follower.mapper.references():
            for edge in self._loops.add(key):
                self._atlas.join(edge)
        follower.mapper.close()


def _trajectory(frames: list[FrameEstimate]) -> Trajectory:
    t_ns = torch.tensor([estimate.t_ns for estimate in frames], dtype=torch.int64)
    poses = [estimate.T_world_cam for estimate in frames]
    return Trajectory(t_ns, torch.stack(poses) if poses else torch.zeros(0, 4, 4, dtype=torch.float64))


def _estimate(
    frame: Frame | PyramidFrame, T_world_cam: Float64[Tensor, "4 4"], state: State, reason: str, found: Track | None
) -> FrameEstimate:
    nan = math.nan
    residual, inliers = (nan, nan) if found is None else (found.residual, found.inliers)
    a, b = (nan, nan) if found is None else (float(found.affine[0]), float(found.affine[1]))
    covariance = None if found is None else found.covariance
    return FrameEstimate(frame.index, frame.t_ns, T_world_cam, state, reason, residual, inliers, a, b, 0.0, covariance)
