"""Direct alignment of image pairs: the layer, its settings and its results; and the solve of one resolution."""

from torchvo360.alignment.brightness import match_brightness
from torchvo360.alignment.config import AlignConfig
from torchvo360.alignment.layer import Align, align
from torchvo360.alignment.level import PosePrior, solve_level
from torchvo360.alignment.result import AlignMaps, AlignResult, LevelHistory

__all__ = [
    "Align",
    "AlignConfig",
    "AlignMaps",
    "AlignResult",
    "LevelHistory",
    "PosePrior",
    "align",
    "match_brightness",
    "solve_level",
]
