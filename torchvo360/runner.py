"""One run: open the input, step through its frames, compare with the truth, write everything down."""

import itertools
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType, TracebackType

import cv2
import torch
from jaxtyping import Int64
from torch import Tensor, nn
from tqdm import tqdm

from torchvo360.backends import backend, numba, use_numba
from torchvo360.checks import InputError
from torchvo360.data import Frame, Trajectory
from torchvo360.data.prefetch import prefetched
from torchvo360.data.tum import read_tum
from torchvo360.evaluation import evaluate
from torchvo360.learn.checkpoint import SHIPPED_DEPTH, load_checkpoint
from torchvo360.learn.plugin import DepthEstimator, build
from torchvo360.opening import Opened, open_input
from torchvo360.outputs import RECORDING, Record, can_plot, describe, output_folder, write_all
from torchvo360.settings import SHIPPED, DepthConfig, RunConfig
from torchvo360.viz.live import MAP_EVERY, LiveView, can_record, live_view
from torchvo360.viz.report.page import picture_budget
from torchvo360.viz.report.pictures import Pictures
from torchvo360.vo import LEARNED, VisualOdometry

COMPILING = "torchvo360: compiling, which takes a minute and happens once; backend=eager does without."
NOT_COUPLED = (
    "it told rotations at most, neither scale nor gravity: the camera moved too little or for less than about two "
    "seconds, or the samples' unit, their clock or T_cam_imu is not what was said."
)


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    lines: list[str]
    """What the user reads."""
    complaint: str = ""
    """One sentence on what went wrong, if something did."""
    exit_code: int = 0


class StopSignals:
    """While it is entered, the first Ctrl-C or SIGTERM is only noted, so that a run can end in good order.

    A second one acts as it did before. Outside the main thread, where Python delivers no signals, it does nothing.
    """

    def __init__(self) -> None:
        self.received: signal.Signals | None = None
        self._before: dict[signal.Signals, signal.Handlers] = {}

    def __enter__(self) -> "StopSignals":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)  # pyright: ignore[reportArgumentType]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = signal.Signals(number)
        self._restore()

    def _restore(self) -> None:
        while self._before:
            signal.signal(*self._before.popitem())


def run(config: RunConfig, *, config_yaml: str = "") -> Outcome:
    """Estimate the motion in one input and write the results into its output folder.

    A run that is stopped by Ctrl-C or SIGTERM ends after the frame at hand and keeps what was done.

    Args:
        config: Settings.
        config_yaml: The settings as they are to be written into config.yaml.

    Raises:
        InputError: The caller's mistake; then there is no output folder either.
    """
    if config.device == "cuda" and not torch.cuda.is_available():
        raise InputError("device: expected cpu, as PyTorch finds no CUDA device here, got cuda.")
    if config.plot == "true" and not can_plot():
        raise InputError("plot: expected matplotlib, which pip install 'torchvo360[viz]' brings, or plot=false.")
    if config.viz != "none" and not can_record():
        raise InputError("viz: expected rerun-sdk, which pip install 'torchvo360[live]' brings, or viz=none.")
    opened = open_input(config)
    sequence, notes = opened.sequence, opened.notes
    truth = sequence.truth if config.truth is None else _read_truth(config.truth)
    depth = open_depth(config.depth)
    with (
        backend(config.backend),
        output_folder(config.out, sequence.name, overwrite=config.overwrite) as folder,
        _threads(config.threads),
        torch.inference_mode(),
        StopSignals() as stop,
        live_view(config.viz, folder / RECORDING, sequence.name, sequence.camera) as live,
    ):
        if config.progress and sys.stderr.isatty() and use_numba() and not numba.is_compiled():
            print(COMPILING, file=sys.stderr)
        depth = None if depth is None else depth.to(config.device)
        odometry = VisualOdometry(
            sequence.camera,
            config.vo,
            mask=opened.mask,
            depth=depth,
            seed=config.seed,
            device=config.device,
            rig=sequence.rig,
            imu=opened.imu,
        )
        pictures = Pictures(picture_budget(round(1e6 * config.report_mb)), length=sequence.length)
        journey = _step_through(
            opened,
            odometry,
            truth,
            stop,
            progress=config.progress,
            pictures=pictures if config.report else None,
            live=live,
        )
        if journey.usable < 2 and stop.received:
            return Outcome([], "stopped before two frames were done: nothing is written.", 128 + stop.received)
        if journey.usable < 2:
            problems = ", ".join(f"{count} {problem}" for problem, count in journey.problems.items())
            got = f"{journey.usable} of {journey.frames}" + f" ({problems})" * bool(problems)
            raise InputError(f"input: expected at least two usable frames, got {got}.")
        notes += sequence.notes
        if stop.received:
            of = f" of {sequence.length}" if sequence.length else ""
            notes.append(f"stopped by {stop.received.name} after {journey.frames}{of} frames; they are kept.")
        result = odometry.finish()
        if live is not None:
            live.finish(result)
        if depth is not None and not any(estimate.reason == LEARNED for estimate in result.frames):
            notes.append("depth: the network was sure of too little of what it saw, so that the unit is not its metre.")
        if opened.imu is not None and result.gravity is None:
            notes.append(f"imu: {NOT_COUPLED}" + f" {result.imu_reason}" * bool(result.imu_reason))
        evaluation, complaint = None, ""
        if truth is not None:
            try:
                evaluation = evaluate(result.trajectory, truth)
            except InputError as error:
                complaint = f"{error} The results are kept, without figures."
        record = Record(
            config=config,
            config_yaml=config_yaml,
            name=sequence.name,
            camera=sequence.camera,
            result=result,
            problems=journey.problems,
            seconds=journey.seconds,
            truth=truth,
            evaluation=evaluation,
            notes=notes,
            pictures=pictures.kept,
        )
        lines = describe(write_all(folder, record), folder)
        return Outcome(lines, complaint, 128 + stop.received if stop.received else 2 if complaint else 0)


