"""The inertial residual: what an IMU measured between two keyframes against their poses, velocities and biases.

With the IMU's pose R_i = R_world_imu, P = e^sigma c + R_world_cam t_cam_imu (c is the camera's centre in the map's
unit, sigma the logarithm of the metres in one unit), its velocity V, gravity g and the preintegrated dR, dv, dp over dt
seconds:

    r_R = Log(dR(b_i)^T R_i^T R_j)                                  r_bg = bg_j - bg_i
    r_v = R_i^T (V_j - V_i - g dt) - dv(b_i)                        r_ba = ba_j - ba_i
    r_p = R_i^T (P_j - P_i - V_i dt - g dt^2 / 2) - dp(b_i)

Poses are T_cam_world, perturbed from the left by [v, w]: the centre moves by -R_world_cam v alone, and the IMU turns on
its right by -R_imu_cam w. Gravity keeps its length and turns by two angles.
Source: Forster et al., "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", TRO 2017, eq. 37 and 45.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from torchvo360.checks import check_finite_number
from torchvo360.lie import so3_exp, so3_hat, so3_left_jacobian, so3_log

ROTATION, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO, ACCEL = slice(0, 3), slice(3, 6)
SHORTEST_S = 1e-3
"""The biases' random walk is never taken as tighter than over this time, seconds."""


@dataclass(kw_only=True)
class ImuNoise:
    """Densities of an IMU's white noise and of its biases' random walk; the defaults are EuRoC's ADIS16448."""

    gyro: float = 1.6968e-4
    """rad / s / sqrt(Hz)."""
    accel: float = 2.0e-3
    """m / s^2 / sqrt(Hz)."""
    gyro_walk: float = 1.9393e-5
    """rad / s^2 / sqrt(Hz)."""
    accel_walk: float = 3.0e-3
    """m / s^3 / sqrt(Hz)."""

    def __post_init__(self) -> None:
        for name in ("gyro", "accel", "gyro_walk", "accel_walk"):
            check_finite_number(name, getattr(self, name), above=0)


class Preintegrated(NamedTuple):
    """Motion of an IMU over B segments of time, free of where it began: rotation, velocity and position increments.

    In the IMU's axes at the segment's start and without gravity. Where `ok` is False they are those of no motion.
    """

    dt: Float64[Tensor, "*batch"]
    """Length of the segment, seconds."""
    dR: Float64[Tensor, "*batch 3 3"]
    """R_start_end."""
    dv: Float64[Tensor, "*batch 3"]
    """m/s."""
    dp: Float64[Tensor, "*batch 3"]
    """Metres."""
    J_bias: Float64[Tensor, "*batch 9 6"]
    """Derivatives of (rotation on its right, velocity, position) by the biases (gyro, accel)."""
    covariance: Float64[Tensor, "*batch 9 9"]
    """Of (rotation on its right, velocity, position), by the samples' white noise."""
    bias_gyro: Float64[Tensor, "*batch 3"]
    """The gyro's bias that was taken off the samples, rad/s."""
    bias_accel: Float64[Tensor, "*batch 3"]
    """The accelerometer's, m/s^2."""
    ok: Bool[Tensor, "*batch"]
    """False: the samples do not cover the segment."""

    @property
    def J_R_bg(self) -> Float64[Tensor, "*batch 3 3"]:
        """Derivative of the rotation: dR(b + d) = dR(b) Exp(J_R_bg d)."""
        return self.J_bias[..., ROTATION, GYRO]

    def take(self, index: Tensor | slice | int) -> "Preintegrated":
        """Return the segments of an index, a mask, a slice or one place."""
        return Preintegrated(*(value[index] for value in self))

    def corrected(
        self, bias_gyro: Float64[Tensor, "*batch 3"], bias_accel: Float64[Tensor, "*batch 3"]
    ) -> tuple[Float64[Tensor, "*batch 3 3"], Float64[Tensor, "*batch 3"], Float64[Tensor, "*batch 3"]]:
        """Return (dR, dv, dp) under other biases, rad/s and m/s^2, to first order by the Jacobians."""
        change = torch.cat([bias_gyro - self.bias_gyro, bias_accel - self.bias_accel], -1)
        step = (self.J_bias @ change[..., None])[..., 0]
        dR = self.dR @ so3_exp(step[..., ROTATION])
        return dR, self.dv + step[..., VELOCITY], self.dp + step[..., POSITION]


class InertialRows(NamedTuple):
    """The residual of every segment with its Jacobians and its weight."""

    residual: Float64[Tensor, "B 15"]
    """Rotation (rad), velocity (m/s), position (m), and the change of the gyro's and the accelerometer's bias."""
    by_i: Float64[Tensor, "B 15 15"]
    """By the earlier keyframe: pose [v, w] in the map's unit, velocity, gyro bias, accelerometer bias."""
    by_j: Float64[Tensor, "B 15 15"]
    """By the later keyframe."""
    by_shared: Float64[Tensor, "B 15 3"]
    """By the log-scale and the two angles of gravity."""
    information: Float64[Tensor, "B 15 15"]
    """Inverse covariance; zero in the first nine rows where the segment was not measured."""


