"""Measure the odometry: errors of final and online poses, states, speed and memory, over worlds, seeds and bad days.

    python benchmarks/accuracy.py synthetic [--preset fast] [--seeds 0 1 2] [--override vo.map.points=800 ...]
    python benchmarks/accuracy.py house [--data ../shared/data/house]
    python benchmarks/accuracy.py walk [--data ../shared/data/theta_walk] [--reverse] [--frames 300]
    python benchmarks/accuracy.py bad_days [--data ../shared/data/theta_walk] [--only turn black]

`synthetic` walks through room, pillars and courtyard; a seed is that of the world and of the odometry. `house` and
`walk` are recorded sequences; a seed is the odometry's. `bad_days` spoils rendered walks and, where it is found, the
first 300 frames of the recorded one (their names begin with walk_). Each line of the table is one run:

    ATE mm, ATE %   final positions after the best Sim(3), root mean square, and in percent of the true path
    online mm       the same of the poses as `step` returned them, without frames that are INITIALISING
    rot deg         median after the best constant rotation of the world
    sure %          as ATE %, of the poses that are said to be right: TRACKING or RELOCALISED
    worst mm        largest error among these: a wrong pose that is not called wrong
    cover           share of the frames that have a finite pose
    states          initialising, tracking, weak, lost, relocalised
    maps, keys      maps and keyframes made
    fps, by CPU     frames a second of the odometry alone, and a second of CPU time, which other programs hardly change
    MB, grown       largest memory of the process during the run, and growth over its last two thirds

The truth of the walk is stella_vslam's trajectory in its own unit; "mm" are thousandths of it. There the two-view
reference is compared, too, and the reversed run with the forward one. Where a path ends at its beginning, a line says
how far the estimate's end is off its place as seen from its start, with and without the loops' correction.
"""

import argparse
import csv
import math
import os
import statistics
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read once, when OpenMP starts

import cv2
import torch
import yaml
from torch import Tensor

from bad_days import Recording, rendered, synthetic_days, walk_days
from torchvo360.checks import InputError
from torchvo360.cli.command import conf_folder
from torchvo360.cli.configuration import compose
from torchvo360.data.images import open_images
from torchvo360.data.masks import parse_mask
from torchvo360.data.trajectory import Trajectory
from torchvo360.data.tum import read_tum
from torchvo360.evaluation import Evaluation, evaluate
from torchvo360.vo import OdometryConfig, OdometryResult, State, VisualOdometry
from two_view import read_pairs, two_view_errors_deg

SHARED = Path(__file__).parents[1] / ".." / "shared" / "data"
WORLDS = ("room", "pillars", "courtyard")
SEEDS = {"synthetic": [0, 1, 2], "house": [0, 1, 2, 3, 4], "walk": [0], "bad_days": [0]}
FPS = 30
OPERATOR = "below:-18"
"""The mask of the walk: the man who carries the camera."""
CLOSED = ("loop", "turned_loop")
"""Days whose path ends where it began."""
WALK_FRAMES = 300
"""Frames of the walk that a bad day spoils."""


@dataclass(frozen=True)
class Row:
    """What one run came to."""

    name: str
    seed: int
    ate_mm: float
    ate_percent: float
    online_mm: float
    rotation_deg: float
    sure_percent: float
    worst_sure_mm: float
    coverage: float
    initialising: int
    tracking: int
    weak: int
    lost: int
    relocalised: int
    maps: int
    keyframes: int
    fps: float
    cpu_fps: float
    peak_mb: float
    grown_mb: float

    HEADER = (
        f"{'name':28} seed    ATE mm   ATE %  online mm  rot deg  sure %  worst mm  cover  "
        f"{'states':>19}  maps keys    fps by CPU    MB  grown"
    )

    def __str__(self) -> str:
        states = f"{self.initialising}/{self.tracking}/{self.weak}/{self.lost}/{self.relocalised}"
        return (
            f"{self.name:28} {self.seed:4d} {self.ate_mm:9.3f} {self.ate_percent:7.4f} {self.online_mm:10.3f} "
            f"{self.rotation_deg:8.4f} {self.sure_percent:7.4f} {self.worst_sure_mm:9.2f} {self.coverage:6.1%}  "
            f"{states:>19}  {self.maps:4d} {self.keyframes:4d} "
            f"{self.fps:6.1f} {self.cpu_fps:6.1f} {self.peak_mb:5.0f} {self.grown_mb:6.0f}"
        )


