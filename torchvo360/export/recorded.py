"""What a run left in its folder, read for an export: poses with their states, and the map."""

import csv
import json
import math
from collections import Counter
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import torch
from jaxtyping import Float, Float64, Int32, Int64, UInt8
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.checks import InputError
from torchvo360.data.trajectory import Trajectory
from torchvo360.data.tum import read_tum
from torchvo360.export.ply import read_ply
from torchvo360.vo import State

KEYFRAMES = "keyframes"

NOT_TRUSTED = ("weak", "lost")
"""States whose poses are predictions."""

INITIALISING = "initialising"
"""The state before there was a map. Poses of that time were filled in from the map; only keyframes' are exact."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """The result of a run."""

    trajectory: Trajectory
    index: Int64[Tensor, "M"]
    """Of every frame in its source, those without a pose included."""
    t_ns: Int64[Tensor, "M"]
    state: list[str]
    xyz: Float[Tensor, "N 3"]
    """The map's points in the world, in the run's unit."""
    rgb: UInt8[Tensor, "N 3"]
    host: Int32[Tensor, "N"]
    """Index of the keyframe that each point belongs to."""
    width: int
    height: int
    intrinsics: tuple[float, float, float, float] | None = None
    """What the run found, where it was to find them."""
    gravity: tuple[float, float, float] | None = None
    """Points down in the world's axes, where an IMU told it."""

    def pose_of(self) -> dict[int, Float64[Tensor, "4 4"]]:
        """Return T_world_cam by frame index, of the frames that have a pose."""
        poses = dict(zip(self.trajectory.t_ns.tolist(), self.trajectory.T_world_cam, strict=True))
        frames = zip(self.index.tolist(), self.t_ns.tolist(), strict=True)
        return {index: poses[t_ns] for index, t_ns in frames if t_ns in poses}

    def camera_of(self, camera: Camera) -> Camera:
        """Return the camera of the run's input with the intrinsics that the run found, if any.

        Raises:
            InputError: The images are of another size than the run's.
        """
        if (camera.width, camera.height) != (self.width, self.height):
            got = f"{camera.width} x {camera.height}: it is another one by now"
            raise InputError(f"input: expected frames of {self.width} x {self.height} as in the run, got {got}.")
        return camera if self.intrinsics is None else camera.recalibrated(*self.intrinsics)

    def chosen(self, frames: str | int) -> tuple[list[int], list[str]]:
        """Return the indices of the frames to export, and sentences on those that are left out.

        Args:
            frames: "keyframes", the frames that the map's points belong to; or every so many of all frames.

        Raises:
            InputError: There is none.
        """
        keyframes = set(self.host.tolist())
        rows = list(zip(self.index.tolist(), self.state, strict=True))
        wanted = [row for row in rows if row[0] in keyframes] if isinstance(frames, str) else rows[::frames]
        if not wanted:
            raise InputError(
                "frames: expected a run with a map for keyframes, got one without; frames=10 takes others."
            )
        posed, notes, kept = self.pose_of(), [], []
        left: Counter[str] = Counter()
        for index, state in wanted:
            unsure = state in NOT_TRUSTED or (state == INITIALISING and index not in keyframes)
            reason = "without a pose" if index not in posed else state if unsure else ""
            if reason:
                left[reason] += 1
            else:
                kept.append(index)
        reasons = ", ".join(f"{count} {reason}" for reason, count in left.items())
        if left:
            notes.append(f"{sum(left.values())} of {len(wanted)} frames are left out: {reasons}.")
        if not kept:
            raise InputError(f"frames: expected some with a sure pose, got none: {reasons}.")
        return kept, notes


def read_recorded(folder: str | Path) -> Recorded:
    """Read the folder of a finished run.

    Raises:
        InputError: It is not one, or a file in it is damaged.
    """
    root = Path(folder).expanduser()
    try:
        summary = json.loads((root / "summary.json").read_text(encoding="utf-8"))
        width, height = int(summary["width"]), int(summary["height"])
        intrinsics, gravity = _numbers(summary.get("intrinsics"), 4), _numbers(summary.get("gravity"), 3)
    except OSError as error:
        got = f"{folder}, without summary.json ({error.strerror})"
        raise InputError(f"run: expected the folder of a finished run, got {got}.") from None
    except (ValueError, KeyError, TypeError, OverflowError):
        raise InputError(f"run: expected a summary.json that torchvo360 wrote, got another one in {folder}.") from None
    try:
        trajectory = read_tum(root / "trajectory.txt")
        xyz, rgb, host = read_ply(root / "map.ply")
    except InputError as error:
        raise InputError(f"run: {error}") from None
    index, t_ns, state = _read_frames(root / "frames.csv")
    if strange := int((~torch.isin(trajectory.t_ns, t_ns)).sum()):
        got = f"{strange} poses in trajectory.txt at times of no frame in frames.csv"
        raise InputError(f"run: expected files of one run in {folder}, got {got}.")
    return Recorded(
        trajectory,
        index,
        t_ns,
        state,
        xyz,
        rgb,
        host,
        width,
        height,
        None if intrinsics is None else (intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]),
        None if gravity is None else (gravity[0], gravity[1], gravity[2]),
    )


def _numbers(values: list[float] | None, count: int) -> list[float] | None:
    if values is None:
        return None
    numbers = [float(value) for value in values]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError
    return numbers


def _read_frames(path: Path) -> tuple[Int64[Tensor, "M"], Int64[Tensor, "M"], list[str]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        index = torch.tensor([int(row["index"]) for row in rows], dtype=torch.int64)
        times = (Decimal(row["time"]) * 10**9 for row in rows)
        t_ns = torch.tensor([int(time.to_integral_value()) for time in times], dtype=torch.int64)
        state = [State(row["state"]).value for row in rows]
    except OSError as error:
        raise InputError(f"run: expected {path}, got {error.strerror}.") from None
    except (ValueError, KeyError, TypeError, OverflowError, InvalidOperation, csv.Error):
        raise InputError(f"run: expected frames as torchvo360 writes them, got others in {path}.") from None
    if not rows:
        raise InputError(f"run: expected frames in {path}, got none.")
    return index, t_ns, state
