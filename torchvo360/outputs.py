"""What a run leaves: a folder with trajectory, frames, map, report, figures and settings, and a few closing lines."""

import csv
import importlib.metadata
import importlib.util
import itertools
import json
import math
import platform
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from torchvo360.cameras import Camera
from torchvo360.checks import InputError
from torchvo360.data import Trajectory
from torchvo360.evaluation import Evaluation, evaluate
from torchvo360.export import write_ply, write_tum
from torchvo360.files import atomic_path
from torchvo360.settings import RunConfig
from torchvo360.viz import plot_errors, plot_trajectory
from torchvo360.viz.report import Content, Picture, write_report
from torchvo360.vo import FrameEstimate, OdometryResult

BEFORE_LOOPS = "trajectory_before_loops.txt"
RECORDING = "run.rrd"
FILES = (
    RECORDING,
    "trajectory.txt",
    BEFORE_LOOPS,
    "frames.csv",
    "map.ply",
    "trajectory.png",
    "errors.png",
    "report.html",
    "config.yaml",
    "summary.json",
)
"""In the order in which they are written: where there is a summary, the run is complete."""

COLUMNS = ("index", "time", "state", "reason", "residual", "inliers", "a", "b", "milliseconds")

ERRORS = ("ate_rmse_m", "ate_percent", "rpe_translation_percent", "rpe_rotation_deg", "rotation_median_deg", "scale")
"""Figures against the truth, as `Evaluation` names them."""


@dataclass(frozen=True)
class Record:
    """All that is known of a run when its last frame is done."""

    config: RunConfig
    config_yaml: str
    name: str
    camera: Camera
    result: OdometryResult
    problems: Counter[str]
    """Of the frames that could not be used."""
    seconds: float
    """From the first frame to the last, reading included."""
    truth: Trajectory | None
    evaluation: Evaluation | None
    notes: list[str]
    pictures: Sequence[Picture] = ()
    """Of frames, for the report."""


