"""Where the next frame is expected: by the last motion, by a Kalman filter of the motion, and by an IMU."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.alignment import PosePrior
from torchvo360.motion import PoseFilter, PoseState
from torchvo360.motion.single import normalized
from torchvo360.vo.frame import PyramidFrame
from torchvo360.vo.inertial import InertialLink, Place
from torchvo360.vo.keyframes.keyframe import Keyframe
from torchvo360.vo.keyframes.mapper import Mapper
from torchvo360.vo.track import Track

MAX_PREDICTED = 10
"""Frames in a row that are given the last motion; then the camera is taken to stand, or a prediction would run away."""


def _identity() -> Float64[Tensor, "4 4"]:
    return torch.eye(4, dtype=torch.float64)


def _normalized(poses: list[Float64[Tensor, "4 4"]]) -> Float64[Tensor, "K 4 4"]:
    """Bring products of poses back to rigid motions: `lie.se3_normalized`, at a fraction of its calls for a few."""
    return torch.from_numpy(np.stack([normalized(T.numpy()) for T in poses]))


@dataclass(frozen=True)
class Expected:
    """Where a frame is looked for."""

    hypotheses: Float64[Tensor, "K 4 4"]
    """T_cam_key, the likeliest first."""
    prior: PosePrior | None = None
    """What is known of it besides its image."""
    carried: bool = False
    """Whether the likeliest is the IMU's, position included."""
    state: PoseState | None = None
    """The filter's, at the frame's time; None without one."""


@dataclass
class Foresight:
    """The motion of the camera against its keyframe, learnt from the frames that were found."""

    filter: PoseFilter
    imu: InertialLink | None
    motion: Float64[Tensor, "4 4"] = field(default_factory=_identity)
    """T_cam_last from one frame to the next, by the last two that were found."""
    state: PoseState | None = None
    """The filter's, at the last frame that was found; None before there are any."""

    def rest(self) -> None:
        """Take the camera to stand, so that the error of a lost frame cannot run away."""
        self.motion, self.state = _identity(), None

    def expect(
        self,
        mapper: Mapper,
        key: Keyframe,
        T_cam_key: Float64[Tensor, "4 4"],
        placed: PyramidFrame,
        T_placed_key: Float64[Tensor, "4 4"],
        t_ns: int,
    ) -> Expected:
        """Return where a frame is expected.

        Args:
            mapper: The present map.
            key: Its newest keyframe.
            T_cam_key: Where the camera was taken to be at the last frame, found or not.
            placed: The last frame that was found.
            T_placed_key: Where it was.
            t_ns: The frame's time.
        """
        ahead = self.motion @ T_cam_key
        hypotheses, prior, carried = [ahead, T_cam_key, self.motion @ ahead], None, False
        state, dt_s = None, (t_ns - placed.t_ns) / 1e9
        if self.state is not None:
            state = self.filter.predict(self.state, dt_s)
            hypotheses.insert(0, state.T_cam_key)
        if self.imu is not None:
            last = Place(placed.t_ns, T_placed_key @ lie.se3_inverse(key.T_world_key))
            foreseen = self.imu.foresee(mapper.window, mapper.frames[-1].t_ns, last, t_ns)
            if foreseen is not None:
                hypotheses.insert(0, foreseen.T_cam_world @ key.T_world_key)
                prior = self.imu.prior(foreseen, lie.se3_inverse(key.T_world_key))
                carried = foreseen.placed and dt_s <= self.imu.config.max_bridge_s
        return Expected(_normalized(hypotheses), prior, carried, state)

    def corrected(self, expected: Expected, found: Track) -> PoseState | None:
        """Return the filter's state with a frame that was found; None where it is beyond the gate, or there is none."""
        if expected.state is None:
            return None
        state, innovation = self.filter.update(expected.state, found.T_cam_key, found.covariance)
        return state if bool(self.filter.plausible(innovation)) else None

    def learn(
        self,
        found: Track,
        corrected: PoseState | None,
        since: Float64[Tensor, "6"],
        steps: int,
        dt_s: float,
        median_rho: float,
    ) -> None:
        """Take in a frame that was found.

        Args:
            found: Where.
            corrected: The filter's state with it, if it is credible.
            since: Log of T_cam_last from the last frame that was found.
            steps: Frames since that one.
            dt_s: Time since that one.
            median_rho: Median inverse distance of the points, by which accelerations are measured.
        """
        self.motion = lie.se3_exp(since / steps)
        if corrected is None:
            # What the motion so far does not explain begins a new one.
            start = self.filter.start(found.T_cam_key, median_range=1 / median_rho)
            corrected = PoseState(start.T_cam_key, since / dt_s, start.covariance, start.median_range)
        self.state = corrected

    def rekeyed(self, T_new_old: Float64[Tensor, "4 4"], median_rho: float) -> None:
        """Go on against another keyframe."""
        if self.state is not None:
            self.state = self.state.rekeyed(T_new_old, 1 / median_rho)
