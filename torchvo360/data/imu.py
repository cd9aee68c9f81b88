"""Inertial measurements in EuRoC's format: a CSV file with nanoseconds, angular rates and specific forces."""

from pathlib import Path

import numpy as np
import torch

from torchvo360.checks import InputError
from torchvo360.data.table import Table
from torchvo360.inertial.samples import GRAVITY, LARGEST, ImuSamples

COLUMNS = "timestamp [ns],w_x,w_y,w_z [rad/s],a_x,a_y,a_z [m/s^2]"

SHORTEST_PERIOD_NS = 50_000
"""Median time between samples below which times are not in nanoseconds: no such sensor gives 20 kHz."""

LONGEST_PERIOD_NS = 50_000_000
"""Between fewer samples than 20 a second the motion of a hand is lost: 20 Hz made a map 3 % too small, 10 Hz 12 %."""

MOST_RATE = 20.0
"""Median angular rate above which the unit is not rad/s: three turns a second, all the time."""

FORCE_FACTOR = 2.0
"""A median specific force further than this factor from gravity's is in another unit, or lacks gravity."""


def read_imu_csv(path: str | Path) -> ImuSamples:
    """Read samples of an inertial measurement unit: `timestamp,w_x,w_y,w_z,a_x,a_y,a_z`, lines with # skipped.

    Times are whole nanoseconds and never go through a float. Gaps are allowed.

    Raises:
        InputError: The file is missing or empty; a line, named by its number, does not hold seven possible numbers at
            a time later than the one before; times, rates or forces are in another unit or the forces are without
            gravity; or there are fewer than two samples, or fewer than 20 a second.

    Source: EuRoC MAV dataset, ASL format, imu0/data.csv.
    """
    file = Path(path).expanduser()
    table = Table.read(file, COLUMNS, separator=",")
    table.check_width(7)
    t_ns = table.nanoseconds()
    if len(t_ns) < 2:
        raise InputError(f"{file}: expected at least two samples, got {len(t_ns)}.")
    period_ns = float(np.median(np.diff(t_ns)))
    if period_ns < SHORTEST_PERIOD_NS:
        raise InputError(f"{file}: expected times in nanoseconds, got a median step of {period_ns:g} of them.")
    if period_ns > LONGEST_PERIOD_NS:
        raise InputError(f"{file}: expected at least 20 samples a second, got {1e9 / period_ns:.3g}.")
    numbers = table.values(1, 7)
    wrong = np.argwhere(np.abs(numbers) > LARGEST)
    if len(wrong):
        row, column = wrong[0]
        raise table.complaint(int(row), f"numbers up to {LARGEST:g}", table.words[row][column + 1])
    rate, force = (float(np.median(np.linalg.norm(part, axis=1))) for part in (numbers[:, :3], numbers[:, 3:]))
    if rate > MOST_RATE:
        raise InputError(f"{file}: expected angular rates in rad/s, got a median of {rate:.3g}.")
    if not GRAVITY / FORCE_FACTOR <= force <= GRAVITY * FORCE_FACTOR:
        raise InputError(
            f"{file}: expected specific forces in m/s^2, at rest {GRAVITY:g} upwards, got a median of {force:.3g}."
        )
    values = torch.from_numpy(numbers)
    return ImuSamples(torch.from_numpy(t_ns), values[:, :3].contiguous(), values[:, 3:].contiguous())
