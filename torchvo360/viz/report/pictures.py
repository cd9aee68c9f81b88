"""The frames' images that a page shows: few enough for a file, and spread evenly over a run of unknown length.

Every n-th frame is kept. Whenever there are too many of them, every other one is dropped and n doubles, so that memory
and time are bounded: of N frames, about `most` log2(N / most) are encoded in all. A second thread encodes them.
"""

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from torchvo360.data.frame import Frame

WIDTH = 768
"""Of a picture, pixels; smaller frames keep their size. On the sphere it is two pixels a degree."""

QUALITY = 82
"""Of JPEG: about 1.3 bits a pixel for a room, without visible blocks."""

MOST = 160


@dataclass(frozen=True)
class Picture:
    """One frame as a small JPEG."""

    index: int
    """Of the frame, in its source."""
    jpeg: bytes


def picture_size(width: int, height: int) -> tuple[int, int]:
    """Return width and height of the picture of a frame."""
    return (width, height) if width <= WIDTH else (WIDTH, max(1, round(height * WIDTH / width)))


def encoded(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """Return an image, red first, as a small JPEG."""
    height, width = image.shape[:2]
    size = picture_size(width, height)
    if size != (width, height):
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


MOST_WAITING = 8
"""Frames that wait to be encoded; more are waited for."""


class Pictures:
    """Collects pictures while frames go by."""

    def __init__(self, most_bytes: int, *, most: int = MOST, length: int | None = None) -> None:
        """Begin without any.

        Args:
            most_bytes: What all pictures together may take; a single one is kept in any case.
            most: The greatest number of them.
            length: Expected number of frames, so that none is encoded only to be dropped.
        """
        self._most_bytes, self._most = most_bytes, most
        self._stride = 1 if length is None else max(1, -(-length // most))
        self._seen = 0
        self._kept: list[Picture] = []
        self._bytes = 0
        self._worker = ThreadPoolExecutor(1, "torchvo360-pictures")
        self._jobs: deque[Future[None]] = deque()

    def add(self, frame: Frame) -> None:
        """Keep the picture of a frame if it is its turn; a frame that cannot be used has none."""
        self._finish(wait=len(self._jobs) > MOST_WAITING)
        self._jobs.append(self._worker.submit(self._add, frame))

    def _finish(self, *, wait: bool) -> None:
        """Raise what befell earlier frames' pictures; of all of them, if it waits."""
        while self._jobs and (wait or self._jobs[0].done()):
            self._jobs.popleft().result()

    def _add(self, frame: Frame) -> None:
        turn = self._seen % self._stride == 0
        self._seen += 1
        if not turn or frame.image is None or frame.problem:
            return
        jpeg = encoded(frame.image)
        self._kept.append(Picture(frame.index, jpeg))
        self._bytes += len(jpeg)
        while len(self._kept) > 1 and (len(self._kept) > self._most or self._bytes > self._most_bytes):
            self._kept = self._kept[::2]
            self._stride *= 2
            self._bytes = sum(len(picture.jpeg) for picture in self._kept)

    @property
    def kept(self) -> list[Picture]:
        """The pictures so far, in the order of their frames."""
        self._finish(wait=True)
        return list(self._kept)
