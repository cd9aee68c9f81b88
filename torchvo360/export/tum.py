"""Trajectories in the TUM format."""

from pathlib import Path

from torchvo360.data.trajectory import Trajectory
from torchvo360.files import atomic_path
from torchvo360.lie import quaternion_from_matrix


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write one line `timestamp tx ty tz qx qy qz qw` a pose T_world_cam: seconds to the nanosecond, metres.

    Raises:
        OSError: The file cannot be written.
    """
    quaternions = quaternion_from_matrix(trajectory.T_world_cam[:, :3, :3])
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for t_ns, t, q in zip(trajectory.t_ns.tolist(), trajectory.positions.tolist(), quaternions.tolist(), strict=True):
        lines.append(" ".join([_seconds(t_ns), *(f"{value:.9g}" for value in (*t, *q))]))
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _seconds(t_ns: int) -> str:
    """Return seconds with nine decimals, in integers: a float of a date in seconds is good to 200 ns only."""
    seconds, rest = divmod(abs(t_ns), 10**9)
    return f"{'-' if t_ns < 0 else ''}{seconds}.{rest:09d}"
