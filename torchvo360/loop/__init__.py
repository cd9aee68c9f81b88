"""Closing loops: knowing a place again, verifying it by direct Sim(3) alignment, and the robust pose graph."""

from torchvo360.loop.config import VerifyConfig
from torchvo360.loop.correction import carry_poses, odometry_information
from torchvo360.loop.frame import LoopFrame, make_loop_frame
from torchvo360.loop.graph import PoseGraph
from torchvo360.loop.places import PlaceCandidate, PlaceIndex, describe_place, place_similarity
from torchvo360.loop.pose_graph import PoseGraphConfig, PoseGraphResult, optimise_pose_graph
from torchvo360.loop.verify import LoopEvidence, LoopReason, LoopResult, verify_loop

__all__ = [
    "LoopEvidence",
    "LoopFrame",
    "LoopReason",
    "LoopResult",
    "PlaceCandidate",
    "PlaceIndex",
    "PoseGraph",
    "PoseGraphConfig",
    "PoseGraphResult",
    "VerifyConfig",
    "carry_poses",
    "describe_place",
    "make_loop_frame",
    "odometry_information",
    "optimise_pose_graph",
    "place_similarity",
    "verify_loop",
]
