"""What an inertial measurement unit gives: angular rates and specific forces, their times, and how noisy they are."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_pose, check_shape
from torchvo360.residuals.inertial import ImuNoise

GRAVITY = 9.81
"""Length of gravity, m/s^2; it differs by 0.3 % between the equator and the poles."""

LARGEST = 1e5
"""Rates and forces, rad/s and m/s^2, that no sensor exceeds: ten thousand times gravity. Beyond it numbers overflow."""


def _identity() -> Float64[Tensor, "4 4"]:
    return torch.eye(4, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Samples of one IMU in its own axes, each of its instant; between them they are taken as linear in time.

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
            if bool((value.abs() > LARGEST).any()):
                row = int((value.abs() > LARGEST).any(1).nonzero()[0])
                raise InputError(f"imu.{name}: expected numbers up to {LARGEST:g}, got larger ones in sample {row}.")
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

    @cached_property
    def period_ns(self) -> int:
        """The median time between samples."""
        return int(self.t_ns.diff().median())


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
