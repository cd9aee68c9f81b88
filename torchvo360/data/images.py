"""Images from a video file, a folder or a glob pattern, brought to one camera and judged frame by frame.

What is wrong with the whole input is refused when it is opened, in one sentence. What is wrong with a single frame is
told by `Frame.problem`, and the sequence goes on.
"""

import glob
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from torch import Tensor

from torchvo360.cameras import Camera, Equirectangular
from torchvo360.checks import InputError, check_choice
from torchvo360.data.folder import IMAGE_SUFFIXES, ImageFiles, is_image_file, natural_key
from torchvo360.data.frame import Frame, ImageSequence
from torchvo360.data.selection import Selection
from torchvo360.data.video import FALLBACK_FPS, VideoFile

BLACK_MEAN, BLACK_MAX, WHITE_MEAN = 2, 16, 253
"""Of 255: a frame this dark everywhere, or this bright on average, holds no texture; a lens cap or a flash."""


class Source(Protocol):
    """Frames as they are stored, in sizes of their own."""

    @property
    def name(self) -> str: ...
    @property
    def length(self) -> int | None: ...
    @property
    def notes(self) -> list[str]: ...
    def size(self, selected: range) -> tuple[int, int] | None: ...
    def read(self, start: int, stop: int | None, every: int) -> Iterator[Frame]: ...


class View(Protocol):
    """How stored images become a camera's."""

    @property
    def source_size(self) -> tuple[int, int]:
        """Width and height of the images that come in."""
        ...

    @property
    def camera(self) -> Camera:
        """Whose images go out."""
        ...

    @property
    def mask(self) -> Bool[Tensor, "H W"] | None:
        """The pixels that show something; None for all."""
        ...

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "H W 3"]: ...


