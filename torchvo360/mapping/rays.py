"""Measured rays, the one input of a map: from a camera's centre to the point that it saw.

Points of a semi-dense map and pixels of a depth image are the same to the map.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_floating, check_pose, check_shape


@dataclass(frozen=True)
class Rays:
    """Rays in one frame and one unit; those with a number that is not finite are left out at the door."""

    origins: Float64[Tensor, "N 3"]
    points: Float64[Tensor, "N 3"]
    scan: Int64[Tensor, "N"]
    """Which look a ray belongs to: a cell is seen once a look, however many rays cross it."""

    @classmethod
    def of(
        cls, origins: Float[Tensor, "N 3"], points: Float[Tensor, "N 3"], scan: Int64[Tensor, "N"] | None = None
    ) -> "Rays":
        """Make rays of arrays; without numbers of the scans, equal origins make a scan.

        Raises:
            ShapeError: The shapes are others.
            InputError: They are not of floating type.
        """
        check_shape("origins", origins, "N 3")
        check_shape("points", points, f"{len(origins)} 3")
        check_floating("origins", origins)
        check_floating("points", points)
        if scan is not None:
            check_shape("scan", scan, f"{len(origins)}")
        finite = torch.isfinite(origins).all(-1) & torch.isfinite(points).all(-1)
        origins, points = origins[finite].double(), points[finite].double()
        scan = torch.unique(origins, dim=0, return_inverse=True)[1] if scan is None else scan[finite].long()
        return cls(origins, points, scan)

    def __len__(self) -> int:
        return len(self.scan)

    def moved(self, S: Float64[Tensor, "4 4"]) -> "Rays":
        """Return the rays after a similarity."""
        R, t = S[:3, :3], S[:3, 3]
        return Rays(self.origins @ R.mT + t, self.points @ R.mT + t, self.scan)

    def kept(self, keep: Bool[Tensor, "N"]) -> "Rays":
        """Return some of the rays."""
        return Rays(self.origins[keep], self.points[keep], self.scan[keep])


def join_rays(parts: list[Rays]) -> Rays:
    """Return all rays of several sources, whose scans are held to be different ones.

    Raises:
        InputError: There is no source.
    """
    if not parts:
        raise InputError("rays: expected at least one source, got none.")
    scans, first = [], 0
    for part in parts:
        numbers = torch.unique(part.scan, return_inverse=True)[1]
        scans.append(numbers + first)
        first += int(numbers.max()) + 1 if len(numbers) else 0
    return Rays(torch.cat([p.origins for p in parts]), torch.cat([p.points for p in parts]), torch.cat(scans))


def rays_of_depth(
    camera: Camera,
    depth: Float[Tensor, "H W"],
    T_world_cam: Float64[Tensor, "4 4"],
    *,
    mask: Bool[Tensor, "H W"] | None = None,
    stride: int = 1,
) -> Rays:
    """Return the rays of a dense depth image, a sensor's or a network's: one scan.

    Args:
        camera: Of the image.
        depth: Range of every pixel's centre in the camera's measure; 0 or not finite where it is not known.
        T_world_cam: Pose, in the unit of the ranges.
        mask: Pixels to use.
        stride: Use every n-th row and column.

    Raises:
        ShapeError: The image is not of the camera's size.
        InputError: The pose is not rigid, or the stride is below 1.
    """
    check_shape("depth", depth, f"{camera.height} {camera.width}")
    check_pose("T_world_cam", T_world_cam)
    if stride < 1:
        raise InputError(f"stride: expected at least 1, got {stride}.")
    v, u = torch.meshgrid(
        torch.arange(stride // 2, camera.height, stride), torch.arange(stride // 2, camera.width, stride), indexing="ij"
    )
    reach = depth[v, u].double()
    known = torch.isfinite(reach) & (reach > 0)
    if mask is not None:
        known = known & mask[v, u]
    uv = torch.stack([u, v], -1)[known].double() + 0.5
    p_cam = camera.ray(uv) * reach[known][:, None]
    T = T_world_cam.double()
    points = p_cam @ T[:3, :3].mT + T[:3, 3]
    return Rays(T[:3, 3].expand_as(points), points, torch.zeros(len(points), dtype=torch.int64))
