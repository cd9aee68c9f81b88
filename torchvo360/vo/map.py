"""Keyframes with semi-dense inverse range, their hand-over from one to the next, and the point cloud they leave."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from torch import Tensor

from torchvo360 import lie
from torchvo360.checks import InputError, check_finite_number
from torchvo360.depth import FilterConfig, InverseRange
from torchvo360.depth.filter import box_sums, scatter
from torchvo360.image import interpolate, locate, select_pixels
from torchvo360.vo.frame import FrameBuilder, PyramidFrame


@dataclass(kw_only=True)
class MapConfig:
    """Settings of keyframes and their points."""

    points: int = 6000
    """Equal-area cells over the whole sphere, each with at most one point."""
    min_gradient: float = 4 / 255
    """Least gradient of a point, intensity per pixel."""
    keyframe_parallax_deg: float = 5.0
    """Median parallax of the points at which a new keyframe is made; more often, and scale drifts."""
    max_keyframe_gap: int = 40
    """Frames after which a keyframe is made in any case, once there is some parallax."""
    min_visible: float = 0.55
    """Share of agreeing gradient below which a new keyframe is made, if there is some parallax."""
    max_relative_variance: float = 0.1
    """Points with V / rho^2 below this track and enter the point cloud."""

    def __post_init__(self) -> None:
        if self.points < 100:
            raise InputError(f"points: expected at least 100, got {self.points}.")
        if self.max_keyframe_gap < 1:
            raise InputError(f"max_keyframe_gap: expected at least 1, got {self.max_keyframe_gap}.")
        check_finite_number("min_gradient", self.min_gradient, above=0)
        check_finite_number("keyframe_parallax_deg", self.keyframe_parallax_deg, above=0)
        check_finite_number("max_relative_variance", self.max_relative_variance, above=0)


@dataclass
class Keyframe:
    """A frame with points, whose inverse ranges the filter keeps improving."""

    frame: PyramidFrame
    T_world_key: Float64[Tensor, "4 4"]
    pixel: Int64[Tensor, "N"]
    """Flat pixels of the finest level, in increasing order."""
    ray: Float[Tensor, "3 N"]
    slope: Float[Tensor, "N"]
    """Gradient magnitude, intensity per pixel."""
    values: list[Float[Tensor, "N"]]
    """Intensity at each level, the finest first."""
    points: InverseRange

    def trusted(self, max_relative_variance: float) -> Bool[Tensor, "N"]:
        """Return which points are good enough to track and to keep."""
        rho, variance, score = self.points
        return (score > 0) & (variance < max_relative_variance * rho * rho)


def make_keyframe(
    frame: PyramidFrame, T_world_key: Float64[Tensor, "4 4"], builder: FrameBuilder, config: MapConfig
) -> Keyframe:
    """Choose a frame's points; their inverse ranges are unknown: rho 1, variance 1, score 0."""
    strength = builder.strength(frame)
    pixel = select_pixels(
        strength, builder.usable(frame), builder.cameras[0], config.points, minimum=config.min_gradient
    )
    ray = builder.rays(pixel)
    values = []
    for target in frame.targets:
        u, v = target.camera.pixel_of(*ray[:, None].unbind(0))
        values.append(interpolate(target.padded, locate(u, v, target.camera)).value[0, 0])
    unknown = InverseRange(torch.ones_like(ray[0]), torch.ones_like(ray[0]), torch.zeros_like(ray[0]))
    return Keyframe(frame, T_world_key, pixel, ray, strength.flatten()[pixel], values, unknown)


def moved_points(
    key: Keyframe, T_cam_key: Float64[Tensor, "4 4"]
) -> tuple[Float[Tensor, "3 N"], Float[Tensor, "N"], Float[Tensor, "N"]]:
    """Return a keyframe's points in another camera on the sphere: unit rays, inverse distances and their derivative.

    The derivative is d rho' / d rho = (rho' / rho)^2 along the ray, which carries a variance over.
    """
    T = T_cam_key.to(key.ray.dtype)
    rho = key.points.rho
    Y = T[:3, :3] @ key.ray + rho * T[:3, 3:]
    length = torch.linalg.vector_norm(Y, dim=0).clamp_min(1e-12)
    return Y / length, rho / length, length.square().reciprocal()


