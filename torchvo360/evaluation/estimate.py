"""What is compared with the truth: a run's folder, or a trajectory alone."""

import csv
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from torchvo360.checks import InputError
from torchvo360.data.table import read_text
from torchvo360.data.trajectory import Trajectory
from torchvo360.data.tum import read_tum
from torchvo360.vo import State

TRAJECTORY, FRAMES = "trajectory.txt", "frames.csv"
"""Files of a run's folder."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A trajectory and, of a run, what became of its frames."""

    name: str
    trajectory: Trajectory
    states: Mapping[str, int] = field(default_factory=dict)
    """How many frames had each state; empty for a trajectory alone."""
    milliseconds: tuple[float, ...] = ()
    """Time that each frame took; empty for a trajectory alone."""


def read_estimate(path: str | Path) -> Estimate:
    """Read a run's folder or a TUM file.

    Raises:
        InputError: It is neither, or a file, told by name and line, is damaged.
    """
    place = Path(path).expanduser()
    if not place.is_dir():
        return Estimate(str(path), read_tum(path))
    if not (place / TRAJECTORY).is_file():
        raise InputError(f"{path}: expected a run's folder, with {TRAJECTORY}, or a TUM file, got a folder without.")
    trajectory = read_tum(place / TRAJECTORY)
    if not (place / FRAMES).is_file():
        return Estimate(str(path), trajectory)
    states, milliseconds = _read_frames(place / FRAMES)
    return Estimate(str(path), trajectory, states, milliseconds)


def _read_frames(path: Path) -> tuple[Counter[str], tuple[float, ...]]:
    states: Counter[str] = Counter()
    milliseconds: list[float] = []
    for number, row in enumerate(csv.DictReader(read_text(path, "frames").splitlines()), 2):
        try:
            states[State(row["state"])] += 1
            time_ms = float(row["milliseconds"] or "nan")
        except (KeyError, TypeError, ValueError):
            expected = "a known state and a time in columns `state` and `milliseconds`"
            raise InputError(f"{path}, line {number}: expected {expected}, got others.") from None
        if math.isfinite(time_ms):
            milliseconds.append(time_ms)
    return states, tuple(milliseconds)