def measure(
    recording: Recording, config: OdometryConfig, *, mask: Tensor | None = None, seed: int = 0, name: str = ""
) -> tuple[Row, OdometryResult]:
    """Run the odometry over a recording, one frame in memory at a time."""
    _reset_peak()
    odometry = VisualOdometry(recording.camera, config, mask=mask, seed=seed)
    online: list[tuple[int, Tensor]] = []
    seconds, cpu_seconds, early_mb = 0.0, 0.0, math.nan
    with torch.inference_mode():
        for k, frame in enumerate(recording):
            began, cpu_began = time.perf_counter(), time.process_time()
            estimate = odometry.step(frame)
            seconds += time.perf_counter() - began
            cpu_seconds += time.process_time() - cpu_began
            if estimate.state != State.INITIALISING:
                online.append((estimate.t_ns, estimate.T_world_cam.clone()))
            if k == len(recording) // 3:
                early_mb = _memory_mb("VmRSS")
        late_mb = _memory_mb("VmRSS")
        result = odometry.finish()
    peak_mb = _memory_mb("VmHWM")
    states = Counter(estimate.state for estimate in result.frames)
    final = evaluate(result.trajectory, recording.truth)
    sure = [(e.t_ns, e.T_world_cam) for e in result.frames if e.state in (State.TRACKING, State.RELOCALISED)]
    as_given, trusted = errors_of(online, recording.truth), errors_of(sure, recording.truth)
    row = Row(
        name=name or recording.name,
        seed=seed,
        ate_mm=1e3 * final.ate_rmse_m,
        ate_percent=final.ate_percent,
        online_mm=math.nan if as_given is None else 1e3 * as_given.ate_rmse_m,
        rotation_deg=final.rotation_median_deg,
        sure_percent=math.nan if trusted is None else trusted.ate_percent,
        worst_sure_mm=math.nan if trusted is None else 1e3 * worst_m(sure, recording.truth, trusted.T_truth_estimate),
        coverage=finite_share(result, len(recording)),
        **{state.value: states[state] for state in State},
        maps=maps_of(result),
        keyframes=result.keyframes,
        fps=len(recording) / seconds,
        cpu_fps=len(recording) / cpu_seconds,
        peak_mb=peak_mb,
        grown_mb=late_mb - early_mb,
    )
    return row, result


def errors_of(poses: list[tuple[int, Tensor]], truth: Trajectory) -> Evaluation | None:
    """Return the errors of some poses with their times; None where fewer than three have a true one."""
    if not poses:
        return None
    try:
        return evaluate(
            Trajectory(torch.tensor([t_ns for t_ns, _ in poses]), torch.stack([T for _, T in poses])), truth
        )
    except InputError:
        return None


def worst_m(poses: list[tuple[int, Tensor]], truth: Trajectory, T_truth_estimate: Tensor) -> float:
    """Return the largest error of the positions of some poses with their times, metres after alignment."""
    true = dict(zip(truth.t_ns.tolist(), truth.positions, strict=True))
    known = [(T[:3, 3], true[t_ns]) for t_ns, T in poses if t_ns in true]
    at, expected = (torch.stack(positions) for positions in zip(*known, strict=True))
    aligned = at @ T_truth_estimate[:3, :3].mT + T_truth_estimate[:3, 3]
    return float((aligned - expected).norm(dim=-1).max())


def finite_share(result: OdometryResult, length: int) -> float:
    """Return the share of the frames given that have a finite pose."""
    return sum(bool(estimate.T_world_cam.isfinite().all()) for estimate in result.frames) / length


def maps_of(result: OdometryResult) -> int:
    """Return how many maps were begun."""
    begun = any(estimate.state != State.INITIALISING for estimate in result.frames)
    return int(begun) + sum(estimate.reason == "new_map" for estimate in result.frames)


