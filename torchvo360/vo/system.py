"""The odometry: frames in, a pose and a state for every one of them out.

A step builds the frame's pyramid. Without a map the initialiser follows corners until it can make one; with a map the
follower predicts, tracks, fuses and makes keyframes. A frame that is lost is looked for in the earlier keyframes, and
after a while a new map is started and joined to the old one.

With a depth network the first frame is a map already, in metres; the corners go on, and the start they make, which is
more exact, takes its place in the network's unit.
"""

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor, nn

from torchvo360 import lie
from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_shape
from torchvo360.data.frame import Frame
from torchvo360.data.trajectory import Trajectory
from torchvo360.vo.cloud import PointCloud, join_clouds, to_cloud
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.follow import Follower, carried_keyframe
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.initialise import Initialiser, Start
from torchvo360.vo.learned import LearnedRanges
from torchvo360.vo.pending import fill_in, track_pending
from torchvo360.vo.recover import Recovery
from torchvo360.vo.state import FrameEstimate, State
from torchvo360.vo.track import Track

LEARNED = "learned_ranges"
"""The reason of a frame whose map is made of a depth network's ranges."""


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
        depth: nn.Module | None = None,
        seed: int = 0,
        device: torch.device | str = "cpu",
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

        Raises:
            ShapeError: The mask is not of the camera's size.
        """
        self.config = config = OdometryConfig() if config is None else config
        if mask is not None:
            check_shape("mask", mask, f"{camera.height} {camera.width}")
            mask = mask.bool()
        if camera.wraps and camera.width % 2:
            raise InputError(f"camera: expected an even width for a full panorama, got {camera.width}.")
        levels = 1 + max(0, round(math.log2(max(1.0, camera.width / config.coarsest_width))))
        self._builder = FrameBuilder(camera, levels, config.blur_px, mask, config.saturation, device)
        self._recovery = Recovery(self._builder, config.track, config.map.max_relative_variance)
        self._learned: LearnedRanges | None = None
        if depth is not None:
            self._learned = LearnedRanges(depth, self._builder, config.map, config.track.min_points)
        self._generator = torch.Generator().manual_seed(seed)
        self._estimates: list[FrameEstimate] = []
        self._clouds: list[PointCloud] = []
        self._maps = 0
        self._follower: Follower | None = None
        self._initialiser = self._new_initialiser()
        self._T_world_ref = torch.eye(4, dtype=torch.float64)
        self._unit = 1.0
        self._unconfirmed: Initialiser | None = None
        self._unsettled = False
        self._remembered_before = 0
        self._lost = 0

    def step(self, frame: Frame) -> FrameEstimate:
        """Estimate the pose of the next frame.

        A frame with a problem gets a predicted pose. While there is no map the pose is a rotation.

        Raises:
            InputError: The image is not of the camera's size, or index or time do not increase, or the depth network
                does not give ranges.
        """
        began = time.perf_counter()
        self._check(frame)
        if frame.image is None or frame.problem:
            estimate = self._predict(frame)
        else:
            ready = self._builder.build(frame.image, frame.index, frame.t_ns)
            follower = self._follower
            estimate = self._initialise(ready) if follower is None else self._follow(follower, ready)
        estimate = replace(estimate, milliseconds=1e3 * (time.perf_counter() - began))
        self._estimates.append(estimate)
        return estimate

    def finish(self) -> OdometryResult:
        """Return all poses and points found so far; more steps may follow."""
        clouds, keyframes = list(self._clouds), len(self._clouds)
        if self._follower is not None:
            last = to_cloud(self._follower.key, self.config.map.max_relative_variance)
            clouds += [*self._follower.clouds, last]
            keyframes = len(clouds)
        t_ns = torch.tensor([estimate.t_ns for estimate in self._estimates], dtype=torch.int64)
        poses = [estimate.T_world_cam for estimate in self._estimates]
        stacked = torch.stack(poses) if poses else torch.zeros(0, 4, 4, dtype=torch.float64)
        return OdometryResult(list(self._estimates), Trajectory(t_ns, stacked), join_clouds(clouds), keyframes)

    def _check(self, frame: Frame) -> None:
        if self._estimates:
            last = self._estimates[-1]
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

    # Without a map

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

    @property
    def _waiting(self) -> State:
        return State.INITIALISING if self._maps == 0 else State.LOST

    def _initialise(self, frame: PyramidFrame) -> FrameEstimate:
        found = self._relocalised(frame)
        if found is not None:
            return found
        starter = self._initialiser
        before = starter.pending[0] if starter.pending else None
        if before is None:
            starter.begin(frame)
        elif (start := starter.add(frame)) is not None:
            return self._begin_map(start, frame)
        elif starter.pending[0] is not before:
            # The corners ran out: go on from here, with the rotation reached so far.
            R = starter.R_ref_before
            self._T_world_ref = self._T_world_ref @ lie.se3(R.mT, R.new_zeros(3))
        if starter.pending[0] is not before and (begun := self._begin_learned(frame)) is not None:
            return begun
        R_cam_ref = starter.rotations[frame.index]
        T_world_cam = self._T_world_ref @ lie.se3(R_cam_ref.mT, R_cam_ref.new_zeros(3))
        return _estimate(frame, T_world_cam, self._waiting, starter.reason, None)

    def _begin_learned(self, frame: PyramidFrame) -> FrameEstimate | None:
        """Make the frame at which the corners begin a map of learned ranges; None without a network that knows them."""
        key = None if self._learned is None else self._learned.keyframe(frame, self._T_world_ref)
        if key is None:
            return None
        self._follower, self._unsettled = Follower(self._builder, self.config, self._recovery, key, placed=frame), True
        self._lost, self._maps = 0, self._maps + 1
        self._unit = float(key.points.rho[key.trusted(self.config.map.max_relative_variance)].median())
        state = State.TRACKING if self._maps == 1 else State.RELOCALISED
        return _estimate(frame, key.T_world_key, state, LEARNED, None)

    def _settle(self, frame: PyramidFrame, T_world_cam: Float64[Tensor, "4 4"]) -> Start | None:
        """Follow the corners beside a map of learned ranges; return the start that takes its place, once it can be."""
        reference = self._initialiser.pending[0]
        start = self._initialiser.add(frame)
        if self._initialiser.pending[0] is not reference:
            self._T_world_ref = T_world_cam
        return start

    def _begin_map(self, start: Start, frame: PyramidFrame, reason: str = "") -> FrameEstimate:
        """Take over a start: fill in the poses of the frames that waited for it, and go on from the newest."""
        # A new map after a loss takes the old one's unit by its median range, unless a network knows the metre.
        unit = None if self._learned is None else self._learned.unit(start.key)
        start = start.rescaled(self._unit if unit is None else unit)
        start.key.T_world_key = self._T_world_ref
        follower = Follower(self._builder, self.config, self._recovery, start.key)
        known, found = track_pending(start, self._initialiser.pending, follower, self.config)
        self._estimates = fill_in(self._estimates, start.key, known, self._initialiser.rotations)
        # The initialiser goes on following its corners, until they have confirmed the start.
        self._unconfirmed, self._initialiser = self._initialiser, self._new_initialiser()
        self._remembered_before = len(self._recovery)
        if self._unsettled and self._follower is not None:
            self._clouds += self._follower.clouds
        else:
            self._maps += 1
        self._follower, self._unsettled, self._lost = follower, False, 0
        state = State.TRACKING if self._maps == 1 or reason else State.RELOCALISED
        reason = reason or ("ok" if self._maps == 1 else "new_map")
        return _estimate(frame, follower.T_world_cam, state, reason, found)

    # With a map

    def _follow(self, follower: Follower, frame: PyramidFrame) -> FrameEstimate:
        found, T_world_cam = follower.follow(frame)
        if found is None:
            self._unconfirmed = None
            return self._lose(follower, frame)
        if self._unsettled and (start := self._settle(frame, T_world_cam)) is not None:
            return self._begin_map(start, frame, "start_settled")
        if self._unconfirmed is not None:
            T_cam_start = lie.se3_inverse(T_world_cam) @ self._T_world_ref
            over, start = self._unconfirmed.check(frame, T_cam_start)
            checked, self._unconfirmed = self._unconfirmed, None if over else self._unconfirmed
            if start is not None:
                self._initialiser = checked
                self._recovery.forget(self._remembered_before)
                return self._begin_map(start, frame, "start_corrected")
        was_lost, self._lost = self._lost > 0, 0
        if found.inliers < self.config.weak_inliers:
            return _estimate(frame, T_world_cam, State.WEAK, "low_agreement", found)
        state, reason = (State.RELOCALISED, "present_keyframe") if was_lost else (State.TRACKING, "ok")
        return _estimate(frame, T_world_cam, state, reason, found)

    def _predict(self, frame: Frame) -> FrameEstimate:
        reason = f"bad_frame_{frame.problem or 'unreadable'}"
        if self._follower is not None:
            self._follower.predict()
            return _estimate(frame, self._follower.T_world_cam, State.WEAK, reason, None)
        T_world_cam = self._estimates[-1].T_world_cam if self._estimates else self._T_world_ref
        return _estimate(frame, T_world_cam, self._waiting, reason, None)

    # Losses

    def _lose(self, follower: Follower, frame: PyramidFrame) -> FrameEstimate:
        if self._unsettled:
            self._unsettled = False
            if not follower.clouds:
                # The network misjudged its only keyframe: the corners have to do without.
                self._follower, self._maps = None, self._maps - 1
                return self._initialise(frame)
            self._initialiser = self._new_initialiser()
        self._lost += 1
        found = self._relocalised(frame)
        if found is not None:
            return found
        follower.stand()
        if self._lost < self.config.restart_after:
            return _estimate(frame, follower.T_world_cam, State.LOST, "no_agreement", None)
        self._retire(follower)
        self._T_world_ref, self._follower = follower.T_world_cam, None
        self._initialiser = self._new_initialiser()
        self._initialiser.begin(frame)
        return self._begin_learned(frame) or _estimate(frame, self._T_world_ref, State.LOST, "restarting", None)

    def _relocalised(self, frame: PyramidFrame) -> FrameEstimate | None:
        """Look for a frame in the earlier keyframes, and go on from where it is found."""
        if self._maps == 0:
            return None
        answer = self._recovery.relocalise(frame, self.config.weak_inliers)
        if answer is None:
            return None
        old, found = answer
        if self._follower is not None:
            self._retire(self._follower)
        key = carried_keyframe(old, frame, found, self._builder, self.config)
        self._follower, self._lost = Follower(self._builder, self.config, self._recovery, key, placed=frame), 0
        self._initialiser, self._unsettled = self._new_initialiser(), False
        return _estimate(frame, key.T_world_key, State.RELOCALISED, "earlier_keyframe", found)

    def _retire(self, follower: Follower) -> None:
        """Keep what a follower leaves: its keyframe for relocalisation, its points, its unit."""
        key = follower.key
        self._recovery.remember(key)
        self._clouds += [*follower.clouds, to_cloud(key, self.config.map.max_relative_variance)]
        used = key.points.score > 0
        self._unit = float(key.points.rho[used].median()) if bool(used.any()) else self._unit


def _estimate(
    frame: Frame | PyramidFrame, T_world_cam: Float64[Tensor, "4 4"], state: State, reason: str, found: Track | None
) -> FrameEstimate:
    nan = math.nan
    residual, inliers = (nan, nan) if found is None else (found.residual, found.inliers)
    a, b = (nan, nan) if found is None else (float(found.affine[0]), float(found.affine[1]))
    return FrameEstimate(frame.index, frame.t_ns, T_world_cam, state, reason, residual, inliers, a, b, 0.0)
