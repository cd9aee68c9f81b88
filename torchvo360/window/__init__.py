"""Photometric bundle adjustment of a window of keyframes."""

from torchvo360.window.calibration import intrinsics_of
from torchvo360.window.config import WindowConfig
from torchvo360.window.inertial import Coupling
from torchvo360.window.pattern import CENTRE, PATTERN, pattern_rays
from torchvo360.window.points import WindowPoints, make_points
from torchvo360.window.projection import Projected, project_points
from torchvo360.window.state import Metric, WindowFrame
from torchvo360.window.trace import TraceConfig, View, trace
from torchvo360.window.window import Adjustment, Window

__all__ = [
    "CENTRE",
    "PATTERN",
    "Adjustment",
    "Coupling",
    "Metric",
    "Projected",
    "TraceConfig",
    "View",
    "Window",
    "WindowConfig",
    "WindowFrame",
    "WindowPoints",
    "intrinsics_of",
    "make_points",
    "pattern_rays",
    "project_points",
    "trace",
]
