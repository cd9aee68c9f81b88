"""What an inertial measurement unit gives: angular rates and specific forces, their times, and how noisy they are."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_finite_number, check_pose, check_shape


def _identity() -> Float64[Tensor, "4 4"]:
    return torch.eye(4, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Samples of one IMU in its own axes; sample m holds from its time until the next one's.

    `accel` is the specific force: at rest it points up and has the length of gravity.
    """

    t_ns: Int64[Tensor, "M"]
    gyro: Float64[Tensor, "M 3"]
    """Angular rate, rad/s."""
    accel: Float64[Tensor, "M 3"]
    """Specific force, m/s^2."""

    def __post_init__(self) -> None:
        check_shape("imu.t_ns", self.t_ns, "M")
        for name in ("gyro", "accel"):
            value = getattr(self, name)
            check_shape(f"imu.{name}", value, f"{len(self.t_ns)} 3")
            if value.dtype != torch.float64:
                raise InputError(f"imu.{name}: expected float64, got {value.dtype}.")
            if not bool(torch.isfinite(value).all()):
                row = int((~torch.isfinite(value).all(1)).nonzero()[0])
                raise InputError(f"imu.{name}: expected finite numbers, got others in sample {row}.")
        if self.t_ns.dtype != torch.int64:
            raise InputError(f"imu.t_ns: expected int64, got {self.t_ns.dtype}.")
        if len(self.t_ns) < 2:
            raise InputError(f"imu: expected at least two samples, got {len(self.t_ns)}.")
        step = self.t_ns.diff()
        if not bool((step > 0).all()):
            row = int((step <= 0).nonzero()[0]) + 1
            what = "repeats" if int(step[row - 1]) == 0 else "precedes"
            raise InputError(f"imu.t_ns: expected increasing times, got sample {row}, which {what} the one before it.")

    def __len__(self) -> int:
        return self.t_ns.shape[0]

    @property
    def period_ns(self) -> int:
        """The median time between samples."""
        return int(self.t_ns.diff().median())


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


@dataclass(frozen=True, eq=False)
class ImuSensor:
    """An IMU beside a camera: its samples, its noise, and where it is."""

    samples: ImuSamples
    noise: ImuNoise = field(default_factory=ImuNoise)
    T_cam_imu: Float64[Tensor, "4 4"] = field(default_factory=_identity)
    """Pose of the IMU in the (first) camera, metres."""
    offset_s: float = 0.0
    """Add it to the IMU's times to get the camera's."""

    def __post_init__(self) -> None:
        check_shape("T_cam_imu", self.T_cam_imu, "4 4")
        check_pose("T_cam_imu", self.T_cam_imu)
        if not math.isfinite(self.offset_s):
            raise InputError(f"offset_s: expected a finite number, got {self.offset_s}.")
