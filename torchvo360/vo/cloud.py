"""The point cloud that keyframes leave."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchvo360.vo.keyframe import Keyframe

MIN_RHO = 1e-3
"""Points farther than this inverse distance, in the odometry's unit, are at infinity for a cloud."""


@dataclass(frozen=True)
class PointCloud:
    """Points in the world with their colours."""

    xyz: Float[Tensor, "N 3"]
    rgb: UInt8[Tensor, "N 3"]


def to_cloud(key: Keyframe, max_relative_variance: float) -> PointCloud:
    """Return a keyframe's trusted points in the world; points at infinity are left out."""
    keep = key.trusted(max_relative_variance) & (key.points.rho > MIN_RHO)
    p_key = key.ray[:, keep] / key.points.rho[keep]
    T = key.T_world_key.to(p_key.device)
    xyz = (T[:3, :3] @ p_key.double() + T[:3, 3:]).T.float()
    colour = np.ascontiguousarray(key.frame.colour.reshape(-1, 3)[key.pixel[keep].cpu().numpy()])
    return PointCloud(xyz.cpu(), torch.from_numpy(colour))


def join_clouds(clouds: list[PointCloud]) -> PointCloud:
    """Return all points of several clouds; an empty cloud for none."""
    if not clouds:
        return PointCloud(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    return PointCloud(torch.cat([cloud.xyz for cloud in clouds]), torch.cat([cloud.rgb for cloud in clouds]))
