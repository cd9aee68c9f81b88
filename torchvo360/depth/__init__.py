"""Depth from motion: epipolar search and the inverse-range filter."""

from torchvo360.depth.epipolar import EpipolarConfig, EpipolarMatch, search_great_circles
from torchvo360.depth.filter import FilterConfig, InverseRange, fuse, guess_around, smooth

__all__ = [
    "EpipolarConfig",
    "EpipolarMatch",
    "FilterConfig",
    "InverseRange",
    "fuse",
    "guess_around",
    "search_great_circles",
    "smooth",
]