def hand_over(
    old: Keyframe, new: Keyframe, T_new_old: Float64[Tensor, "4 4"], builder: FrameBuilder, config: FilterConfig
) -> InverseRange:
    """Return the inverse ranges of a new keyframe's points from the old one's, pooled by 1 / V over neighbours.

    Points without near neighbours take the mean of a wider surrounding as a guess, with a variance that says so.
    """
    camera = builder.cameras[0]
    rays, rho, _ = moved_points(old, T_new_old)
    # To first order V' = V (rho' / rho)^4; the floor of 2 % of rho stands for what the pose may have wrong.
    ratio = rho / old.points.rho.clamp_min(1e-6)
    variance = old.points.variance * ratio**4 + (0.02 * rho) ** 2
    uv, seen = camera.project(rays.T)
    good = (old.points.score > 0) & seen
    rho, variance, uv = rho[good], variance[good], uv[good]
    if rho.numel() == 0:
        return new.points
    column = uv[:, 0].long().clamp(0, camera.width - 1)
    row = uv[:, 1].long().clamp(0, camera.height - 1)
    median = rho.median()
    # Relative to the median, so that the thresholds below know no unit; capped, so that no single point rules.
    weight = 1 / (variance / median**2 + 1e-3)
    sums = scatter(camera, row * camera.width + column, torch.stack([weight, weight * rho]))
    near, far, wide = (
        box_sums(sums, camera, radius).flatten(1)[:, new.pixel]
        for radius in (config.radius_px, 3 * config.radius_px, 14)
    )
    pooled, around, guess = (part[1] / part[0].clamp_min(1e-9) for part in (near, far, wide))
    has_near, has_far, has_wide = near[0] > 5, far[0] > 5, wide[0] > 5
    out = torch.where(has_near, pooled, torch.where(has_far, around, torch.where(has_wide, guess, median)))
    relative = torch.where(
        has_near, (4 / near[0].clamp_min(1e-9)).clamp_min(config.variance_floor), torch.where(has_far, 0.09, 0.36)
    )
    return InverseRange(out, relative * out * out, 2.0 * has_near.to(out.dtype))


@dataclass(frozen=True)
class PointCloud:
    """Points in the world with their colours."""

    xyz: Float[Tensor, "N 3"]
    rgb: UInt8[Tensor, "N 3"]


def to_cloud(key: Keyframe, max_relative_variance: float) -> PointCloud:
    """Return a keyframe's trusted points in the world; points at infinity are left out."""
    keep = key.trusted(max_relative_variance) & (key.points.rho > 1e-3)
    p_key = key.ray[:, keep] / key.points.rho[keep]
    T = key.T_world_key
    xyz = (T[:3, :3] @ p_key.double() + T[:3, 3:]).T.float()
    colour = np.ascontiguousarray(key.frame.colour.reshape(-1, 3)[key.pixel[keep].cpu().numpy()])
    return PointCloud(xyz.cpu(), torch.from_numpy(colour))


def median_parallax(key: Keyframe, T_cam_key: Float64[Tensor, "4 4"], usable: Bool[Tensor, "N"]) -> float:
    """Return the median angle by which the translation moves the usable points, radians; 0 without points."""
    if not bool(usable.any()):
        return 0.0
    moved, _, _ = moved_points(key, T_cam_key)
    turned = T_cam_key[:3, :3].to(key.ray.dtype) @ key.ray
    cross = torch.linalg.vector_norm(torch.linalg.cross(turned, moved, dim=0), dim=0)
    return float(torch.atan2(cross, (turned * moved).sum(0))[usable].median())


def relative_pose(T_world_a: Float64[Tensor, "4 4"], T_world_b: Float64[Tensor, "4 4"]) -> Float64[Tensor, "4 4"]:
    """Return T_a_b of two poses in the world."""
    return lie.se3_inverse(T_world_a) @ T_world_b
