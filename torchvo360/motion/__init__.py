"""Motion: corner tracks, the essential matrix of bearings, rotation search, and filters that predict it in time."""

from torchvo360.motion.essential import TwoView, estimate_two_view
from torchvo360.motion.kalman import (
    Gaussian,
    Innovation,
    PlanarMotion,
    constant_velocity,
    correct,
    predict,
    smooth,
    update,
)
from torchvo360.motion.pose_filter import (
    PoseFilter,
    PoseFilterConfig,
    PosePrediction,
    PoseState,
    SmoothTrajectory,
    smooth_trajectory,
)
from torchvo360.motion.rotation import RotationResult, align_rotation, rotation_grid, search_rotation

__all__ = [
    "Gaussian",
    "Innovation",
    "PlanarMotion",
    "PoseFilter",
    "PoseFilterConfig",
    "PosePrediction",
    "PoseState",
    "RotationResult",
    "SmoothTrajectory",
    "TwoView",
    "align_rotation",
    "constant_velocity",
    "correct",
    "estimate_two_view",
    "predict",
    "rotation_grid",
    "search_rotation",
    "smooth",
    "smooth_trajectory",
    "update",
]
