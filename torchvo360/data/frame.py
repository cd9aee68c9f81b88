"""What a reader yields: one image with its time, or the reason why there is none."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

from torchvo360.cameras import Camera, Rig
from torchvo360.data.trajectory import Trajectory
from torchvo360.inertial import ImuSensor


@dataclass(frozen=True)
class Frame:
    """One image of a sequence."""

    index: int
    """Position in the source, counted before `start`, `stop` and `every`."""
    t_ns: int
    """Time stamp in nanoseconds."""
    image: UInt8[np.ndarray, "H W 3"] | None
    """Colours in the order red, green, blue; None where the image could not be read."""
    problem: str = ""
    """Empty for a good frame, else one word that says why it cannot be used: unreadable, black, white, size, nan."""
    others: tuple[UInt8[np.ndarray, "H W 3"] | None, ...] = ()
    """Images of a rig's further cameras at the same time, in the rig's order, None for one that is missing; empty for a
    single camera."""
    depth: Float32[np.ndarray, "H W"] | None = None
    """A depth sensor's range of every pixel in the camera's measure (z for a pinhole, the distance for a panorama),
    metres; 0 or not finite where it is not known. None without a sensor."""


class ImageSequence(Protocol):
    """Frames in time order, all from one camera; a class that inherits it may leave out what it has not."""

    @property
    def name(self) -> str:
        """A short name for folders and titles."""
        ...

    @property
    def camera(self) -> Camera:
        """The camera of the images as they are yielded."""
        ...

    @property
    def length(self) -> int | None:
        """The expected number of frames; None when it is unknown."""
        ...

    @property
    def truth(self) -> Trajectory | None:
        """The true poses, where they are known."""
        return None

    @property
    def notes(self) -> list[str]:
        """Sentences for the user, complete once the sequence has been iterated."""
        return []

    @property
    def mask(self) -> Bool[Tensor, "H W"] | None:
        """The pixels that show something, where not all do, such as those beyond a lens's view."""
        return None

    @property
    def rig(self) -> Rig | None:
        """The cameras whose images the frames bring, this one first; None for a single camera."""
        return None

    @property
    def imu(self) -> ImuSensor | None:
        """The inertial measurements of the same time, where there are any."""
        return None

    def __iter__(self) -> Iterator[Frame]: ...
