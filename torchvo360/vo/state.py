"""What the odometry says of each frame."""

from dataclasses import dataclass
from enum import StrEnum

from jaxtyping import Float64
from torch import Tensor


class State(StrEnum):
    """How far a frame's pose can be trusted."""

    INITIALISING = "initialising"
    """No map yet: the online pose is a rotation; the final pose is filled in once there is one."""
    TRACKING = "tracking"
    WEAK = "weak"
    """The pose is a prediction, or rests on little."""
    LOST = "lost"
    """The frame could not be placed; the pose is a prediction."""
    RELOCALISED = "relocalised"
    """Found again after a loss."""


@dataclass(frozen=True)
class FrameEstimate:
    """The odometry's answer to one frame."""

    index: int
    t_ns: int
    T_world_cam: Float64[Tensor, "4 4"]
    """The world is the first frame's camera; its unit the first keyframe's median range, or the metre of
    what knows it: a rig, a depth sensor, a depth network, an IMU."""
    state: State
    reason: str
    """Why the state is what it is, in words a program can compare: ok, low_parallax, bad_frame_black, ..."""
    residual: float
    """Mean absolute residual of the used points, intensities of [0, 1]; NaN where there was none."""
    inliers: float
    """Share of the gradient that is matched to within half a pixel, beyond chance, 0 to 1; NaN where there was none."""
    a: float
    """Log gain of the frame against its keyframe."""
    b: float
    """Offset of the frame against its keyframe, intensities."""
    milliseconds: float
    """Time the step took."""
    covariance: Float64[Tensor, "6 6"] | None = None
    """Of the left error (v, w) of T_cam_world against the keyframe's, by the alignment's own residuals, in the unit of
    the frame's map; None where the frame was not tracked."""