@dataclass(frozen=True)
class Journey:
    """What the loop saw."""

    frames: int
    problems: Counter[str]
    """Of the frames that could not be used."""
    seconds: float

    @property
    def usable(self) -> int:
        """The number of frames without a problem."""
        return self.frames - self.problems.total()


def _step_through(
    opened: Opened,
    odometry: VisualOdometry,
    truth: Trajectory | None,
    stop: StopSignals,
    *,
    progress: bool,
    pictures: Pictures | None,
    live: LiveView | None,
) -> Journey:
    """Give every frame to the odometry, until they end or the user does not want any more."""
    sequence = opened.sequence
    began = time.perf_counter()
    problems: Counter[str] = Counter()
    count = 0
    with prefetched(sequence) as frames:
        opening = list(itertools.islice(frames, 2))
        if truth is not None:
            _check_overlap("truth", "poses", truth.t_ns, opening, sequence.length)
        if opened.imu is not None:
            t_ns = opened.imu.samples.t_ns + round(1e9 * opened.imu.offset_s)
            _check_overlap("imu", "samples", t_ns, opening, sequence.length)
        disable = None if progress else True  # None: where standard error is no terminal
        with tqdm(total=sequence.length, desc=sequence.name, unit="frame", disable=disable, leave=False) as bar:
            for frame in itertools.chain(opening, frames):
                estimate = odometry.step(frame)
                count += 1
                problems.update([frame.problem] if frame.problem else [])
                if pictures is not None:
                    pictures.add(frame)
                if live is not None:
                    live.show(frame, estimate)
                    if count % MAP_EVERY == 0:
                        live.show_map(odometry.finish())
                bar.set_postfix_str(estimate.state, refresh=False)
                bar.update()
                if stop.received:
                    break
    return Journey(count, problems, time.perf_counter() - began)


def open_depth(config: DepthConfig) -> nn.Module | None:
    """Return the depth network that the settings name, in evaluation mode; None where they name none.

    Raises:
        InputError: It cannot be made, or its checkpoint is missing, damaged or another network's.
    """
    target, checkpoint = config._target_, config.checkpoint
    if target is not None and checkpoint in (None, SHIPPED):
        return build({"_target_": target, **(config.arguments or {})}, DepthEstimator).eval()
    if checkpoint is None:
        return None
    try:
        return load_checkpoint(SHIPPED_DEPTH if checkpoint == SHIPPED else checkpoint, target)
    except InputError as error:
        raise InputError(f"depth.{error}") from None


def _read_truth(path: str) -> Trajectory:
    try:
        return read_tum(path)
    except InputError as error:
        raise InputError(f"truth: {error}") from None


def _check_overlap(name: str, what: str, t_ns: Int64[Tensor, "N"], opening: list[Frame], length: int | None) -> None:
    """Refuse, before the work is done, what is of another time: a clock's, say, for a video that starts at 0."""
    if len(opening) < 2:
        return
    begin_ns, period_ns = opening[0].t_ns, opening[1].t_ns - opening[0].t_ns
    end_ns = begin_ns + period_ns * (length or 0)
    if t_ns[-1] < begin_ns - period_ns or (length and t_ns[0] > end_ns + period_ns):
        first, last = (float(time) / 1e9 for time in t_ns[[0, -1]])
        expected = f"{begin_ns / 1e9:g}" + (f" to {end_ns / 1e9:g} s" if length else " s and later")
        got = f"{first:.10g} to {last:.10g} s"
        raise InputError(f"{name}: expected {what} at the frames' times, {expected}, got {got}.")


@contextmanager
def _threads(count: int | None) -> Iterator[None]:
    """Compute with this many threads, and with as many as before afterwards."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    try:
        if count is not None:
            torch.set_num_threads(count)
            cv2.setNumThreads(count)
        yield
    finally:
        if count is not None:
            torch.set_num_threads(before[0])
            cv2.setNumThreads(before[1])
