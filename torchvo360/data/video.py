"""Frames of a video file, with the container's time stamps.

Frames are always decoded from the beginning, because seeking is not exact in every container: one that `start` or
`every` leaves out is decoded and not converted. A frame that cannot be decoded is reported when a later one can; where
no frame follows within a second's worth of attempts the video has ended, whatever its header promised.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2

from torchvo360.checks import InputError
from torchvo360.data.folder import READABLE_WITHIN
from torchvo360.data.frame import Frame

FALLBACK_FPS = 30.0
"""Frame rate of a video whose header holds none, and of image files."""

FPS_LIMIT = 1000.0
"""A header with a higher frame rate than this holds a placeholder (90000 and the like), not a rate."""


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise InputError(f"input: expected a video or a folder of images, got {path}, which cannot be read as one.")
        yield capture
    finally:
        capture.release()


@dataclass(frozen=True)
class VideoFile:
    """A video file that has at least one readable frame."""

    name: str
    path: Path
    length: int | None
    """The number of frames that the header promises; None where it holds none."""
    fps: float
    timed: bool
    """Whether the container's time stamps are used, not `index / fps`."""
    image_size: tuple[int, int]
    """Width and height of the first readable frame."""
    notes: list[str] = field(default_factory=list)

    @classmethod
    def open(cls, path: Path, fps: float | None) -> "VideoFile":
        """Open a video.

        Args:
            path: The file.
            fps: Frame rate that replaces the container's times; None to keep those.

        Raises:
            InputError: It cannot be opened, or none of its first frames can be decoded.
        """
        with _opened(path) as capture:
            promised = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            header_fps = capture.get(cv2.CAP_PROP_FPS)
        length = int(promised) if math.isfinite(promised) and promised >= 1 else None
        notes: list[str] = []
        if fps is None and not 0 < header_fps <= FPS_LIMIT:
            notes.append(f"{path.name}: its header holds no frame rate; {FALLBACK_FPS:g} is assumed (fps= sets it).")
            header_fps = FALLBACK_FPS
        video = cls(path.stem, path, length, header_fps if fps is None else fps, fps is None, (0, 0), notes)
        seen, size = video._probe()
        if size is None:
            raise InputError(f"input: expected a video with readable frames, got {path}, where none can be decoded.")
        return cls(video.name, path, seen if seen < 2 else length, video.fps, video.timed, size, notes)

    def _probe(self) -> tuple[int, tuple[int, int] | None]:
        """Return how many frames were seen until two were and one was readable, and its width and height."""
        seen, size = 0, None
        for frame in self._decode(0, READABLE_WITHIN, 1):
            seen += 1
            if size is None and frame.image is not None:
                size = frame.image.shape[1], frame.image.shape[0]
            if seen >= 2 and size is not None:
                break
        return seen, size

    def size(self, selected: range | None) -> tuple[int, int] | None:
        """Return width and height; a video has one size, so the selection does not matter."""
        return self.image_size

    def read(self, start: int, stop: int | None, every: int) -> Iterator[Frame]:
        """Yield the frames `start:stop:every` in the video's own size; note it when the video ends too early."""
        count = yield from self._decode(start, stop, every)
        promised = self.length if stop is None or self.length is None else min(self.length, stop)
        if promised is not None and count < promised:
            note = f"{self.path.name}: expected {self.length} frames, could read {count}."
            if note not in self.notes:  # a sequence can be iterated again
                self.notes.append(note)

    def _decode(self, start: int, stop: int | None, every: int) -> Iterator[Frame]:
        """Yield the selected frames and return how many were passed, selected or not, readable or not."""
        period_ns = round(1e9 / self.fps)
        patience = math.ceil(self.fps)
        index, t_ns = 0, -period_ns
        failed: list[int] = []  # times of frames that could not be decoded, held until a later one can
        with _opened(self.path) as capture:
            while stop is None or index < stop:
                if not capture.grab():
                    failed.append(t_ns := self._time(index + len(failed), t_ns, math.nan))
                    if len(failed) > patience or (self.length is not None and index + len(failed) > self.length):
                        return index
                    continue
                for failed_t_ns in failed:
                    if self._selected(index, start, stop, every):
                        yield Frame(index, failed_t_ns, None, "unreadable")
                    index += 1
                failed.clear()
                t_ns = self._time(index, t_ns, capture.get(cv2.CAP_PROP_POS_MSEC))
                if self._selected(index, start, stop, every):
                    ok, pixels = capture.retrieve()
                    image = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB) if ok else None
                    yield Frame(index, t_ns, image, "" if ok else "unreadable")
                index += 1
        return index

    @staticmethod
    def _selected(index: int, start: int, stop: int | None, every: int) -> bool:
        return index >= start and (index - start) % every == 0 and (stop is None or index < stop)

    def _time(self, index: int, previous_ns: int, container_ms: float) -> int:
        """Return a time later than the previous one: the container's where it has such a one, else a period later."""
        if not self.timed:
            return round(index * 1e9 / self.fps)
        container_ns = round(container_ms * 1e6) if math.isfinite(container_ms) else previous_ns
        return container_ns if container_ns > previous_ns else previous_ns + round(1e9 / self.fps)
