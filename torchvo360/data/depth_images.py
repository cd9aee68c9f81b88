"""A depth sensor's images: integers of 16 bits, so many a metre, 0 where the range is not known."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from torchvo360.checks import InputError, check_finite_number

LEAST_SCALE, MOST_SCALE = 1e-2, 1e6
"""Stored integers per metre."""

LOOKED_AT = 10
"""Images by which a whole recording's depth is judged."""

NEAREST_M, FARTHEST_M = 0.1, 50.0
"""A median range outside these is in another unit: no such sensor measures there."""


@dataclass(frozen=True)
class DepthImages:
    """Depth beside the images of a recording's first camera, pixel by pixel."""

    name: str
    """For messages."""
    paths: Sequence[Path | None]
    """One for each time of the recording, None where there is no depth."""
    scale: float
    """Stored integers per metre."""

    def __post_init__(self) -> None:
        check_finite_number("depth_scale", self.scale, above=0.0)
        if not LEAST_SCALE <= self.scale <= MOST_SCALE:
            raise InputError(f"depth_scale: expected {LEAST_SCALE:g} to {MOST_SCALE:g} a metre, got {self.scale!r}.")

    def read(self, index: int) -> Float32[np.ndarray, "h w"] | None:
        """Return the ranges in metres, 0 where they are not known; None without a readable image of 16 bits."""
        path = self.paths[index]
        if path is None:
            return None
        try:
            stored = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
        except (OSError, ValueError, cv2.error):  # missing or not permitted, no name of a file, empty
            return None
        if stored is None or stored.ndim != 2 or stored.dtype != np.uint16:
            return None
        return stored.astype(np.float32) / np.float32(self.scale)

    def check(self, selected: Sequence[int], size: tuple[int, int]) -> None:
        """Refuse depth that cannot be used, by the first images that belong to the selected times.

        Args:
            selected: Indices of the times.
            size: Width and height of the camera's images.

        Raises:
            InputError: None is readable, the size is another, no pixel has a value, or the values are in another unit.
        """
        indices = [index for index in selected if self.paths[index] is not None][:LOOKED_AT]
        images = [image for image in map(self.read, indices) if image is not None]
        if not images:
            raise InputError(
                f"{self.name}: expected depth images of 16 bits and one channel, got none among the first."
            )
        height, width = images[0].shape
        if (width, height) != size:
            raise InputError(
                f"{self.name}: expected depth images of the colour images' size {size[0]} x {size[1]}, "
                f"got {width} x {height}."
            )
        known = np.concatenate([image[image > 0] for image in images])
        if not known.size:
            raise InputError(f"{self.name}: expected depth, got none at any pixel of the first {len(images)} images.")
        median = float(np.median(known))
        if not NEAREST_M <= median <= FARTHEST_M:
            raise InputError(
                f"depth_scale: expected one that makes the median depth {NEAREST_M:g} to {FARTHEST_M:g} m, "
                f"got {median:.3g} m with {self.scale:g} a metre."
            )
