"""Corners followed since a reference frame: what the motion is known by before there is a map."""

from dataclasses import dataclass, field
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.motion.essential import INLIER_RAD, TwoView, estimate_two_view
from torchvo360.motion.flow import bearings, find_corners, follow
from torchvo360.motion.rotation import fit_rotation
from torchvo360.vo.frame import FrameBuilder, PyramidFrame

INLIER_PX = 0.33
"""Accuracy of tracked corners."""


@dataclass
class CornerTracks:
    """Living corner tracks: where they began in the reference frame, and where they are now."""

    camera: Camera | None = None
    corners: Float[np.ndarray, "N 2"] = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    """Where the corners are, continuous pixels."""
    origins: Float64[Tensor, "N 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    """Unit bearings in the reference frame."""
    now: Float64[Tensor, "N 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    """Unit bearings in the present frame."""
    R_cam_ref: Float64[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))
    """The rotation that explains most of their motion."""

    @classmethod
    def found_in(cls, frame: PyramidFrame, builder: FrameBuilder, count: int) -> Self:
        """Find corners in a reference frame."""
        camera = builder.cameras[0]
        corners = find_corners(frame.grey, camera, count, builder.usable(frame).cpu().numpy())
        origins = bearings(corners, camera)
        return cls(camera, corners, origins, origins)

    def follow(self, last: PyramidFrame, frame: PyramidFrame) -> int:
        """Follow the corners from one frame to the next; return how many are left."""
        if self.camera is None:
            return 0
        self.corners, ok = follow(last.grey, frame.grey, self.corners, self.camera)
        self.corners, self.origins = self.corners[ok], self.origins[torch.from_numpy(ok)]
        self.now = bearings(self.corners, self.camera)
        return len(self.corners)

    def rotation(self, start: Float64[Tensor, "3 3"]) -> Float64[Tensor, "3 3"]:
        """Return R_cam_ref, fitted from a start."""
        self.R_cam_ref = fit_rotation(self.origins, self.now, start)
        return self.R_cam_ref

    def moved(self) -> float:
        """Return the median angle that the rotation leaves unexplained, radians: a lower bound of the parallax."""
        turned = self.origins @ self.R_cam_ref.mT
        return float(torch.linalg.vector_norm(torch.linalg.cross(turned, self.now), dim=-1).median())

    def two_view(self, generator: torch.Generator) -> TwoView | None:
        """Return the motion since the reference frame, up to the length of its translation."""
        inlier_rad = INLIER_RAD if self.camera is None else max(INLIER_RAD, INLIER_PX * self.camera.pixel_angle)
        return estimate_two_view(self.origins, self.now, generator, inlier_rad=inlier_rad)
