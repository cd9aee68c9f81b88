"""Dense direct alignment and visual odometry for 360-degree cameras, in plain PyTorch."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchvo360 import lie
    from torchvo360.alignment import Align, AlignConfig, AlignResult, align
    from torchvo360.cameras import Equirectangular, Pinhole, Rig
    from torchvo360.evaluation import evaluate
    from torchvo360.solve import Status
    from torchvo360.vo import OdometryBatch, VisualOdometry

__all__ = [
    "Align",
    "AlignConfig",
    "AlignResult",
    "Equirectangular",
    "OdometryBatch",
    "Pinhole",
    "Rig",
    "Status",
    "VisualOdometry",
    "align",
    "evaluate",
    "lie",
]

_HOMES = {
    "Align": "alignment",
    "AlignConfig": "alignment",
    "AlignResult": "alignment",
    "align": "alignment",
    "Equirectangular": "cameras",
    "Pinhole": "cameras",
    "Rig": "cameras",
    "evaluate": "evaluation",
    "OdometryBatch": "vo",
    "Status": "solve",
    "VisualOdometry": "vo",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: the command sets the environment before PyTorch reads it."""
    if name in _HOMES:
        return getattr(importlib.import_module(f"torchvo360.{_HOMES[name]}"), name)
    if name == "lie":
        return importlib.import_module("torchvo360.lie")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