def can_plot() -> bool:
    """Return whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


@contextmanager
def new_folder(out: str | None, parent: Path) -> Iterator[Path]:
    """Make a folder for results, and take it away again if nothing has been put into it.

    Args:
        out: Where the user wants it; it may exist.
        parent: Otherwise the folder is made in here, named by date and time, with a number behind it where another one
            has the same second.

    Raises:
        InputError: It cannot be written.
    """
    wanted = parent if out is None else Path(out).expanduser()
    made = [path for path in (wanted, *wanted.parents) if not path.exists()]
    try:
        try:
            wanted.mkdir(parents=True, exist_ok=True)
            folder = wanted
            if out is None:
                folder = _dated_folder(parent)
                made.insert(0, folder)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            raise InputError(f"out: expected a folder that can be written, got {wanted}: {error.strerror}.") from None
        yield folder
    finally:
        for path in made:
            with suppress(OSError):  # not empty: results, or another run's
                path.rmdir()


def _dated_folder(parent: Path) -> Path:
    name = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for number in itertools.count(1):
        folder = parent / (name if number == 1 else f"{name}_{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise AssertionError  # the count does not end


@contextmanager
def output_folder(out: str | None, name: str, *, overwrite: bool) -> Iterator[Path]:
    """Make the folder of a run of the input of this name, by default runs/<name>/<date_time>.

    Raises:
        InputError: It cannot be written, or holds another run that is not to be overwritten.
    """
    with new_folder(out, Path("runs", name)) as folder:
        if not overwrite and any((folder / file).exists() for file in FILES):
            raise InputError(f"out: expected a folder without a run, or overwrite=true, got {folder}, which holds one.")
        yield folder


def write_all(folder: Path, record: Record) -> dict[str, Any]:
    """Write all files of a run and return its summary.

    Raises:
        InputError: One cannot be written.
    """
    result, config = record.result, record.config
    draw = config.plot != "false" and can_plot()
    summary = summarise(record)
    try:
        write_tum(folder / "trajectory.txt", result.trajectory)
        write_tum(folder / BEFORE_LOOPS, result.before_loops)
        _write_frames(folder / "frames.csv", result.frames)
        write_ply(folder / "map.ply", result.points.xyz, result.points.rgb, result.points.frame)
        left_out = {"trajectory.png", "errors.png", "report.html"}  # an overwritten run's
        if config.viz == "none":
            left_out.add(RECORDING)
        if draw:
            left_out -= _draw(folder, record)
        if config.report:
            _write_report(folder / "report.html", record, summary)
            left_out.remove("report.html")
        for name in left_out:
            (folder / name).unlink(missing_ok=True)
        _write_text(folder / "config.yaml", record.config_yaml)
        _write_text(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
    except OSError as error:
        raise InputError(f"out: expected a folder that can be written, got {folder}: {error.strerror}.") from None
    return summary


def _draw(folder: Path, record: Record) -> set[str]:
    """Draw the pictures and return their names."""
    trajectory = record.result.trajectory
    states = [str(frame.state) for frame in record.result.frames]
    truth = record.truth if record.evaluation else None
    points = record.result.points
    with atomic_path(folder / "trajectory.png") as temporary:
        plot_trajectory(temporary, trajectory, truth=truth, points=points, states=states, title=record.name)
    if truth is None:
        return {"trajectory.png"}
    with atomic_path(folder / "errors.png") as temporary:
        plot_errors(temporary, trajectory, truth, states=states, title=record.name)
    return {"trajectory.png", "errors.png"}


def _write_report(path: Path, record: Record, summary: dict[str, Any]) -> None:
    content = Content(
        name=record.name,
        camera=record.camera,
        result=record.result,
        summary=summary,
        truth=record.truth if record.evaluation else None,
        metric=record.result.metric,
        pictures=record.pictures,
        defaults=asdict(RunConfig()),
    )
    write_report(path, content, most_bytes=round(1e6 * record.config.report_mb))


def summarise(record: Record) -> dict[str, Any]:
    """Return the figures of a run and what it takes to repeat it, for JSON: None for a number that is not finite."""
    frames, evaluation = record.result.frames, record.evaluation
    computing_s = sum(frame.milliseconds for frame in frames) / 1e3
    notes = list(record.notes)
    if not record.result.keyframes:
        notes.append(f"no map could be started ({frames[-1].reason}): the poses are rotations, without positions.")
    if record.config.plot == "auto" and not can_plot():
        notes.append("trajectory.png is left out: it needs matplotlib, which pip install 'torchvo360[viz]' brings.")
    figures: dict[str, Any] = {
        "name": record.name,
        "input": record.config.input,
        "width": record.camera.width,
        "height": record.camera.height,
        "frames": len(frames),
        "unusable_frames": dict(record.problems),
        "states": dict(Counter(str(frame.state) for frame in frames)),
        "coverage": len(record.result.trajectory) / len(frames) if evaluation is None else evaluation.coverage,
        "keyframes": record.result.keyframes,
        "maps": record.result.maps,
        "metric": record.result.metric,
        "loops": [[edge.i, edge.j] for edge in record.result.loops],
        "points": len(record.result.points.xyz),
        "seconds": record.seconds,
        "fps": len(frames) / record.seconds,
        "odometry_fps": len(frames) / computing_s,
    }
    figures["camera"] = {"model": type(record.camera).__name__.lower(), "intrinsics": list(record.camera.intrinsics)}
    if record.result.gravity is not None:
        figures |= {"gravity": list(record.result.gravity), "imu_offset_s": record.result.imu_offset_s}
    if record.result.intrinsics is not None:
        figures["intrinsics"] = list(record.result.intrinsics)
    if evaluation is not None:
        figures |= {name: getattr(evaluation, name) for name in (*ERRORS, "path_length_m", "pairs")}
        if record.result.metric and record.truth is not None:
            in_metres = evaluate(record.result.trajectory, record.truth, align="se3")
            figures["ate_se3_rmse_m"] = in_metres.ate_rmse_m
    figures |= {"notes": notes, "threads": torch.get_num_threads(), "versions": _versions()}
    return _finite(figures | {"settings": asdict(record.config)})


def describe(summary: dict[str, Any], folder: Path) -> list[str]:
    """Return what the user reads at the end, from the summary."""
    states = ", ".join(f"{count} {state}" for state, count in summary["states"].items())
    unusable = ", ".join(f"{count} {problem}" for problem, count in summary["unusable_frames"].items())
    size, speed = f"{summary['width']} x {summary['height']}", f"{summary['fps']:.1f} a second"
    maps, loops = summary["maps"], len(summary["loops"])
    parts = f" of {maps} maps" * (maps > 1) + f"; {loops} {'loop' if loops == 1 else 'loops'} closed" * (loops > 0)
    lines = [
        f"{summary['name']}: {summary['frames']} frames of {size} in {summary['seconds']:.1f} s, {speed}",
        f"states: {states}" + (f"; unusable frames: {unusable}" if unusable else ""),
        f"map: {summary['points']} points from {summary['keyframes']} keyframes{parts}",
    ]
    if "intrinsics" in summary:
        lines.append("intrinsics fx, fy, cx, cy: " + ", ".join(f"{value:.6g}" for value in summary["intrinsics"]))
    if "gravity" in summary:
        axes = ", ".join(f"{value:.3f}" for value in summary["gravity"])
        lines.append(f"gravity: {axes} m/s^2 in the world's axes; IMU times + {1e3 * summary['imu_offset_s']:.1f} ms")
    if figures := [*(name for name in (*ERRORS, "ate_se3_rmse_m") if name in summary)]:
        figures += ["coverage", "fps"]
        width = max(map(len, figures))
        lines += [f"{name:<{width}}  {_figure(summary[name])}" for name in figures]
    report = [f"report: {folder / 'report.html'}"] * summary["settings"]["report"]
    return [*lines, *(f"note: {note}" for note in summary["notes"]), *report, f"results: {folder}"]


def _figure(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.4g}"


def _versions() -> dict[str, str]:
    try:
        own = importlib.metadata.version("torchvo360")
    except importlib.metadata.PackageNotFoundError:  # run from a checkout that is not installed
        own = "not installed"
    return {
        "torchvo360": own,
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "opencv": cv2.__version__,
        "numpy": np.__version__,
    }


def _finite(value: Any) -> Any:
    """Return the value with None for every number that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _write_frames(path: Path, frames: list[FrameEstimate]) -> None:
    """Write a line a frame: seconds as in trajectory.txt, and nothing where there is no number."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for frame in frames:
            numbers = (frame.residual, frame.inliers, frame.a, frame.b, frame.milliseconds)
            words = (f"{number:.6g}" if math.isfinite(number) else "" for number in numbers)
            writer.writerow([frame.index, f"{Decimal(frame.t_ns).scaleb(-9):.9f}", frame.state, frame.reason, *words])