def gravity_basis(gravity: Float64[Tensor, "3"]) -> Float64[Tensor, "3 2"]:
    """Return the derivative of `turn_gravity` by its step: how gravity moves, m/s^2 per radian."""
    axis = torch.nn.functional.one_hot(gravity.detach().abs().argmin(), 3).to(gravity)
    across = torch.linalg.cross(gravity, axis)
    across = across * (torch.linalg.vector_norm(gravity) / torch.linalg.vector_norm(across))
    other = torch.linalg.cross(gravity, across) / torch.linalg.vector_norm(gravity)
    return torch.stack([across, other], -1)


def turn_gravity(gravity: Float64[Tensor, "3"], step: Float64[Tensor, "2"]) -> Float64[Tensor, "3"]:
    """Turn gravity by two angles, radians, about the axes across it; its length is kept."""
    axis = torch.linalg.cross(gravity, gravity_basis(gravity) @ step) / (gravity * gravity).sum()
    return so3_exp(axis) @ gravity


class _Ends(NamedTuple):
    """What both the residual and its Jacobians need of the two keyframes."""

    R_world_cam: Float64[Tensor, "2 B 3 3"]
    R_world_imu: Float64[Tensor, "2 B 3 3"]
    scaled_centre: Float64[Tensor, "2 B 3"]
    to_velocity: Float64[Tensor, "B 3"]
    """Change of the velocity without gravity's, in the IMU's axes at i."""
    to_position: Float64[Tensor, "B 3"]
    """Change of the position without the velocity's and gravity's share, in the IMU's axes at i."""


def _ends(
    pre: Preintegrated,
    T_cam_world: Float64[Tensor, "2 B 4 4"],
    motion: Float64[Tensor, "2 B 9"],
    log_scale: Float64[Tensor, ""],
    gravity: Float64[Tensor, "3"],
    T_cam_imu: Float64[Tensor, "4 4"],
) -> _Ends:
    R_world_cam = T_cam_world[..., :3, :3].mT
    R_world_imu = R_world_cam @ T_cam_imu[:3, :3]
    centre = -(R_world_cam @ T_cam_world[..., :3, 3:])[..., 0] * log_scale.exp()
    position = centre + R_world_cam @ T_cam_imu[:3, 3]
    velocity, dt = motion[..., :3], pre.dt[:, None]
    gained = velocity[1] - velocity[0] - gravity * dt
    gone = position[1] - position[0] - velocity[0] * dt - gravity * dt**2 / 2
    R_imu_world = R_world_imu[0].mT
    return _Ends(
        R_world_cam,
        R_world_imu,
        centre,
        (R_imu_world @ gained[..., None])[..., 0],
        (R_imu_world @ gone[..., None])[..., 0],
    )


def _residual(
    pre: Preintegrated, ends: _Ends, motion: Float64[Tensor, "2 B 9"]
) -> tuple[Float64[Tensor, "B 15"], Float64[Tensor, "B 3 3"]]:
    """Return the residual and the rotation E = dR^T R_i^T R_j whose logarithm its first rows are."""
    dR, dv, dp = pre.corrected(motion[0, :, 3:6], motion[0, :, 6:9])
    E = dR.mT @ ends.R_world_imu[0].mT @ ends.R_world_imu[1]
    walk = motion[1, :, 3:] - motion[0, :, 3:]
    return torch.cat([so3_log(E), ends.to_velocity - dv, ends.to_position - dp, walk], -1), E


def inertial_residual(
    pre: Preintegrated,
    T_cam_world_i: Float64[Tensor, "B 4 4"],
    T_cam_world_j: Float64[Tensor, "B 4 4"],
    motion_i: Float64[Tensor, "B 9"],
    motion_j: Float64[Tensor, "B 9"],
    log_scale: Float64[Tensor, ""],
    gravity: Float64[Tensor, "3"],
    T_cam_imu: Float64[Tensor, "4 4"],
) -> Float64[Tensor, "B 15"]:
    """Return the residual alone; the arguments are those of `linearize_inertial`."""
    T_cam_world, motion = torch.stack([T_cam_world_i, T_cam_world_j]), torch.stack([motion_i, motion_j])
    return _residual(pre, _ends(pre, T_cam_world, motion, log_scale, gravity, T_cam_imu), motion)[0]


