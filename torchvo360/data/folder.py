"""Images as single files: a folder of them, or those that a glob pattern matches."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from torchvo360.data.frame import Frame

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".npy")

READABLE_WITHIN = 30
"""A source opens when one of its first frames, this many, is readable: a bad start is no reason to refuse it."""


def is_image_file(path: Path) -> bool:
    """Return whether the name is that of an image file that can be read here."""
    return path.suffix.lower() in IMAGE_SUFFIXES


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that puts `frame2` before `frame10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", path.name)]


def read_image(path: Path) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]:
    """Read one image file.

    Args:
        path: An image, or a `.npy` array [H, W] or [H, W, 3], uint8 or floating with values in [0, 1].

    Returns:
        image: Its colours as red, green, blue; None where there is a problem.
        problem: "unreadable" or "nan" (not every value of a floating array is finite); empty for an image.
    """
    try:
        if path.suffix.lower() == ".npy":
            return _image_from_array(np.load(path, allow_pickle=False))
        pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    except (OSError, EOFError, ValueError, cv2.error):  # missing or not permitted, cut off, not an array, empty
        return None, "unreadable"
    return (None, "unreadable") if pixels is None else (cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), "")


def _image_from_array(array: np.ndarray) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]:
    colour = array.ndim == 3 and array.shape[2] == 3
    if not (array.ndim == 2 or colour) or array.size == 0:
        return None, "unreadable"
    if np.issubdtype(array.dtype, np.floating):
        if not np.isfinite(array).all():
            return None, "nan"
        array = np.rint(np.clip(array, 0, 1) * 255).astype(np.uint8)
    if array.dtype != np.uint8:
        return None, "unreadable"
    return np.ascontiguousarray(array if colour else np.repeat(array[..., None], 3, -1)), ""


@dataclass(frozen=True)
class ImageFiles:
    """A list of image files, shown at a constant frame rate."""

    name: str
    paths: list[Path]
    fps: float
    notes: list[str] = field(default_factory=list)

    @property
    def length(self) -> int:
        """The number of files."""
        return len(self.paths)

    def size(self, selected: range) -> tuple[int, int] | None:
        """Return width and height of the first readable image among the first selected; None when there is none."""
        for index in selected[:READABLE_WITHIN]:
            image, _ = read_image(self.paths[index])
            if image is not None:
                return image.shape[1], image.shape[0]
        return None

    def read(self, start: int, stop: int | None, every: int) -> Iterator[Frame]:
        """Yield the frames `start:stop:every`, in the images' own sizes."""
        for index in range(self.length)[start:stop:every]:
            image, problem = read_image(self.paths[index])
            yield Frame(index, round(index * 1e9 / self.fps), image, problem)
