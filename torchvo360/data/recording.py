"""A recorded sequence: image files with times of their own, from one camera or a rig, brought to pinholes.

Calibrations come in as lenses, whose pixels already count from the image's corner. What is wrong with the whole
recording is refused when it is opened, in one sentence; what is wrong with a single frame is told by `Frame.problem`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8
from torch import Tensor

from torchvo360.cameras import Camera, Lens, Pinhole, Rig
from torchvo360.checks import InputError
from torchvo360.data.depth_images import DepthImages
from torchvo360.data.folder import READABLE_WITHIN, read_image
from torchvo360.data.frame import Frame, ImageSequence
from torchvo360.data.images import View, judge
from torchvo360.data.selection import Selection
from torchvo360.data.trajectory import Trajectory
from torchvo360.data.undistort import undistort
from torchvo360.inertial import ImuSensor

FARTHEST = 0.5
"""How far outside the image a principal point may lie, in widths and heights; beyond it the unit is another."""


class DepthView(View, Protocol):
    """How the stored images of one camera, and a sensor's depth beside them, become the camera's."""

    def depth(self, depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "H W"]: ...


@dataclass(frozen=True)
class Resampling:
    """The view of a pinhole: the whole image, in another size where that is asked for."""

    source_size: tuple[int, int]
    """Width and height of the images that come in."""
    camera: Pinhole
    mask = None

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """Return the image at the camera's size."""
        size = self.camera.width, self.camera.height
        if size == self.source_size:
            return image
        # averaging is the anti-aliasing filter; for enlarging it would repeat pixels
        shrinks = size[0] <= self.source_size[0] and size[1] <= self.source_size[1]
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)

    def depth(self, depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "H W"]:
        """Return the range of the nearest pixel: the mean of two surfaces is neither."""
        return cv2.resize(depth, (self.camera.width, self.camera.height), interpolation=cv2.INTER_NEAREST_EXACT)


@dataclass(frozen=True)
class Stream:
    """One camera of a recording and its files."""

    name: str
    """For messages."""
    lens: Lens
    paths: Sequence[Path | None]
    """One for each time of the recording, None where there is no image."""

    def __post_init__(self) -> None:
        lens = self.lens
        for name, focal in (("fx", lens.fx), ("fy", lens.fy)):
            if focal <= 0:
                raise InputError(f"{self.name}: expected a focal length {name} above 0, got {focal:g}.")
        for name, centre, size in (("cx", lens.cx, lens.width), ("cy", lens.cy, lens.height)):
            if not -FARTHEST * size <= centre <= (1 + FARTHEST) * size:
                raise InputError(
                    f"{self.name}: expected a principal point near the image of {lens.width} x {lens.height}, "
                    f"got {name} = {centre - 0.5:g}."
                )

    def view(self, size: tuple[int, int] | None) -> DepthView:
        """Return how the images become those of a pinhole.

        Args:
            size: Width and height to bring them to. What a lens distorts is undistorted and cut to that shape; None
                keeps its resolution.
        """
        if any(self.lens.distortion):
            return undistort(self.lens, target="pinhole", size=size)
        pinhole = self.lens.pinhole
        return Resampling((pinhole.width, pinhole.height), pinhole if size is None else pinhole.resized(*size))

    def check_size(self, selected: range) -> None:
        """Refuse images of another size than the calibration's, by the first readable one.

        Raises:
            InputError: It is of another size, or none of the first is readable.
        """
        size = first_size([self.paths[index] for index in selected[:READABLE_WITHIN]])
        if size is None:
            raise InputError(f"{self.name}: expected readable images, got none among the first.")
        if size != (self.lens.width, self.lens.height):
            raise InputError(
                f"{self.name}: expected images of the calibration's size {self.lens.width} x {self.lens.height}, "
                f"got {size[0]} x {size[1]}."
            )


def first_size(paths: Sequence[Path | None]) -> tuple[int, int] | None:
    """Return width and height of the first readable image; None when there is none."""
    for path in paths:
        image = None if path is None else read_image(path)[0]
        if image is not None:
            return image.shape[1], image.shape[0]
    return None


