"""Many cameras at once: a batch of odometries in one process, each of which gives what it would give alone."""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

from torchvo360.checks import InputError
from torchvo360.data.frame import Frame
from torchvo360.vo.modes import in_present_modes
from torchvo360.vo.state import FrameEstimate
from torchvo360.vo.system import OdometryResult, VisualOdometry

T = TypeVar("T")
R = TypeVar("R")


class OdometryBatch:
    """Odometries that advance together, in as many threads as there are cores, beside which each looks for loops.

    The compiled passes and torch's operations leave Python's lock to the others, so that the throughput grows with the
    batch until the cores are full. No odometry reads what another one writes: the results are those of single runs, bit
    for bit. `torch.set_num_threads(1)` keeps the threads of single operations out of each other's way.
    """

    def __init__(self, odometries: Sequence[VisualOdometry], *, workers: int | None = None) -> None:
        """Take odometries, which may differ in camera and settings.

        Args:
            odometries: One for each sequence.
            workers: Threads; by default one for each core, and no more than odometries.

        Raises:
            InputError: There are no odometries, or fewer than one worker; or an odometry is there twice.
        """
        if not odometries or len(set(map(id, odometries))) < len(odometries):
            raise InputError(f"odometries: expected some that differ, got {len(odometries)}.")
        workers = min(os.cpu_count() or 1, len(odometries)) if workers is None else workers
        if workers < 1:
            raise InputError(f"workers: expected at least 1, got {workers}.")
        self.odometries = tuple(odometries)
        self._pool = ThreadPoolExecutor(workers, "odometry")

    def __len__(self) -> int:
        return len(self.odometries)

    def step(self, frames: Sequence[Frame | None]) -> list[FrameEstimate | None]:
        """Estimate the poses of each camera's next frame.

        Args:
            frames: One for each odometry; None where a sequence has none, and nothing is estimated.

        Raises:
            InputError: Their number is another one, or an odometry refuses its frame; the others have taken theirs.
        """
        if len(frames) != len(self):
            raise InputError(f"frames: expected {len(self)}, got {len(frames)}.")

        def advance(odometry: VisualOdometry, frame: Frame | None) -> FrameEstimate | None:
            return None if frame is None else odometry.step(frame)

        return self._each(advance, frames)

    def run(self, sequences: Sequence[Iterable[Frame]]) -> list[OdometryResult]:
        """Estimate whole sequences, each at its own pace, and return what their odometries leave.

        Args:
            sequences: One for each odometry.

        Raises:
            InputError: Their number is another one, or an odometry refuses a frame.
        """
        if len(sequences) != len(self):
            raise InputError(f"sequences: expected {len(self)}, got {len(sequences)}.")

        def travel(odometry: VisualOdometry, sequence: Iterable[Frame]) -> OdometryResult:
            for frame in sequence:
                odometry.step(frame)
            return odometry.finish()

        return self._each(travel, sequences)

    def finish(self) -> list[OdometryResult]:
        """Return all poses and points found so far; more steps may follow."""
        return self._each(lambda odometry, _: odometry.finish(), self.odometries)

    def _each(self, work: Callable[[VisualOdometry, T], R], inputs: Sequence[T]) -> list[R]:
        """Do the same for every odometry; an error is raised once all are done."""
        work = in_present_modes(work)
        pairs = zip(self.odometries, inputs, strict=True)
        tasks = [self._pool.submit(work, odometry, given) for odometry, given in pairs]
        wait(tasks)
        return [task.result() for task in tasks]
