"""IMU recordings for tests: a smooth motion with known states, and a real flight with its truth."""

import csv
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchvo360.inertial import ImuSamples
from torchvo360.lie import matrix_from_quaternion

GRAVITY = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
ZERO = torch.zeros(3, dtype=torch.float64)


def normal(*shape: int, seed: int, scale: float = 1.0) -> Tensor:
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def lively_samples(seconds: float, rate_hz: float = 200.0, seed: int = 0) -> ImuSamples:
    """Return samples of a lively motion: up to 2 rad/s and 3 m/s^2 beside gravity, smooth in time."""
    time = torch.arange(round(seconds * rate_hz) + 1, dtype=torch.float64) / rate_hz
    frequency = 3 + normal(2, 3, seed=seed).abs() * 3
    phase, size = normal(2, 3, seed=seed + 1) * 3, normal(2, 3, seed=seed + 2)
    waves = torch.sin(time[:, None, None] * frequency + phase) * size
    upright = torch.tensor([0.0, 0.0, 9.81], dtype=torch.float64)
    return ImuSamples((time * 1e9).round().long(), waves[:, 0].contiguous(), 2 * waves[:, 1] + upright)


def at(*seconds: float) -> Tensor:
    """Return times in nanoseconds."""
    return torch.tensor([round(s * 1e9) for s in seconds], dtype=torch.int64)


@dataclass(frozen=True)
class Flight:
    """EuRoC's V1_02: samples, and the truth of the IMU itself at 40 Hz while there are samples."""

    samples: ImuSamples
    t_ns: Tensor
    R_world_imu: Tensor
    position: Tensor
    velocity: Tensor
    bias_gyro: Tensor
    bias_accel: Tensor


def _table(path: Path) -> tuple[Tensor, Tensor]:
    with path.open() as file:
        rows = list(csv.reader(file))[1:]
    values = torch.tensor([[float(x) for x in row[1:]] for row in rows], dtype=torch.float64)
    return torch.tensor([int(row[0]) for row in rows]), values


def read_flight(shared: Path) -> Flight:
    folder = shared / "data" / "imu" / "euroc_v1_02_40s" / "mav0"
    t_ns, imu = _table(folder / "imu0" / "data.csv")
    samples = ImuSamples(t_ns, imu[:, :3].contiguous(), imu[:, 3:].contiguous())
    t_ns, truth = _table(folder / "gt0" / "data.csv")
    kept = t_ns <= samples.t_ns[-1]
    t_ns, truth = t_ns[kept], truth[kept]
    return Flight(
        samples,
        t_ns,
        matrix_from_quaternion(truth[:, [4, 5, 6, 3]]),
        truth[:, :3],
        truth[:, 7:10],
        truth[:, 10:13],
        truth[:, 13:16],
    )
