"""Keyframes with semi-dense inverse range, their hand-over from one to the next, and the point cloud they leave."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_finite_number
from torchvo360.depth import FilterConfig, InverseRange
from torchvo360.depth.filter import box_sums, scatter
from torchvo360.image import equal_area_cells, select_pixels
from torchvo360.residuals.direct import look_up_value
from torchvo360.vo.frame import FrameBuilder, PyramidFrame

GUESS_RADII_PX = (6, 14)
"""Half widths of the surroundings from which new points take their first guess."""


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
    max_relative_variance: float = 0.05
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
    frame: PyramidFrame,
    T_world_key: Float64[Tensor, "4 4"],
    builder: FrameBuilder,
    config: MapConfig,
    carried: "CarriedPoints | None" = None,
) -> Keyframe:
    """Choose a frame's points: those carried over from the last keyframe, and new ones where they leave a cell empty.

    New points' inverse ranges are guesses, with score 0: rho 1 and variance 1 without carried points.
    """
    camera = builder.cameras[0]
    strength = builder.strength(frame)
    usable = builder.usable(frame)
    cell = equal_area_cells(camera, config.points, device=strength.device).flatten()
    taken = torch.zeros(int(cell.max()) + 1, dtype=torch.bool, device=strength.device)
    if carried is not None:
        carried = carried.one_per_cell(cell[carried.pixel], usable.flatten() & (strength.flatten() > 0))
        taken[cell[carried.pixel]] = True
    pixel = select_pixels(
        strength, usable & ~taken[cell].view_as(usable), camera, config.points, minimum=config.min_gradient
    )
    ray = builder.rays(pixel)
    points = InverseRange(torch.ones_like(ray[0]), torch.ones_like(ray[0]), torch.zeros_like(ray[0]))
    if carried is not None:
        points = carried.guess(pixel, camera)
        pixel, order = torch.cat([carried.pixel, pixel]).sort(stable=True)
        ray = torch.cat([carried.ray, ray], 1)[:, order]
        points = InverseRange(*(torch.cat(pair)[order] for pair in zip(carried.points, points, strict=True)))
    values = [look_up_value(target, ray) for target in frame.targets]
    return Keyframe(frame, T_world_key, pixel, ray, strength.flatten()[pixel], values, points)


def moved_points(key: Keyframe, T_cam_key: Float64[Tensor, "4 4"]) -> tuple[Float[Tensor, "3 N"], Float[Tensor, "N"]]:
    """Return a keyframe's points in another camera: unit rays and inverse distances."""
    T = T_cam_key.to(key.ray.dtype)
    rho = key.points.rho
    Y = T[:3, :3] @ key.ray + rho * T[:3, 3:]
    inv_length = Y.square().sum(0).clamp_min(1e-24).rsqrt()
    return Y * inv_length, rho * inv_length


@dataclass(frozen=True)
class CarriedPoints:
    """Points of an old keyframe where they lie in a new one.

    The same points are carried on, at their exact places, instead of pooling them on new pixels: averages over
    neighbours at different ranges are biased, and the bias of every keyframe adds up to a drift of scale.
    """

    pixel: Int64[Tensor, "N"]
    ray: Float[Tensor, "3 N"]
    points: InverseRange

    def take(self, index: Tensor) -> "CarriedPoints":
        """Return some of the points."""
        return CarriedPoints(
            self.pixel[index], self.ray[:, index], InverseRange(*(part[index] for part in self.points))
        )

    def one_per_cell(self, cell: Int64[Tensor, "N"], usable: Bool[Tensor, "P"]) -> "CarriedPoints":
        """Return each cell's surest point on a usable pixel."""
        rho, variance, _ = self.points
        good = usable[self.pixel].nonzero()[:, 0]
        sure = good[(variance / rho.square().clamp_min(1e-12))[good].argsort(stable=True)]
        order = sure[cell[sure].argsort(stable=True)]
        first = torch.ones_like(order, dtype=torch.bool)
        first[1:] = cell[order][1:] != cell[order][:-1]
        return self.take(order[first])

    def guess(self, pixel: Int64[Tensor, "M"], camera: Camera) -> InverseRange:
        """Guess new points' inverse ranges from the carried ones around, pooled by 1 / V, with score 0."""
        rho, variance, _ = self.points
        median = rho.median()
        # Relative to the median, so that the thresholds below know no unit; capped, so that no single point rules.
        weight = 1 / (variance / median**2 + 1e-3)
        sums = scatter(camera, self.pixel, torch.stack([weight, weight * rho]))
        near, wide = (box_sums(sums, camera, radius).flatten(1)[:, pixel] for radius in GUESS_RADII_PX)
        around, guess = near[1] / near[0].clamp_min(1e-9), wide[1] / wide[0].clamp_min(1e-9)
        has_near, has_wide = near[0] > 5, wide[0] > 5
        out = torch.where(has_near, around, torch.where(has_wide, guess, median))
        relative = torch.where(has_near, 0.09, 0.36).to(out.dtype)
        return InverseRange(out, relative * out * out, torch.zeros_like(out))


def carry(
    old: Keyframe,
    frame: PyramidFrame,
    T_new_old: Float64[Tensor, "4 4"],
    affine: Float64[Tensor, "2"],
    camera: Camera,
    config: FilterConfig,
    cutoff: float,
) -> CarriedPoints:
    """Return an old keyframe's good points in a new frame; hidden ones, whose intensity differs, are left behind."""
    ray, rho = moved_points(old, T_new_old)
    # To first order V' = V (rho' / rho)^4.
    variance = old.points.variance * (rho / old.points.rho.clamp_min(1e-6)) ** 4
    variance = torch.maximum(variance, config.variance_floor * rho * rho)
    uv, seen = camera.project(ray.T)
    residual = look_up_value(frame.targets[0], ray) - float(affine[0].exp()) * old.values[0] - float(affine[1])
    good = ((old.points.score > 0) & seen & (residual.abs() < cutoff)).nonzero()[:, 0]
    column = uv[:, 0].long().clamp(0, camera.width - 1)
    row = uv[:, 1].long().clamp(0, camera.height - 1)
    everything = CarriedPoints(row * camera.width + column, ray, InverseRange(rho, variance, old.points.score))
    return everything.take(good)


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
    moved, _ = moved_points(key, T_cam_key)
    turned = T_cam_key[:3, :3].to(key.ray.dtype) @ key.ray
    cross = torch.linalg.cross(turned, moved, dim=0).square().sum(0).sqrt()
    return float(torch.atan2(cross, (turned * moved).sum(0))[usable].median())


def relative_pose(T_world_a: Float64[Tensor, "4 4"], T_world_b: Float64[Tensor, "4 4"]) -> Float64[Tensor, "4 4"]:
    """Return T_a_b of two poses in the world."""
    return lie.se3_inverse(T_world_a) @ T_world_b
