"""Dense direct alignment and visual odometry for 360-degree cameras, in plain PyTorch."""

from torchvo360 import lie
from torchvo360.alignment import AlignConfig, AlignResult, align
from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.evaluation import evaluate
from torchvo360.solve import Status
from torchvo360.vo import VisualOdometry

__all__ = [
    "AlignConfig",
    "AlignResult",
    "Equirectangular",
    "Pinhole",
    "Status",
    "VisualOdometry",
    "align",
    "evaluate",
    "lie",
]
