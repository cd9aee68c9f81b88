"""A keyframe in the making: the mapper's work on it, at once or in a second thread, while the next frames are tracked.

What comes of it takes over at a frame that does not depend on how long the work takes: the same numbers either way.
"""

from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from typing import NamedTuple

from torchvo360.vo.frame import PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe
from torchvo360.vo.keyframes.mapper import Mapper
from torchvo360.vo.modes import do
from torchvo360.vo.track import Track


class Made(NamedTuple):
    """What the mapper made."""

    key: Keyframe
    """What frames are tracked against from now on."""
    left: list[Keyframe]
    """Keyframes that left the window."""


@dataclass
class Making:
    """A keyframe that the mapper is at work on, and the frames since then."""

    work: Future[Made]
    frames: int
    """After so many frames what is made takes over."""
    tracked: list[tuple[PyramidFrame, Track]] = field(default_factory=list)
    """Frames in which the new keyframe's candidates are still to be looked for."""


def make(mapper: Mapper) -> Made:
    """Finish a keyframe that was begun."""
    left = mapper.finish_keyframe()
    return Made(mapper.reference(), left)


def begin(mapper: Mapper, frames: int, worker: Executor | None) -> Making:
    """Begin to finish a keyframe that was begun.

    Args:
        mapper: The map, whose newest keyframe is meant.
        frames: After how many frames the result takes over.
        worker: Who does it; None to do it at once.
    """
    return Making(do(worker, lambda: make(mapper)), frames)
