"""Reading ahead: a second thread decodes and resamples the next frames while the present one is worked on."""

import queue
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch

from torchvo360.data.frame import Frame

AHEAD = 4
"""Frames read ahead: a keyframe takes as long as several frames, and a frame weighs megabytes."""


@contextmanager
def prefetched(frames: Iterable[Frame], ahead: int = AHEAD) -> Iterator[Iterator[Frame]]:
    """Read frames in a thread of their own while this is entered.

    What comes out is what would have come out without it, in the same order: the frames, then the reader's exception or
    the end. Leaving early ends the reading after the frame at hand. The thread computes as the caller's does, with as
    many threads of its own.

    Args:
        frames: Iterated once, in the thread alone.
        ahead: Most frames that wait.
    """
    reader = _Reader(frames, ahead)
    try:
        reader.start()
        yield iter(reader)
    finally:
        reader.stop()


class _Reader(threading.Thread):
    """Puts frames, and how they ended, into a queue."""

    def __init__(self, frames: Iterable[Frame], ahead: int) -> None:
        super().__init__(name="torchvo360-reader", daemon=True)
        self._frames: Iterable[Frame] | None = frames
        self._waiting: queue.Queue[Frame | BaseException | None] = queue.Queue(ahead)
        self._stopped = threading.Event()
        self._threads, self._inference = torch.get_num_threads(), torch.is_inference_mode_enabled()

    def run(self) -> None:
        end = None
        try:
            torch.set_num_threads(self._threads)  # OpenMP counts them for each thread by itself
            with torch.inference_mode(self._inference):
                self._read()
        except BaseException as error:  # the caller's thread raises it in its turn
            end = error
        self._frames = None
        self._put(end)

    def _read(self) -> None:
        assert self._frames is not None
        for frame in self._frames:
            if not self._put(frame):
                return

    def _put(self, item: Frame | BaseException | None) -> bool:
        """Hand an item over as soon as there is room; False where nobody waits for it any more."""
        while not self._stopped.is_set():
            try:
                self._waiting.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False

    def __iter__(self) -> Iterator[Frame]:
        while (item := self._waiting.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item

    def stop(self) -> None:
        """End the reading and wait until it has ended."""
        self._stopped.set()
        if self.is_alive():  # unless Ctrl-C came before it had begun
            self.join()
