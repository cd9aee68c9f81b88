"""What a reader yields: one image with its time, or the reason why there is none."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import UInt8

from torchvo360.cameras import Camera
from torchvo360.data.trajectory import Trajectory


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


class ImageSequence(Protocol):
    """Frames in time order, all from one camera."""

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
        ...

    def __iter__(self) -> Iterator[Frame]: ...
