"""Motion without a map: corner tracks, the essential matrix of bearings, and rotation search."""

from torchvo360.motion.essential import TwoView, estimate_two_view
from torchvo360.motion.rotation import RotationResult, align_rotation, rotation_grid, search_rotation

__all__ = ["RotationResult", "TwoView", "align_rotation", "estimate_two_view", "rotation_grid", "search_rotation"]
