"""Trajectories in the TUM format: one line `timestamp tx ty tz qx qy qz qw` for a pose T_world_cam."""

import math
from decimal import Decimal, InvalidOperation
from pathlib import Path

import torch

from torchvo360.checks import InputError
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import matrix_from_quaternion, se3

LEAST_QUATERNION = 1e-6
"""Length under which a quaternion is taken for zero; any other is normalised."""

LARGEST_T_NS = 2**63 - 1


def read_tum(path: str | Path) -> Trajectory:
    """Read a trajectory: seconds, metres and unit quaternions, separated by spaces; lines with # in front are skipped.

    Times become integer nanoseconds by decimal arithmetic, without going through a float.

    Raises:
        InputError: The file is missing or empty, or a line, named by its number, does not hold a finite pose at a time
            later than the one before.
    """
    file = Path(path).expanduser()
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: expected a trajectory file, got {error.strerror or error}.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected a text file with a trajectory, got a binary file.") from None
    times: list[int] = []
    poses: list[list[float]] = []
    for number, line in enumerate(text.lstrip("\ufeff").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}, line {number}"
        t_ns, pose = _parse(words, where)
        if times and t_ns <= times[-1]:
            raise InputError(f"{where}: expected a time later than the line before, got {words[0]}.")
        times.append(t_ns)
        poses.append(pose)
    if not times:
        raise InputError(f"{path}: expected lines `timestamp tx ty tz qx qy qz qw`, got none.")
    values = torch.tensor(poses, dtype=torch.float64)
    return Trajectory(torch.tensor(times), se3(matrix_from_quaternion(values[:, 3:]), values[:, :3]))


def _parse(words: list[str], where: str) -> tuple[int, list[float]]:
    if len(words) != 8:
        raise InputError(f"{where}: expected 8 numbers, timestamp tx ty tz qx qy qz qw, got {len(words)}.")
    try:
        seconds, pose = Decimal(words[0]), [float(word) for word in words[1:]]
    except (InvalidOperation, ValueError):
        raise InputError(
            f"{where}: expected 8 numbers, timestamp tx ty tz qx qy qz qw, got {' '.join(words)!r}."
        ) from None
    if not (seconds.is_finite() and all(map(math.isfinite, pose))):
        raise InputError(f"{where}: expected finite numbers, got {' '.join(words)!r}.")
    if math.hypot(*pose[3:]) < LEAST_QUATERNION:
        raise InputError(f"{where}: expected a unit quaternion qx qy qz qw, got zero.")
    if abs(seconds) > LARGEST_T_NS // 10**9:
        raise InputError(f"{where}: expected a time in seconds, got {words[0]}.")
    return int((seconds * 10**9).to_integral_value()), pose