class Recording(ImageSequence):
    """The sequence that all readers of recordings return; it can be iterated again.

    Of a frame with a problem neither the other cameras' images nor the depth are read. A further camera's image is None
    where it is missing or has a problem, the depth None where the sensor gave none at that time.
    """

    def __init__(
        self,
        name: str,
        t_ns: Sequence[int],
        streams: Sequence[Stream],
        *,
        selection: Selection,
        resize: tuple[int, int] | None = None,
        T_first_cam: Float64[Tensor, "n 4 4"] | None = None,
        depth: DepthImages | None = None,
        truth: Trajectory | None = None,
        imu: ImuSensor | None = None,
        notes: Sequence[str] = (),
    ) -> None:
        """Look at the first images, and prepare how they become a pinhole's.

        Args:
            name: For folders and titles.
            t_ns: The times, which increase.
            streams: The cameras, with a path for each time.
            selection: Which of the times are used.
            resize: Width and height to bring the images to.
            T_first_cam: Where each camera is in the first one, metres, for a rig.
            depth: A sensor's ranges for the first camera.
            truth: True poses of the first camera.
            imu: Inertial measurements, with their place in the first camera.
            notes: Sentences for the user.

        Raises:
            InputError: The selection leaves fewer than two frames, the images cannot be read or differ in size from the
                calibration or from camera to camera, the depth is unusable, or the size asked for is none.
        """
        if resize is not None and (len(resize) != 2 or min(resize) < 1):
            raise InputError(f"resize: expected a width and a height, got {' x '.join(map(str, resize))}.")
        self._name = name
        self._t_ns = t_ns
        self._streams = streams
        self._selected = selection.of(len(t_ns))
        self._depth, self._truth, self._imu, self._notes = depth, truth, imu, list(notes)
        sizes = {(stream.lens.width, stream.lens.height) for stream in streams}
        if len(sizes) > 1:
            got = " and ".join(f"{width} x {height}" for width, height in sorted(sizes))
            raise InputError(f"{name}: expected the cameras' images to have one size, got {got}.")
        for stream in streams:
            stream.check_size(self._selected)
        if depth is not None:
            depth.check(self._selected, (streams[0].lens.width, streams[0].lens.height))
        first = streams[0].view(resize)
        size = first.camera.width, first.camera.height
        self._views = [first, *(stream.view(size) for stream in streams[1:])]
        self._rig = None
        if T_first_cam is not None:
            self._rig = Rig(tuple(view.camera for view in self._views), T_first_cam)

    @property
    def name(self) -> str:
        return self._name

    @property
    def camera(self) -> Camera:
        return self._views[0].camera

    @property
    def length(self) -> int:
        return len(self._selected)

    @property
    def truth(self) -> Trajectory | None:
        return self._truth

    @property
    def notes(self) -> list[str]:
        return self._notes

    @property
    def mask(self) -> Bool[Tensor, "H W"] | None:
        return self._views[0].mask

    @property
    def rig(self) -> Rig | None:
        return self._rig

    @property
    def imu(self) -> ImuSensor | None:
        return self._imu

    def __iter__(self) -> Iterator[Frame]:
        return map(self._frame, self._selected)

    def _frame(self, index: int) -> Frame:
        t_ns = int(self._t_ns[index])
        image, problem = self._image(0, index)
        further = range(1, len(self._streams))
        if problem:
            return Frame(index, t_ns, image, problem, others=(None,) * len(further))
        pairs = (self._image(camera, index) for camera in further)
        others = tuple(None if trouble else other for other, trouble in pairs)
        return Frame(index, t_ns, image, others=others, depth=self._range(index))

    def _image(self, camera: int, index: int) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]:
        view, path = self._views[camera], self._streams[camera].paths[index]
        image, problem = (None, "unreadable") if path is None else read_image(path)
        if image is None:
            return None, problem
        height, width = image.shape[:2]
        if (width, height) != view.source_size:
            return None, "size"
        return view(image), judge(image)

    def _range(self, index: int) -> Float32[np.ndarray, "H W"] | None:
        view, depth = self._views[0], None if self._depth is None else self._depth.read(index)
        return view.depth(depth) if depth is not None and depth.shape[::-1] == view.source_size else None


def rig_poses(T_first_other: Float64[Tensor, "4 4"]) -> Float64[Tensor, "2 4 4"]:
    """Return the poses in the first camera of a pair: itself, and the other one's."""
    return torch.stack([torch.eye(4, dtype=torch.float64), T_first_other])
