"""Inertial measurements in EuRoC's format: a CSV file with nanoseconds, angular rates and specific forces."""

from pathlib import Path

import numpy as np
import torch

from torchvo360.checks import InputError
from torchvo360.data.table import Table
from torchvo360.inertial import ImuSamples

COLUMNS = "timestamp [ns],w_x,w_y,w_z [rad/s],a_x,a_y,a_z [m/s^2]"

SHORTEST_PERIOD_NS = 50_000
"""Median time between samples below which times are not in nanoseconds: no such sensor gives 20 kHz."""


def read_imu_csv(path: str | Path) -> ImuSamples:
    """Read samples of an inertial measurement unit: `timestamp,w_x,w_y,w_z,a_x,a_y,a_z`, lines with # skipped.

    Times are whole nanoseconds and never go through a float. Gaps are allowed.

    Raises:
        InputError: The file is missing or empty; a line, named by its number, does not hold seven finite numbers at a
            time later than the one before; the times are not in nanoseconds; or there are fewer than two samples.

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
    values = torch.from_numpy(table.values(1, 7))
    return ImuSamples(torch.from_numpy(t_ns), values[:, :3].contiguous(), values[:, 3:].contiguous())