def _memory_mb(name: str) -> float:
    """Return a figure of /proc/self/status in megabytes; NaN where there is none."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return math.nan
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(name + ":")), math.nan)


def _reset_peak() -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")
    except OSError:
        return  # not Linux, or not allowed: the peak is then that of all runs so far


# What is measured


def settings(preset: str, overrides: Sequence[str], *, clean: bool) -> OdometryConfig:
    """Compose the odometry's settings as the command `torchvo360` does.

    Args:
        preset: A file of conf/vo.
        overrides: As on the command line, `vo.key=value`.
        clean: Whether what conf/vo/clean.yaml says of images without compression goes before the overrides.
    """
    folder = conf_folder()
    path = folder / "vo" / "clean.yaml"
    usual = yaml.safe_load(path.read_text(encoding="utf-8")) if clean and path.is_file() else {}
    return compose([f"vo={preset}", *(f"vo.{key}={value}" for key, value in usual.items()), *overrides], folder).vo


def measure_synthetic(arguments: argparse.Namespace) -> Iterator[Row]:
    """Yield a row for each world and seed."""
    config = settings(arguments.preset, arguments.override, clean=True)
    width, height = arguments.size or (512, 256)
    for world in WORLDS:
        for seed in arguments.seeds:
            recording = rendered(world=world, seed=seed, frames=arguments.frames or 150, width=width, height=height)
            yield measure(recording, config, seed=seed)[0]


def measure_house(arguments: argparse.Namespace) -> Iterator[Row]:
    """Yield a row for each seed."""
    data = _folder(arguments.data or SHARED / "house", "poses.txt")
    config = settings(arguments.preset, arguments.override, clean=False)
    images = open_images(str(data / "images"), resize=arguments.size)
    truth = read_tum(data / "poses.txt")
    recording = Recording.of_images(images, arguments.frames or len(truth), dict(enumerate(truth.T_world_cam)))
    for seed in arguments.seeds:
        yield measure(recording, config, seed=seed, name="house")[0]


def open_walk(data: Path, frames: int | None, size: tuple[int, int] | None) -> tuple[Recording, Tensor]:
    """Return the recorded walk, with stella_vslam's poses for the truth, and the mask of its operator."""
    images = open_images(str(data / "richoh1_0_3.mp4"), camera_fit="stretch", resize=size)
    stella = read_tum(data / "stella_vslam.txt")
    numbers = (stella.t_ns.double() * (FPS / 1e9)).round().long().tolist()
    length = min(frames or math.inf, images.length or 1202)
    recording = Recording.of_images(images, int(length), dict(zip(numbers, stella.T_world_cam, strict=True)))
    return recording, parse_mask(OPERATOR, images.camera)


def measure_walk(arguments: argparse.Namespace) -> Iterator[Row]:
    """Yield a row for each seed, and with --reverse one of the reversed frames."""
    data = _folder(arguments.data or SHARED / "theta_walk", "stella_vslam.txt")
    config = settings(arguments.preset, arguments.override, clean=False)
    recording, mask = open_walk(data, arguments.frames, arguments.size)
    pairs = read_pairs(data / "reference_two_view.json")
    for seed in arguments.seeds:
        row, result = measure(recording, config, mask=mask, seed=seed, name="walk")
        yield row
        _print_two_view(result.trajectory, pairs)
        if arguments.reverse:
            reverse = recording.in_order(range(len(recording) - 1, -1, -1))
            row, reverse_result = measure(reverse, config, mask=mask, seed=seed, name="walk_reversed")
            yield row
            backward = reverse_result.trajectory
            again = Trajectory(result.trajectory.t_ns, backward.T_world_cam.flip(0))
            _print_two_view(again, pairs)
            # stella's unit for both: the forward run aligned with it, then the reversed one with that
            scale = evaluate(result.trajectory, recording.truth).scale
            apart_mm = 1e3 * scale * evaluate(again, result.trajectory).ate_rmse_m
            print(f"    reversed against forward: {apart_mm:.2f} mm ATE", flush=True)


def _print_end(result: OdometryResult, truth: Trajectory) -> None:
    after, before = (end_percent(path, truth) for path in (result.trajectory, result.before_loops))
    print(f"    {len(result.loops)} loops: the end is {after:.4f} % of the path off its place against the start, "
          f"{before:.4f} % before their correction", flush=True)  # fmt: skip


def end_percent(trajectory: Trajectory, truth: Trajectory) -> float:
    """Return the error of the last position as seen from the first, in percent of the true path."""
    figures = evaluate(trajectory, truth)
    moved, true = (path.positions[-1] - path.positions[0] for path in (trajectory, truth))
    return 100 * float((figures.T_truth_estimate[:3, :3] @ moved - true).norm()) / figures.path_length_m


