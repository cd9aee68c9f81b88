"""An IMU beside the odometry: it predicts where the camera goes, and couples a map to metres and to the vertical.

The images alone make a map in a unit and in axes of its own. Once its keyframes have moved enough, scale, gravity,
velocities and biases follow from them and the IMU together; from then on they are unknowns of the window beside the
poses. Until then the IMU serves by its rotation alone.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.alignment import PosePrior
from torchvo360.checks import InputError, check_finite_number
from torchvo360.inertial import ImuSensor, compose, predict, preintegrate
from torchvo360.inertial.initialise import InertialStartConfig, initialise
from torchvo360.inertial.offset import estimate_offset
from torchvo360.residuals.inertial import Preintegrated
from torchvo360.window import Coupling, Metric, Window

BIAS_SIGMA = 2e-3
"""Standard deviation of a coupled gyro's bias when a rotation is predicted by it, rad/s."""
START_SIGMA = (0.05, 2e-3, 0.05)
"""Standard deviations of the oldest keyframe's velocity, m/s, gyro bias, rad/s, and accelerometer bias, m/s^2, when a
window is coupled."""
MOST_TURNS = 1800
"""Frames from which the offset of the clocks is estimated, the first of a map: a minute."""
SURELY = 3.0
"""Standard deviations by which an offset must differ from the one that was used to take its place."""
POSE_SIGMA = (3e-4, 2e-4)
"""Least standard deviations of a keyframe's position, in the map's unit, and rotation, rad, when scale is sought."""
LOST_SIGMA = 1.0
"""Of the velocity after the samples had a gap, m/s."""
METRIC_SIGMA = (0.01, 3e-3, 3e-3)
"""Of log-scale and the angles of gravity when a map that has them is taken up again."""
HELD_SIGMA = 1e-3
"""Of the log-scale of a map that is in metres already, by a rig or a depth sensor."""
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
    estimate_offset: bool = True
    """Estimate the offset between the camera's and the IMU's clocks from how both turned, and correct it where it is
    surely not the one given: before a map is coupled, and again whenever twice as much has been seen."""
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


