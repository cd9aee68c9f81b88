"""What is refused of an IMU's samples, in one sentence each."""

import math

import pytest
import torch
from imu_recordings import at

from torchvo360.checks import InputError
from torchvo360.inertial import ImuNoise, ImuSamples, ImuSensor


def samples(*seconds: float, **changes: torch.Tensor) -> ImuSamples:
    values = {name: torch.ones(len(seconds), 3, dtype=torch.float64) for name in ("gyro", "accel")}
    return ImuSamples(**{"t_ns": at(*seconds), **values, **changes})


def test_a_gap_is_no_mistake():
    assert len(samples(0.0, 0.005, 3.0)) == 3
    assert samples(0.0, 0.005, 0.01, 3.0).period_ns == 5_000_000


def test_times_that_do_not_increase_are_named():
    with pytest.raises(InputError, match=r"^imu\.t_ns: expected increasing times, got sample 2, which repeats the"):
        samples(0.0, 0.1, 0.1, 0.2)
    with pytest.raises(InputError, match=r"^imu\.t_ns: expected increasing times, got sample 3, which precedes the"):
        samples(0.0, 0.1, 0.2, 0.15)
    with pytest.raises(InputError, match=r"expected increasing times, got sample 1, which precedes"):
        samples(0.3, 0.2, 0.1)


def test_other_values_are_named():
    with pytest.raises(InputError, match="imu: expected at least two samples, got 1"):
        samples(0.0)
    gyro = torch.zeros(3, 3, dtype=torch.float64)
    gyro[1, 2] = math.nan
    with pytest.raises(InputError, match=r"imu\.gyro: expected finite numbers, got others in sample 1"):
        samples(0.0, 0.1, 0.2, gyro=gyro)
    with pytest.raises(InputError, match=r"imu\.accel: expected numbers up to 100000, got larger ones in sample 2"):
        samples(0.0, 0.1, 0.2, accel=torch.tensor([0.0, -9.81, -1e200], dtype=torch.float64)[:, None].expand(3, 3))
    with pytest.raises(InputError, match=r"imu\.accel: expected float64, got torch\.float32"):
        samples(0.0, 0.1, accel=torch.zeros(2, 3))
    with pytest.raises(InputError, match=r"imu\.accel: expected shape \[2 3\], got \[3, 3\]"):
        samples(0.0, 0.1, accel=torch.zeros(3, 3, dtype=torch.float64))


def test_an_impossible_sensor_is_refused():
    with pytest.raises(InputError, match="gyro_walk: expected a finite number above 0, got 0"):
        ImuNoise(gyro_walk=0.0)
    with pytest.raises(InputError, match="T_cam_imu: expected rigid motions"):
        ImuSensor(samples(0.0, 0.1), T_cam_imu=2 * torch.eye(4, dtype=torch.float64))
    with pytest.raises(InputError, match="offset_s: expected a finite number, got nan"):
        ImuSensor(samples(0.0, 0.1), offset_s=math.nan)
