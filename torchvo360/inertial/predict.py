"""Where an IMU is after a segment, by its own measurements: what bridges the time without a usable image."""

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import check_shape
from torchvo360.lie import se3
from torchvo360.residuals.inertial import Preintegrated


def predict(
    T_world_imu: Float64[Tensor, "*batch 4 4"],
    velocity: Float64[Tensor, "*batch 3"],
    pre: Preintegrated,
    gravity: Float64[Tensor, "3"],
    bias_gyro: Float64[Tensor, "*batch 3"] | None = None,
    bias_accel: Float64[Tensor, "*batch 3"] | None = None,
) -> tuple[Float64[Tensor, "*batch 4 4"], Float64[Tensor, "*batch 3"]]:
    """Carry the pose and the velocity of an IMU over segments of time.

    Args:
        T_world_imu: Pose at the segment's start, metres.
        velocity: At the start, in the world's axes, m/s.
        pre: The segments; of one that is not `ok` the pose goes on with its velocity and without turning.
        gravity: In the world's axes, m/s^2, downwards.
        bias_gyro: Of the gyro, rad/s; by default what was taken off in the preintegration.
        bias_accel: Of the accelerometer, m/s^2; likewise.

    Returns:
        The pose and the velocity at the segment's end.

    Raises:
        ShapeError: The shapes do not fit.
    """
    check_shape("T_world_imu", T_world_imu, "... 4 4")
    check_shape("velocity", velocity, "... 3")
    check_shape("gravity", gravity, "3")
    bias_gyro = pre.bias_gyro if bias_gyro is None else bias_gyro
    bias_accel = pre.bias_accel if bias_accel is None else bias_accel
    ok, dt = pre.ok[..., None], pre.dt[..., None]
    corrected = pre.corrected(bias_gyro, bias_accel)
    dR = torch.where(ok[..., None], corrected[0], torch.eye(3).to(pre.dR))
    # An unmeasured segment has no weight to take off: its fall is left out as well.
    dv, dp, fall = (torch.where(ok, x, torch.zeros_like(x)) for x in (*corrected[1:], gravity.expand_as(pre.dv)))
    R_world_imu = T_world_imu[..., :3, :3]
    gained, gone = (R_world_imu @ torch.stack([dv, dp], -1)).unbind(-1)
    position = T_world_imu[..., :3, 3] + velocity * dt + fall * dt**2 / 2 + gone
    return se3(R_world_imu @ dR, position), velocity + fall * dt + gained