class _SinceKey(NamedTuple):
    """What was measured since the newest keyframe, as far as frames have been placed."""

    key_ns: int
    until_ns: int
    bias: Float64[Tensor, "6"]
    pre: Preintegrated
    """A batch of one."""


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
        self.reason = ""
        """Why scale and gravity are not known; empty before they were sought, and where they are."""
        self._turned: list[tuple[int, Float64[Tensor, "3 3"]]] = []
        self._span_ns = 0
        self._since: _SinceKey | None = None

    def between(self, times_ns: list[int], bias: Float64[Tensor, "*B 6"]) -> Preintegrated:
        """Return what was measured from each of the camera's times to the next."""
        t = torch.tensor(times_ns, dtype=torch.int64) - round(self.sensor.offset_s * 1e9)
        samples, noise = self.sensor.samples, self.sensor.noise
        return preintegrate(
            samples, t[:-1], t[1:], bias[..., :3], bias[..., 3:], noise, max_gap_s=self.config.max_gap_s
        )

    def note(self, t_ns: int, R_world_cam: Float64[Tensor, "3 3"]) -> None:
        """Note how a frame of the present map was turned, for the offset of the clocks."""
        if self.config.estimate_offset and len(self._turned) < MOST_TURNS:
            self._turned.append((t_ns, R_world_cam))

    def begin_map(self) -> None:
        """Forget what was noted: another map has axes of its own."""
        self._turned, self._span_ns, self._since = [], 0, None

    def retimed(self) -> bool:
        """Estimate the offset of the clocks where there is twice as much to tell it; return whether that changed it."""
        span_ns = self._turned[-1][0] - self._turned[0][0] if self._turned else 0
        if span_ns < max(2 * self._span_ns, self.config.min_seconds * 1e9):
            return False
        self._span_ns = span_ns
        times, turns = zip(*self._turned, strict=True)
        found = estimate_offset(torch.stack(turns), torch.tensor(times, dtype=torch.int64), self.sensor)
        if not found.ok or abs(found.offset_s - self.sensor.offset_s) < SURELY * found.deviation_s:
            return False
        self.sensor, self._since = replace(self.sensor, offset_s=found.offset_s), None
        return True

    def _since_key(self, key_ns: int, until_ns: int, bias: Float64[Tensor, "6"]) -> Preintegrated:
        """Return the motion since the newest keyframe, a batch of one; most of it is known from the frame before."""
        last = self._since
        if last is None or last.key_ns != key_ns or last.until_ns > until_ns or not torch.equal(last.bias, bias):
            pre = self.between([key_ns, until_ns], bias)
        elif last.until_ns == until_ns:
            return last.pre
        else:
            pre = compose(last.pre, self.between([last.until_ns, until_ns], bias))
        self._since = _SinceKey(key_ns, until_ns, bias, pre)
        return pre

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
        pre = self.between([placed.t_ns, t_ns], bias)
        if not bool(pre.ok):
            return None
        T_cam_imu, R_cam_world = self.sensor.T_cam_imu, placed.T_cam_world[:3, :3]
        R_cam_imu, eye = T_cam_imu[:3, :3], torch.eye(3, dtype=torch.float64)
        spread = pre.covariance[0, :3, :3] + (BIAS_SIGMA * float(pre.dt)) ** 2 * eye
        rotation = R_cam_imu @ spread @ R_cam_imu.mT + PLACED_SIGMA**2 * eye
        velocity = self.velocity_at(window, key_ns, placed.t_ns)
        if velocity is None or window.metric is None:
            R = R_cam_imu @ pre.dR[0].mT @ R_cam_imu.mT @ R_cam_world
            centre = -R_cam_world.mT @ placed.T_cam_world[:3, 3]
            return Foreseen(lie.se3(R, -R @ centre), rotation, False)
        scale, gravity = window.metric.log_scale.exp(), window.metric.gravity
        T_world_imu, _ = predict(_to_imu(placed.T_cam_world, T_cam_imu, scale), velocity, pre.take(0), gravity)
        T_cam_world = _to_camera(T_world_imu, T_cam_imu, scale)
        return Foreseen(T_cam_world, rotation, True) if bool(torch.isfinite(T_cam_world).all()) else None

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

    def couple(
        self, window: Window, T_cam_world: Float64[Tensor, "N 4 4"], times_ns: list[int], *, metric: bool
    ) -> bool:
        """Find scale, gravity, velocities and biases from a map's keyframes, and couple its window, if they tell.

        Args:
            window: The map's.
            T_cam_world: The map's keyframes, the oldest first; the last are those in the window.
            times_ns: Their times.
            metric: Whether the map is in metres already: its scale is then held.
        """
        if len(times_ns) < self.config.min_keyframes or times_ns[-1] - times_ns[0] < self.config.min_seconds * 1e9:
            return False
        K, config = len(window.frames), self.config
        settings = InertialStartConfig(
            position=POSE_SIGMA[0],
            rotation=POSE_SIGMA[1],
            max_scale_deviation=config.max_scale_sigma,
            max_gap_s=config.max_gap_s,
        )
        start = initialise(T_cam_world, torch.tensor(times_ns, dtype=torch.int64), self.sensor, settings)
        self.reason = start.reason
        if not start.ok:
            return False
        motions = start.motions[-K:].clone()
        segments = self.between(times_ns[-K:], motions[:-1, 3:])
        none = torch.zeros(2, dtype=torch.float64)
        told, log_scale = DOUBT * start.covariance.diagonal().sqrt(), start.log_scale
        if metric:
            motions[:, :3] /= log_scale.exp()
            told[0], log_scale = HELD_SIGMA, torch.zeros_like(log_scale)
        window.couple(
            Coupling(self.sensor.T_cam_imu, self.sensor.noise, config.intensity**2, segments),
            Metric(log_scale, none, start.gravity),
            motions,
            1 / torch.cat([told.new_tensor(START_SIGMA).repeat_interleave(3), told]).square(),
        )
        self.bias = motions[-1, 3:]
        return True

    def recouple(
        self,
        window: Window,
        metric: Metric,
        velocity: Float64[Tensor, "3"] | None,
    ) -> None:
        """Couple a window of one keyframe on a map whose scale and gravity are known.

        Args:
            window: The window.
            metric: The map's.
            velocity: Of the IMU in the map's axes, m/s, as the samples have carried it; None where they have not.
        """
        sigma = torch.tensor(START_SIGMA if velocity is not None else (LOST_SIGMA, *START_SIGMA[1:]))
        at = torch.zeros(3, dtype=torch.float64) if velocity is None else velocity
        held = torch.tensor(METRIC_SIGMA, dtype=torch.float64)
        window.couple(
            Coupling(self.sensor.T_cam_imu, self.sensor.noise, self.config.intensity**2, self.between([0], self.bias)),
            metric,
            torch.cat([at, self.bias])[None],
            1 / torch.cat([sigma.double().repeat_interleave(3), held]).square(),
        )

    def velocity_at(self, window: Window, key_ns: int, t_ns: int) -> Float64[Tensor, "3"] | None:
        """Return the velocity that the samples have carried on from a window's newest keyframe; None without them."""
        motion = window.frames[-1].motion
        if window.metric is None or motion is None or t_ns <= key_ns:
            return None if motion is None else motion[:3]
        segment = self._since_key(key_ns, t_ns, self._bias_of(window))
        return self.motion_after(window, segment)[:3] if bool(segment.ok) else None


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
