"""The point cloud that keyframes leave."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int32, Int64, UInt8
from torch import Tensor

from torchvo360.vo.frame import PyramidFrame

MIN_RHO = 1e-3
"""Points farther than this inverse distance, in the odometry's unit, are at infinity for a cloud."""


@dataclass(frozen=True)
class PointCloud:
    """Points with their colours, and where they were seen."""

    xyz: Float[Tensor, "N 3"]
    rgb: UInt8[Tensor, "N 3"]
    frame: Int32[Tensor, "N"]
    """Index of the keyframe that a point belongs to."""

    def moved(self, S: Float64[Tensor, "4 4"]) -> "PointCloud":
        """Return the points after a similarity."""
        xyz = self.xyz.double() @ S[:3, :3].mT + S[:3, 3]
        return PointCloud(xyz.float(), self.rgb, self.frame)


def to_cloud(
    ray: Float[Tensor, "3 N"], rho: Float[Tensor, "N"], pixel: Int64[Tensor, "N"], frame: PyramidFrame
) -> PointCloud:
    """Return points of a keyframe in its own camera, with their colours; points at infinity are left out.

    Args:
        ray: Unit rays.
        rho: Inverse distances.
        pixel: Flat pixels.
        frame: The keyframe.
    """
    keep = rho > MIN_RHO
    colour = np.ascontiguousarray(frame.colour.reshape(-1, 3)[pixel[keep].cpu().numpy()])
    index = torch.full((len(colour),), frame.index, dtype=torch.int32)
    return PointCloud((ray[:, keep] / rho[keep]).T.float().cpu(), torch.from_numpy(colour), index)


def join_clouds(clouds: list[PointCloud]) -> PointCloud:
    """Return all points of several clouds; an empty cloud for none."""
    if not clouds:
        return PointCloud(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8), torch.zeros(0, dtype=torch.int32))
    return PointCloud(*(torch.cat([getattr(cloud, name) for cloud in clouds]) for name in ("xyz", "rgb", "frame")))
