"""The linear part of an inertial start: the gyro's bias from rotations, then velocities, scale and gravity.

Source: Mur-Artal and Tardos, "Visual-Inertial Monocular SLAM with Map Reuse", RA-L 2017, section IV.
"""

import math

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.inertial.joint import MAX_LOG_SCALE, Poses, State, scaled
from torchvo360.inertial.samples import GRAVITY
from torchvo360.lie import so3_left_jacobian, so3_log
from torchvo360.solve import solve_ldl

BIAS_STEPS = 3
"""Of Gauss-Newton; the second leaves a millionth of the bias."""
FEWEST = 4
"""Poses: with three there is one measured acceleration and nothing to check it by."""
APART_S = 0.25
"""Between the poses that are used for the scale: over less, their noise outweighs what the IMU measures, seconds."""


RIDGE = 1e-12
"""Share of a column's square that keeps one that no row speaks of from being divided by zero."""


def fit_gyro_bias(poses: Poses) -> Float64[Tensor, "3"] | None:
    """Fit the gyro's bias to the rotations between the poses; None where no segment is measured."""
    R = poses.R_world_imu
    turn = R[:-1].mT @ R[1:]
    bias = poses.T_cam_world.new_zeros(6)
    for _ in range(BIAS_STEPS):
        pre = poses.segments(bias)
        if not bool(pre.ok.any()):
            return None
        r = so3_log(pre.dR.mT @ turn)
        J = -torch.linalg.inv(so3_left_jacobian(r)) @ pre.J_R_bg  # Log(Exp(-J d) E)
        weight = pre.ok.to(r)[:, None]
        bias[:3] += _least_squares((J * weight[..., None]).flatten(0, 1), -(r * weight).flatten())
    return bias[:3]


def solve_linear(poses: Poses, bias_gyro: Float64[Tensor, "3"]) -> State | None:
    """Solve for velocities, scale and gravity; None where the scale is not positive."""
    chosen = _apart(poses.t_ns)
    apart = poses.take(chosen)
    pre = apart.segments(torch.cat([bias_gyro, torch.zeros_like(bias_gyro)]))
    T, M = apart.T_cam_world, len(chosen)
    R_world_cam = T[:, :3, :3].mT
    centre = -(R_world_cam @ T[:, :3, 3:])[..., 0]
    lever = R_world_cam @ poses.sensor.T_cam_imu[:3, 3]
    R_world_imu = apart.R_world_imu[:-1]
    dt = pre.dt[:, None, None]
    eye, k = torch.eye(3).to(T), torch.arange(M - 1)
    # Rows (velocity, position) of every segment, in the world's axes, by velocities, scale and gravity.
    velocity, position = (T.new_zeros(M - 1, 3, M, 3) for _ in range(2))
    velocity[k, :, k + 1] = eye
    velocity[k, :, k] = -eye
    position[k, :, k] = -eye * dt
    rows_v = torch.cat([velocity.flatten(2), T.new_zeros(M - 1, 3, 1), -eye * dt], -1)
    rows_p = torch.cat([position.flatten(2), centre.diff(dim=0)[..., None], -eye * dt**2 / 2], -1)
    right_v, right_p = (R_world_imu @ torch.stack([pre.dv, pre.dp], -1)).unbind(-1)
    right_p = right_p - lever.diff(dim=0)
    # A position over its time is a velocity: the two kinds of rows are then of one size.
    weight = pre.ok.to(T)[:, None]
    rows = torch.stack([rows_v * weight[..., None], rows_p * weight[..., None] / dt], 1).flatten(0, 2)
    right = torch.stack([right_v * weight, right_p * weight / dt[..., 0]], 1).flatten()
    solution = _least_squares(rows, right)
    scale, gravity = solution[-4], solution[-3:]
    length = torch.linalg.vector_norm(gravity)
    if not bool(scale > math.exp(-MAX_LOG_SCALE)) or not bool(length > GRAVITY / 10):
        return None
    nearest = (poses.t_ns[:, None] - poses.t_ns[chosen]).abs().argmin(1)
    motion = torch.cat([solution[:-4].view(M, 3)[nearest], T.new_zeros(len(nearest), 6)], -1)
    motion[:, 3:6] = bias_gyro
    return State(scaled(poses.T_cam_world, scale.log()), motion, scale.log(), gravity * (GRAVITY / length))


def _apart(t_ns: Int64[Tensor, "N"]) -> Int64[Tensor, "M"]:
    """Return poses that are at least `APART_S` apart, or all where that leaves too few."""
    slot = (t_ns - t_ns[0]) // round(APART_S * 1e9)
    first = torch.cat([slot.new_ones(1, dtype=torch.bool), slot.diff() > 0]).nonzero()[:, 0]
    return first if len(first) >= FEWEST else torch.arange(len(slot))


def _least_squares(rows: Float64[Tensor, "R D"], right: Float64[Tensor, "R"]) -> Float64[Tensor, "D"]:
    """Solve rows x = right; what no row speaks of is zero.

    By the normal equations: LAPACK's least squares give other bits with other places in memory, and these are a start.
    """
    size = torch.linalg.vector_norm(rows, dim=0).clamp_min(1e-12)
    J = rows / size
    A = J.mT @ J + RIDGE * torch.eye(J.shape[1]).to(J)
    x, ok = solve_ldl(A, J.mT @ right)
    return torch.where(ok, x / size, torch.zeros_like(x))