@dataclass(frozen=True)
class Fit:
    """How an image of one size becomes a 2:1 panorama: rows cut away above and below, then resampling."""

    width: int
    height: int
    """Size of the images that come in."""
    first_row: int
    rows: int
    target: tuple[int, int]
    """Width and height of the images that go out."""
    mask = None

    @property
    def source_size(self) -> tuple[int, int]:
        """Width and height of the images that come in."""
        return self.width, self.height

    @property
    def camera(self) -> Equirectangular:
        """The panorama."""
        return Equirectangular(*self.target)

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """Return the image at the target size."""
        image = image[self.first_row : self.first_row + self.rows]
        if self.target == (self.width, self.rows):
            return image
        shrinks = self.target[0] <= self.width and self.target[1] <= self.rows
        # averaging is the anti-aliasing filter; for enlarging it would repeat pixels
        return cv2.resize(image, self.target, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def plan_fit(width: int, height: int, camera_fit: str, resize: tuple[int, int] | None) -> Fit:
    """Decide how images of this size become 2:1.

    `crop` takes rows away only: without some of its columns a panorama would have no seam.

    Raises:
        InputError: The size cannot be brought to 2:1 in this way.
    """
    first_row, rows = 0, height
    if width != 2 * height:
        off = f"got {width} x {height} ({abs(width - 2 * height) / (2 * height):.1%} off)".replace("%", " %")
        rows = width // 2
        if camera_fit == "none":
            ways = "camera.fit=stretch" if width > 2 * height else "camera.fit=stretch or camera.fit=crop"
            raise InputError(f"input: expected a width of twice the height, {off}; {ways} accepts it.")
        if camera_fit == "crop":
            if width > 2 * height or width % 2:
                raise InputError(
                    f"camera.fit: expected, for crop, an even width and a height of at least half of it, {off}; "
                    "camera.fit=stretch accepts it."
                )
            first_row = (height - rows) // 2
    if resize is not None and (len(resize) != 2 or min(resize) < 1 or resize[0] != 2 * resize[1]):
        raise InputError(f"resize: expected a width of twice the height, got {' x '.join(map(str, resize))}.")
    target = resize or (2 * rows, rows)
    return Fit(width, height, first_row, height if camera_fit == "stretch" else rows, target)


class Images(ImageSequence):
    """An image sequence from a source, every good frame one camera's; it can be iterated again."""

    def __init__(self, source: Source, fit: View, selection: Selection) -> None:
        self.source = source
        self.fit = fit
        self.selection = selection

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def camera(self) -> Camera:
        return self.fit.camera

    @property
    def mask(self) -> Bool[Tensor, "H W"] | None:
        return self.fit.mask

    @property
    def length(self) -> int | None:
        if self.source.length is None:
            return None
        chosen = self.selection
        return len(range(self.source.length)[chosen.start : chosen.stop : chosen.every])

    @property
    def notes(self) -> list[str]:
        """Sentences for the user, such as a video that ended early; complete once the sequence has been iterated."""
        return self.source.notes

    def __iter__(self) -> Iterator[Frame]:
        return map(self._prepare, self.source.read(self.selection.start, self.selection.stop, self.selection.every))

    def _prepare(self, frame: Frame) -> Frame:
        if frame.image is None:
            return frame
        height, width = frame.image.shape[:2]
        if (width, height) != self.fit.source_size:
            return Frame(frame.index, frame.t_ns, None, "size")
        image = self.fit(frame.image)
        return Frame(frame.index, frame.t_ns, image, judge(image))


def judge(image: UInt8[np.ndarray, "H W 3"]) -> str:
    """Return "black" or "white" for an image without texture, else an empty word."""
    mean = sum(cv2.mean(image)[:3]) / 3
    if mean < BLACK_MEAN and image.max() < BLACK_MAX:
        return "black"
    return "white" if mean > WHITE_MEAN else ""


MIN_FPS, MAX_FPS = 1e-3, 1e6
"""Frame rates beyond these give times that do not fit or do not increase."""


def open_images(
    path: str,
    *,
    camera_fit: str = "none",
    resize: tuple[int, int] | None = None,
    start: int = 0,
    stop: int | None = None,
    every: int = 1,
    fps: float | None = None,
) -> Images:
    """Open a video file, a folder of images or a glob pattern as a sequence of equirectangular images.

    Args:
        path: A video; a folder, whose image files are taken in natural order (2 before 10) and whose other files are
            ignored; or a pattern with `*`, `?` or `[`.
        camera_fit: What happens to images that are not 2:1. "none" refuses them, "stretch" resamples their rows to half
            the width, "crop" takes away rows above and below.
        resize: Width and height to resample to, 2:1.
        start: First frame of the source to use.
        stop: Frame before which to stop; None for the end.
        every: Use one frame out of this many.
        fps: Frame rate: replaces a video's own time stamps; for image files it defaults to 30.

    Returns:
        Frames that are read while iterating. One that is unreadable, of another size, black, white or not
        finite has its `problem` set.

    Raises:
        InputError: The input is missing, unreadable, not 2:1 or shorter than two frames, or an argument is not valid.
    """
    check_choice("camera.fit", camera_fit, ("none", "stretch", "crop"))
    selection = Selection(start, stop, every)
    source, size = open_source(path, selection, fps)
    return Images(source, plan_fit(*size, camera_fit, resize), selection)


def open_source(path: str, selection: Selection, fps: float | None) -> tuple[Source, tuple[int, int]]:
    """Open a video file, a folder of images or a glob pattern, and return it with the size of its first frames.

    Args:
        path: As of `open_images`.
        selection: The frames that will be read.
        fps: Frame rate, as of `open_images`.

    Raises:
        InputError: The input is missing, unreadable or shorter than two frames, or the frame rate is none.
    """
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise InputError(f"fps: expected a frame rate above 0, got {fps}.")
    if fps is not None and not MIN_FPS <= fps <= MAX_FPS:
        raise InputError(f"fps: expected a frame rate from {MIN_FPS:g} to {MAX_FPS:g}, got {fps}.")
    source = _find_source(path, fps)
    size = source.size(_select(source, selection))
    if size is None:
        raise InputError(f"input: expected readable images, got none among the first of {path}.")
    return source, size


def _select(source: Source, chosen: Selection) -> range:
    """Return the selected indices, as far as they are known.

    Raises:
        InputError: Fewer than two are left.
    """
    if source.length is not None:
        return chosen.of(source.length)
    known = range(chosen.start, chosen.start + 2 * chosen.every if chosen.stop is None else chosen.stop, chosen.every)
    if len(known) < 2:
        raise InputError(f"input: expected at least two frames after start, stop and every, got {len(known)}.")
    return known


def _find_source(path: str, fps: float | None) -> Source:
    location = Path(path).expanduser()
    if not path:
        raise InputError("input: expected a video, a folder of images or a glob pattern, got an empty name.")
    if location.is_dir():
        files = [file for file in location.iterdir() if file.is_file() and is_image_file(file)]
        found = f"the folder {path} without any"
        return _image_files(location.resolve().name, files, fps, found)
    if location.exists():
        if is_image_file(location):
            raise InputError(
                f"input: expected a video or at least two frames (a folder or a glob pattern), got the image {path}."
            )
        return VideoFile.open(location, fps)
    if glob.has_magic(path):
        files = [file for file in map(Path, glob.glob(str(location), recursive=True)) if is_image_file(file)]
        fixed = [part for part in location.parent.parts if not glob.has_magic(part)]
        return _image_files(fixed[-1] if fixed else "images", files, fps, f"no match for {path}")
    raise InputError(
        f"input: expected a video, a folder of images or a glob pattern, got {path}, which does not exist."
    )


def _image_files(name: str, files: list[Path], fps: float | None, found: str) -> ImageFiles:
    if not files:
        kinds = ", ".join(suffix[1:] for suffix in IMAGE_SUFFIXES)
        raise InputError(f"input: expected image files ({kinds}), got {found}.")
    # by folder first: a pattern may reach into several
    files.sort(key=lambda file: ([natural_key(Path(part)) for part in file.parent.parts], natural_key(file)))
    return ImageFiles(name, files, FALLBACK_FPS if fps is None else fps)