def _print_two_view(trajectory: Trajectory, pairs: list[dict]) -> None:
    rotation, direction = two_view_errors_deg(trajectory, pairs)
    print(f"    {len(rotation)} two-view estimates: rotation {rotation.median():.3f} deg, "
          f"direction {direction.median():.2f} deg (medians)", flush=True)  # fmt: skip


def measure_bad_days(arguments: argparse.Namespace) -> Iterator[Row]:
    """Yield a row for each seed and each bad day, on rendered worlds and then on the recorded walk."""
    clean = settings(arguments.preset, arguments.override, clean=True)
    for seed in arguments.seeds:
        for name, day in synthetic_days(seed, arguments.frames or 150, arguments.size or (512, 256)):
            if not arguments.only or name in arguments.only:
                row, result = measure(day, clean, seed=seed, name=name)
                yield row
                if name in CLOSED:
                    _print_end(result, day.truth)
    data = arguments.data or SHARED / "theta_walk"
    if not (data / "stella_vslam.txt").is_file():
        print(f"--data: no recorded walk in {data}, so that only the rendered days are measured.", flush=True)
        return
    config = settings(arguments.preset, arguments.override, clean=False)
    walk, mask = open_walk(data, arguments.frames or WALK_FRAMES, arguments.size)
    for seed in arguments.seeds:
        for name, day in walk_days(walk, mask):
            if not arguments.only or f"walk_{name}" in arguments.only:
                yield measure(day, config, mask=mask, seed=seed, name=f"walk_{name}")[0]


def _folder(path: Path, holds: str) -> Path:
    if not (path / holds).is_file():
        raise SystemExit(f"--data: expected a folder with {holds}, got {path}.")
    return path


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    return int(width), int(height)


def summary(rows: Sequence[Row]) -> list[str]:
    """Return medians and ranges over all runs of a name, and over all rows."""
    names = list(dict.fromkeys(row.name for row in rows))
    groups = [(name, [row for row in rows if row.name == name]) for name in names]
    lines = []
    for name, group in [*groups, ("all", list(rows))]:
        if len(group) > 1:
            parts = []
            for title, unit, key in (
                ("ATE", "mm", "ate_mm"), ("", "%", "ate_percent"), ("online", "mm", "online_mm"),
                ("rotation", "deg", "rotation_deg"), ("", "fps", "fps"),
            ):  # fmt: skip
                values = [getattr(row, key) for row in group]
                middle = f"{statistics.median(values):.4g} ({min(values):.4g} to {max(values):.4g}) {unit}"
                parts.append(f"{title} {middle}".strip())
            lines.append(f"{name}, median of {len(group)}: " + ", ".join(parts))
    return lines


MEASURES = {
    "synthetic": measure_synthetic, "house": measure_house, "walk": measure_walk, "bad_days": measure_bad_days,
}  # fmt: skip


def main() -> None:
    """Print a line for each run, then medians and ranges."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=MEASURES)
    parser.add_argument("--preset", default="default", help="file of conf/vo")
    parser.add_argument("--override", nargs="*", default=[], help="settings, such as vo.lost_inliers=0.4")
    parser.add_argument("--seeds", type=int, nargs="+")
    parser.add_argument("--frames", type=int, help="frames of a sequence; all, or 150 rendered ones, by default")
    parser.add_argument("--size", type=_size, help="WIDTHxHEIGHT; 512x256 rendered, else the images' own by default")
    parser.add_argument("--data", type=Path, help="folder of the house or of the walk")
    parser.add_argument("--reverse", action="store_true", help="the walk's frames in reverse order, too")
    parser.add_argument("--only", nargs="*", default=[], help="names of bad days; all by default")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--csv", type=Path, help="file that the rows are written to")
    arguments = parser.parse_args()
    arguments.seeds = arguments.seeds or SEEDS[arguments.what]
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    print(f"{Row.HEADER}", flush=True)
    rows = []
    try:
        for row in MEASURES[arguments.what](arguments):
            rows.append(row)
            print(row, flush=True)
    except InputError as error:
        raise SystemExit(f"accuracy.py: {error}") from None
    print(*summary(rows), sep="\n")
    if arguments.csv:
        with arguments.csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [field.name for field in fields(Row)])
            writer.writeheader()
            writer.writerows(asdict(row) for row in rows)


if __name__ == "__main__":
    main()
