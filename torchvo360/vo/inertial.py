"""An IMU beside the odometry: it predicts where the camera goes, and couples a map to metres and to the vertical.

The images alone make a map in a unit and in axes of its own. Once its keyframes have moved enough, scale, gravity,
velocities and biases follow from them and the IMU together; from then on they are unknowns of the window beside the
poses. Until then the IMU serves by its rotation alone.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.alignment import PosePrior
from torchvo360.checks import InputError, check_finite_number
from torchvo360.inertial import ImuSensor, predict, preintegrate
from torchvo360.inertial.initialise import InertialStartConfig, initialise
from torchvo360.residuals.inertial import Preintegrated
from torchvo360.window import Coupling, Metric, Window

BIAS_SIGMA = 2e-3
"""Standard deviation of a coupled gyro's bias when a rotation is predicted by it, rad/s."""
START_SIGMA = (0.05, 2e-3, 0.05)
"""Standard deviations of the oldest keyframe's velocity, m/s, gyro bias, rad/s, and accelerometer bias, m/s^2, when a
window is coupled."""
DOUBT = 3.0
"""Scale and gravity are believed this much less than they claim then: the window's own samples are among those that
told them."""
PLACED_SIGMA = 2e-4
"""Standard deviation of the rotation of the frame from which it is predicted, rad."""


@dataclass(kw_only=True)
class InertialConfig:
    """Settings of the coupling with an IMU."""

    intensity: float = 0.05
    """Standard deviation of an intensity against which inertial residuals are weighed: pixels of one patch, and of one
    point in several keyframes, err together."""
    min_seconds: float = 2.0
    """Least time from a map's first keyframe until scale and gravity are sought."""
    min_keyframes: int = 6
    """Least number of keyframes for that."""
    max_scale_sigma: float = 0.05
    """Standard deviation of the log-scale above which the motion has not told it yet."""
    max_gap_s: float = 0.1
    """Longest time without a sample that is integrated over."""
    max_bridge_s: float = 4.0
    """Longest time without a usable image over which the camera is carried by the IMU alone."""
    rotation_prior: bool = True
    """Hold the rotation of a tracked frame to what the gyro says, as far as that is sure."""

    def __post_init__(self) -> None:
        for name in ("intensity", "min_seconds", "max_scale_sigma", "max_gap_s", "max_bridge_s"):
            check_finite_number(name, getattr(self, name), above=0)
        if self.min_keyframes < 4:
            raise InputError(f"min_keyframes: expected at least 4, got {self.min_keyframes}.")


class Place(NamedTuple):
    """A camera at a time."""

    t_ns: int
    T_cam_world: Float64[Tensor, "4 4"]
    """In the map's axes and unit."""


class Foreseen(NamedTuple):
    """Where a frame is expected."""

    T_cam_world: Float64[Tensor, "4 4"]
    rotation: Float64[Tensor, "3 3"]
    """Covariance of a turn of the camera on the left, rad^2."""
    placed: bool
    """Whether the position is the IMU's, too."""