def linearize_inertial(
    pre: Preintegrated,
    T_cam_world_i: Float64[Tensor, "B 4 4"],
    T_cam_world_j: Float64[Tensor, "B 4 4"],
    motion_i: Float64[Tensor, "B 9"],
    motion_j: Float64[Tensor, "B 9"],
    log_scale: Float64[Tensor, ""],
    gravity: Float64[Tensor, "3"],
    T_cam_imu: Float64[Tensor, "4 4"],
    noise: ImuNoise,
) -> InertialRows:
    """Linearise the inertial residual of B segments, each from keyframe i to keyframe j.

    Args:
        pre: The segments, preintegrated.
        T_cam_world_i: World to camera at the segment's start, in the map's unit.
        T_cam_world_j: The same at its end.
        motion_i: Velocity of the IMU in the world's axes (m/s), gyro bias (rad/s) and accelerometer bias (m/s^2).
        motion_j: The same at the end.
        log_scale: Logarithm of the metres in one unit of the map.
        gravity: In the world's axes, m/s^2, downwards.
        T_cam_imu: Pose of the IMU in the camera, metres.
        noise: The biases' random walk; the samples' noise is in `pre` already.

    Returns:
        Finite rows; those of a rotation residual of pi exactly are one-sided.
    """
    T_cam_world, motion = torch.stack([T_cam_world_i, T_cam_world_j]), torch.stack([motion_i, motion_j])
    ends = _ends(pre, T_cam_world, motion, log_scale, gravity, T_cam_imu)
    residual, E = _residual(pre, ends, motion)

    R_imu_cam, t_cam_imu = T_cam_imu[:3, :3].mT, T_cam_imu[:3, 3]
    R_imu_world, dt = ends.R_world_imu[0].mT, pre.dt[:, None, None]
    J_log = torch.linalg.inv(so3_left_jacobian(-residual[:, ROTATION]))  # Log(E Exp(d)) = Log(E) + J_log d
    J_turn_w = -R_imu_cam  # the IMU's turn on its right
    J_position_v = -log_scale.exp() * R_imu_world @ ends.R_world_cam
    J_position_w = R_imu_world @ ends.R_world_cam @ so3_hat(t_cam_imu)
    to_gyro_bias = motion[0, :, 3:6] - pre.bias_gyro
    turned = (pre.J_R_bg @ to_gyro_bias[..., None])[..., 0]

    by_i = residual.new_zeros(len(residual), 15, 15)
    by_i[:, 0:3, 3:6] = -J_log @ ends.R_world_imu[1].mT @ ends.R_world_imu[0] @ J_turn_w
    by_i[:, 0:3, 9:12] = -J_log @ E.mT @ so3_left_jacobian(-turned) @ pre.J_R_bg
    by_i[:, 3:6, 3:6] = so3_hat(ends.to_velocity) @ J_turn_w
    by_i[:, 3:6, 6:9] = -R_imu_world
    by_i[:, 6:9, 0:3] = -J_position_v[0]
    by_i[:, 6:9, 3:6] = so3_hat(ends.to_position) @ J_turn_w - J_position_w[0]
    by_i[:, 6:9, 6:9] = -R_imu_world * dt
    by_i[:, 3:9, 9:15] = -pre.J_bias[:, 3:9]
    eye = torch.eye(6).to(residual)
    by_i[:, 9:15, 9:15] = -eye

    by_j = torch.zeros_like(by_i)
    by_j[:, 0:3, 3:6] = J_log @ J_turn_w
    by_j[:, 3:6, 6:9] = R_imu_world
    by_j[:, 6:9, 0:3] = J_position_v[1]
    by_j[:, 6:9, 3:6] = J_position_w[1]
    by_j[:, 9:15, 9:15] = eye

    by_shared = residual.new_zeros(len(residual), 15, 3)
    J_gravity = R_imu_world @ gravity_basis(gravity)
    by_shared[:, 3:6, 1:] = -J_gravity * dt
    by_shared[:, 6:9, :1] = R_imu_world @ (ends.scaled_centre[1] - ends.scaled_centre[0])[..., None]
    by_shared[:, 6:9, 1:] = -J_gravity * dt**2 / 2
    return InertialRows(residual, by_i, by_j, by_shared, _information(pre, noise))


def _information(pre: Preintegrated, noise: ImuNoise) -> Float64[Tensor, "B 15 15"]:
    # A second and a cubed second stand side by side in it: invert the correlations, which are of one size.
    deviation = pre.covariance.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(pre.dt.dtype).tiny).sqrt()
    correlation = pre.covariance / (deviation[..., :, None] * deviation[..., None, :])
    factor, failed = torch.linalg.cholesky_ex(correlation)
    ok = pre.ok & (failed == 0)
    eye = torch.eye(9).to(factor)
    inverse = torch.cholesky_inverse(torch.where(ok[:, None, None], factor, eye))
    measured = inverse / (deviation[..., :, None] * deviation[..., None, :])
    information = pre.dt.new_zeros(len(pre.dt), 15, 15)
    information[:, :9, :9] = torch.where(ok[:, None, None], measured, torch.zeros_like(measured))
    density = pre.dt.new_tensor([noise.gyro_walk] * 3 + [noise.accel_walk] * 3)
    walk = density.square() * pre.dt.clamp_min(SHORTEST_S)[:, None]
    information[:, 9:, 9:] = torch.diag_embed(1 / walk)
    return information
