"""The IMU of a synthetic sequence: what it would measure along the camera's path, with its noise and its biases.

Samples are of their instants: the path's derivatives by differences of fourth order over 2 ms. Without noise and biases
preintegration at 200 Hz comes back to the path of a walk within 1 mm and 0.002 deg after 5 s.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.inertial import ImuNoise, ImuSamples, ImuSensor
from torchvo360.inertial.samples import GRAVITY
from torchvo360.lie import so3_log

STEP_S = 2e-3
"""Of the differences, seconds: their error is below that of rounding for anything a hand can do."""
MARGIN_S = 0.5
"""How much earlier than the first frame, and later than the last, samples are taken."""
PHASE = 0.3
"""Where in a period of the IMU the first frame falls: samples and frames are not taken together."""
BIAS_GYRO, BIAS_ACCEL = 0.03, 0.08
"""Standard deviation of each axis's first bias, rad/s and m/s^2: EuRoC's are up to 0.08 and 0.14."""


@dataclass(frozen=True, eq=False)
class SyntheticImu:
    """A synthetic IMU with what it hides."""

    sensor: ImuSensor
    bias_gyro: Float64[Tensor, "M 3"]
    """True bias of every sample, rad/s."""
    bias_accel: Float64[Tensor, "M 3"]
    """m/s^2."""
    offset_s: float
    """True time to add to the IMU's to get the camera's; the sensor claims 0."""


@dataclass(frozen=True)
class ImuSetup:
    """How the IMU of a sequence is mounted and how bad it is."""

    T_cam_imu: Float64[Tensor, "4 4"]
    rate_hz: float
    noise: float
    """Times EuRoC's; 0 for none."""
    bias: float
    """Times `BIAS_GYRO` and `BIAS_ACCEL`; 0 for none."""
    offset_s: float
    gap_s: float
    """Without samples, at the middle."""
    seed: int


def make_imu(
    T_world_cam_at: Callable[[Float64[Tensor, "N"]], Float64[Tensor, "N 4 4"]], duration_s: float, setup: ImuSetup
) -> SyntheticImu:
    """Measure a path.

    Args:
        T_world_cam_at: The camera's poses at any times, seconds, metres, world z up.
        duration_s: Time of the last frame; the first one's is 0.
        setup: The IMU.
    """
    period = 1 / setup.rate_hz
    first, last = -math.ceil(MARGIN_S / period), math.floor((duration_s + MARGIN_S) / period)
    time = (torch.arange(first, last + 1, dtype=torch.float64) + PHASE) * period
    gyro, accel = _measure(lambda t: T_world_cam_at(t) @ setup.T_cam_imu, time)

    generator = torch.Generator().manual_seed(setup.seed)
    density = ImuNoise()
    bias, white = [], []
    for scale, walk, sigma in (
        (BIAS_GYRO, density.gyro_walk, density.gyro),
        (BIAS_ACCEL, density.accel_walk, density.accel),
    ):
        start = setup.bias * scale * torch.randn(1, 3, generator=generator, dtype=torch.float64)
        drawn = torch.randn(2, len(time), 3, generator=generator, dtype=torch.float64) * setup.noise
        bias.append(start + (drawn[0] * walk * math.sqrt(period)).cumsum(0))
        white.append(drawn[1] * sigma / math.sqrt(period))
    kept = (time - duration_s / 2).abs() >= setup.gap_s / 2
    samples = ImuSamples(
        ((time - setup.offset_s) * 1e9).round().long()[kept],
        (gyro + bias[0] + white[0])[kept],
        (accel + bias[1] + white[1])[kept],
    )
    grade = setup.noise if setup.noise > 0 else 1.0
    noise = ImuNoise(**{name: value * grade for name, value in vars(density).items()})
    return SyntheticImu(ImuSensor(samples, noise, setup.T_cam_imu), bias[0][kept], bias[1][kept], setup.offset_s)


def _measure(
    T_world_imu_at: Callable[[Float64[Tensor, "N"]], Float64[Tensor, "N 4 4"]], time: Float64[Tensor, "N"]
) -> tuple[Float64[Tensor, "N 3"], Float64[Tensor, "N 3"]]:
    """Return the angular rate and the specific force in the IMU's axes."""
    before2, before, now, after, after2 = (T_world_imu_at(time + k * STEP_S) for k in (-2, -1, 0, 1, 2))
    R_imu_world = now[:, :3, :3].mT
    near = so3_log(before[:, :3, :3].mT @ after[:, :3, :3]) / (2 * STEP_S)
    far = so3_log(before2[:, :3, :3].mT @ after2[:, :3, :3]) / (4 * STEP_S)
    p = [T[:, :3, 3] for T in (before2, before, now, after, after2)]
    force = (-p[0] + 16 * p[1] - 30 * p[2] + 16 * p[3] - p[4]) / (12 * STEP_S**2)
    force = force + force.new_tensor([0.0, 0.0, GRAVITY])
    # The error of each, the axis's own turn included, is even in its step: two steps cancel the second order.
    return (4 * near - far) / 3, (R_imu_world @ force[..., None])[..., 0]