class InertialLink:
    """What the odometry asks of an IMU."""

    def __init__(self, sensor: ImuSensor, config: InertialConfig, noise: float) -> None:
        """Keep the samples.

        Args:
            sensor: The IMU.
            config: Settings.
            noise: Standard deviation of an intensity in tracking.
        """
        self.sensor, self.config, self._noise = sensor, config, noise
        self.bias = torch.zeros(6, dtype=torch.float64)
        """Of gyro and accelerometer, the last known."""

    def between(self, times_ns: list[int], bias: Float64[Tensor, "*B 6"]) -> Preintegrated:
        """Return what was measured from each of the camera's times to the next."""
        t = torch.tensor(times_ns, dtype=torch.int64) - round(self.sensor.offset_s * 1e9)
        samples, noise = self.sensor.samples, self.sensor.noise
        return preintegrate(
            samples, t[:-1], t[1:], bias[..., :3], bias[..., 3:], noise, max_gap_s=self.config.max_gap_s
        )

    # Prediction

    def foresee(self, window: Window, key_ns: int, placed: Place, t_ns: int) -> Foreseen | None:
        """Predict a frame from the last one that was placed; None where there are no samples.

        Args:
            window: The present map's.
            key_ns: Time of its newest keyframe.
            placed: The last frame that was placed.
            t_ns: The frame's time.
        """
        bias = self._bias_of(window)
        pre = self.between([key_ns, placed.t_ns, t_ns], bias)
        if not bool(pre.ok[1]):
            return None
        T_cam_imu, R_cam_world = self.sensor.T_cam_imu, placed.T_cam_world[:3, :3]
        R_cam_imu = T_cam_imu[:3, :3]
        spread = pre.covariance[1, :3, :3] + (BIAS_SIGMA * float(pre.dt[1])) ** 2 * torch.eye(3, dtype=torch.float64)
        rotation = R_cam_imu @ spread @ R_cam_imu.mT + PLACED_SIGMA**2 * torch.eye(3, dtype=torch.float64)
        metric, motion = window.metric, window.frames[-1].motion
        moved = placed.t_ns > key_ns
        if metric is None or motion is None or (moved and not bool(pre.ok[0])):
            R = R_cam_imu @ pre.dR[1].mT @ R_cam_imu.mT @ R_cam_world
            centre = -R_cam_world.mT @ placed.T_cam_world[:3, 3]
            return Foreseen(lie.se3(R, -R @ centre), rotation, False)
        scale, gravity, velocity = metric.log_scale.exp(), metric.gravity, motion[:3]
        if moved:
            T_world_imu = _to_imu(window.frames[-1].T_cam_world, T_cam_imu, scale)
            _, velocity = predict(T_world_imu, velocity, pre.take(0), gravity)
        T_world_imu, _ = predict(_to_imu(placed.T_cam_world, T_cam_imu, scale), velocity, pre.take(1), gravity)
        return Foreseen(_to_camera(T_world_imu, T_cam_imu, scale), rotation, True)

    def prior(self, foreseen: Foreseen, T_key_world: Float64[Tensor, "4 4"]) -> PosePrior | None:
        """Return what a prediction says of a frame's rotation, against its keyframe."""
        if not (foreseen.placed and self.config.rotation_prior):
            return None
        information = torch.zeros(1, 6, 6, dtype=torch.float64)
        information[0, 3:, 3:] = self._noise**2 * torch.linalg.inv(foreseen.rotation)
        return PosePrior((foreseen.T_cam_world @ lie.se3_inverse(T_key_world))[None], information)

    def motion_after(self, window: Window, segment: Preintegrated) -> Float64[Tensor, "9"]:
        """Return velocity and biases after a segment that begins with the newest keyframe."""
        newest, metric = window.frames[-1], window.metric
        assert metric is not None
        assert newest.motion is not None
        T_world_imu = _to_imu(newest.T_cam_world, self.sensor.T_cam_imu, metric.log_scale.exp())
        _, velocity = predict(T_world_imu, newest.motion[:3], segment.take(0), metric.gravity)
        return torch.cat([velocity, newest.motion[3:]])

    def _bias_of(self, window: Window) -> Float64[Tensor, "6"]:
        motion = window.frames[-1].motion
        if motion is not None:
            self.bias = motion[3:]
        return self.bias

    # Coupling

    def couple(self, window: Window, T_cam_world: Float64[Tensor, "N 4 4"], times_ns: list[int]) -> bool:
        """Find scale, gravity, velocities and biases from a map's keyframes, and couple its window, if they tell.

        Args:
            window: The map's.
            T_cam_world: The map's keyframes, the oldest first; the last are those in the window.
            times_ns: Their times.
        """
        if len(times_ns) < self.config.min_keyframes or times_ns[-1] - times_ns[0] < self.config.min_seconds * 1e9:
            return False
        K, config = len(window.frames), self.config
        settings = InertialStartConfig(max_scale_deviation=config.max_scale_sigma, max_gap_s=config.max_gap_s)
        start = initialise(T_cam_world, torch.tensor(times_ns, dtype=torch.int64), self.sensor, settings)
        if not start.ok:
            return False
        motions = start.motions[-K:]
        segments = self.between(times_ns[-K:], motions[:-1, 3:])
        none = torch.zeros(2, dtype=torch.float64)
        told = start.covariance.diagonal().sqrt()
        window.couple(
            Coupling(self.sensor.T_cam_imu, self.sensor.noise, config.intensity**2, segments),
            Metric(start.log_scale, none, start.gravity),
            motions,
            1 / torch.cat([told.new_tensor(START_SIGMA).repeat_interleave(3), DOUBT * told]).square(),
        )
        self.bias = motions[-1, 3:]
        return True


def _to_imu(T_cam_world: Tensor, T_cam_imu: Tensor, scale: Tensor) -> Float64[Tensor, "4 4"]:
    """Return the IMU's metric pose."""
    T_world_cam = lie.se3_inverse(T_cam_world)
    T_world_cam[:3, 3] *= scale
    return T_world_cam @ T_cam_imu


def _to_camera(T_world_imu: Tensor, T_cam_imu: Tensor, scale: Tensor) -> Float64[Tensor, "4 4"]:
    """Return the camera's pose in the map's unit."""
    T_world_cam = T_world_imu @ lie.se3_inverse(T_cam_imu)
    T_world_cam[:3, 3] /= scale
    return lie.se3_inverse(lie.se3_normalized(T_world_cam))
