"""Visual odometry: from frames to poses and a map."""

from torchvo360.vo.batch import OdometryBatch
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.keyframes.cloud import PointCloud
from torchvo360.vo.start.begin import LEARNED, SENSOR, STEREO
from torchvo360.vo.state import FrameEstimate, State
from torchvo360.vo.system import OdometryResult, VisualOdometry

__all__ = [
    "LEARNED",
    "SENSOR",
    "STEREO",
    "FrameEstimate",
    "OdometryBatch",
    "OdometryConfig",
    "OdometryResult",
    "PointCloud",
    "State",
    "VisualOdometry",
]
