"""Keyframes: frames with points and what is known of their inverse ranges."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_finite_number
from torchvo360.depth import InverseRange
from torchvo360.image import equal_area_cells, one_per_cell, select_pixels
from torchvo360.residuals.direct import look_up_value
from torchvo360.vo.frame import FrameBuilder, PyramidFrame


@dataclass(kw_only=True)
class MapConfig:
    """Settings of keyframes and their points."""

    points: int = 800
    """Fresh points that a keyframe looks for, one in each equal-area cell: the cells shrink where many give none."""
    start_points: int = 6000
    """Cells of the first keyframe of a window, each with at most one point, before its ranges are known."""
    min_gradient: float = 4 / 255
    """Least gradient of a point, intensity per pixel."""
    max_difference: float = 15 / 255
    """A point that looks more different in a keyframe is hidden there."""
    keyframe_flow_deg: float = 4.6
    """Mean angle by which translation moves the points at which a new keyframe is made."""
    max_keyframe_gap: int = 24
    """Frames after which a keyframe is made in any case, once there is some parallax."""
    lag: float = 0.0
    """Share of the frames from one keyframe to the next that are tracked by the points known before, while its own are
    found in a second thread. With 0.5 final errors are the same, those of poses as they are given out a sixth larger;
    two cores are then busy. With an IMU, and with estimated intrinsics, it is 0."""
    max_keyframe_gain: float = 0.4
    """Change of the log gain at which a new keyframe is made, once there is some parallax."""
    min_visible: float = 0.55
    """Share of agreeing gradient below which a new keyframe is made, if there is some parallax."""
    max_relative_variance: float = 0.05
    """Points with V / rho^2 below this track and enter the point cloud."""

    def __post_init__(self) -> None:
        for name in ("points", "start_points"):
            if getattr(self, name) < 100:
                raise InputError(f"{name}: expected at least 100, got {getattr(self, name)}.")
        if self.max_keyframe_gap < 1:
            raise InputError(f"max_keyframe_gap: expected at least 1, got {self.max_keyframe_gap}.")
        check_finite_number("min_visible", self.min_visible, above=-1e-9, at_most=1)
        check_finite_number("min_gradient", self.min_gradient, above=0)
        check_finite_number("lag", self.lag, above=-1e-9, at_most=1)
        for name in ("keyframe_flow_deg", "max_keyframe_gain", "max_difference"):
            check_finite_number(name, getattr(self, name), above=0)
        check_finite_number("max_relative_variance", self.max_relative_variance, above=0)


@dataclass
class KeyPoints:
    """A keyframe's points: all that tracking against it needs."""

    index: int
    """Of the frame."""
    T_world_key: Float64[Tensor, "4 4"]
    pixel: Int64[Tensor, "N"]
    """Flat pixels of the finest level, in increasing order."""
    ray: Float[Tensor, "3 N"]
    """Unit rays in the keyframe's camera."""
    slope: Float[Tensor, "N"]
    """Gradient magnitude, intensity per pixel."""
    values: list[Float[Tensor, "N"]]
    """Intensity at each level, the finest first."""
    points: InverseRange

    def trusted(self, max_relative_variance: float) -> Bool[Tensor, "N"]:
        """Return which points are good enough to track and to keep."""
        rho, variance, score = self.points
        return (score > 0) & (variance < max_relative_variance * rho * rho)

    def moved(self, T_cam_key: Float64[Tensor, "4 4"]) -> tuple[Float[Tensor, "3 N"], Float[Tensor, "N"]]:
        """Return the points in another camera: unit rays and inverse distances."""
        T = T_cam_key.to(self.ray)
        Y = T[:3, :3] @ self.ray + self.points.rho * T[:3, 3:]
        inv_length = Y.square().sum(0).clamp_min(1e-24).rsqrt()
        return Y * inv_length, self.points.rho * inv_length

    def share_in_view(self, T_cam_key: Float64[Tensor, "4 4"], camera: Camera) -> float:
        """Return which share of the points in use another camera has in view; 1 without points."""
        used = self.points.score > 0
        _, seen = camera.project(self.moved(T_cam_key)[0].T)
        return float(seen[used].double().mean()) if bool(used.any()) else 1.0

    def mean_flow(self, T_cam_key: Float64[Tensor, "4 4"]) -> float:
        """Return the mean angle by which the translation moves the points in use, radians; 0 without points."""
        used = self.points.score > 0
        if not bool(used.any()):
            return 0.0
        moved, _ = self.moved(T_cam_key)
        turned = T_cam_key[:3, :3].to(self.ray) @ self.ray
        cross = torch.linalg.cross(turned, moved, dim=0).square().sum(0).sqrt()
        return float(torch.atan2(cross, (turned * moved).sum(0))[used].mean())


@dataclass
class Keyframe(KeyPoints):
    """Points with the frame they are seen in."""

    frame: PyramidFrame


def make_keyframe(
    frame: PyramidFrame, T_world_key: Float64[Tensor, "4 4"], builder: FrameBuilder, config: MapConfig
) -> Keyframe:
    """Choose a frame's points; their inverse ranges are not known yet: rho 1, variance 1 and score 0."""
    strength = builder.strength(frame)
    camera, minimum = builder.cameras[0], config.min_gradient
    pixel = select_pixels(strength, builder.usable(frame), camera, config.start_points, minimum=minimum)
    ray = builder.rays(pixel)
    points = InverseRange(torch.ones_like(ray[0]), torch.ones_like(ray[0]), torch.zeros_like(ray[0]))
    values = [look_up_value(target, ray) for target in frame.targets]
    return Keyframe(frame.index, T_world_key, pixel, ray, strength.flatten()[pixel], values, points, frame)


def carried_keyframe(
    old: KeyPoints,
    frame: PyramidFrame,
    T_cam_key: Float64[Tensor, "4 4"],
    affine: Float64[Tensor, "2"],
    builder: FrameBuilder,
    config: MapConfig,
    *,
    variance_floor: float,
    max_difference: float,
) -> Keyframe:
    """Make a frame a keyframe, with the points of an older one in which it was found, at their exact places.

    Averages over neighbours at different ranges would be biased. Points that are hidden in the frame, so that their
    intensity differs, stay behind; of several in a cell the surest goes on.

    Args:
        old: The older keyframe.
        frame: The frame.
        T_cam_key: Where it was found.
        affine: Its brightness (a, b) against the older keyframe.
        builder: Of the frames.
        config: Settings.
        variance_floor: Least relative variance V / rho^2 that a point keeps.
        max_difference: A point whose intensity differs by more is hidden.
    """
    camera = builder.cameras[0]
    ray, rho = old.moved(T_cam_key)
    # To first order V' = V (rho' / rho)^4.
    variance = old.points.variance * (rho / old.points.rho.clamp_min(1e-6)) ** 4
    variance = torch.maximum(variance, variance_floor * rho * rho)
    uv, seen = camera.project(ray.T)
    gained = float(affine[0].exp()) * old.values[0] + float(affine[1])
    shown = (frame.value(ray) - gained).abs() <= max_difference
    column = uv[:, 0].long().clamp(0, camera.width - 1)
    row = uv[:, 1].long().clamp(0, camera.height - 1)
    pixel = row * camera.width + column
    strength = builder.strength(frame).flatten()
    usable = builder.usable(frame).flatten() & (strength > 0)
    index = ((old.points.score > 0) & seen & shown & usable[pixel]).nonzero()[:, 0]
    cell = equal_area_cells(camera, config.start_points, device=ray.device).flatten()
    relative = variance / rho.square().clamp_min(1e-12)
    index = index[one_per_cell(cell[pixel[index]], relative[index])]
    index = index[pixel[index].argsort(stable=True)]
    pixel, ray = pixel[index], ray[:, index]
    points = InverseRange(rho[index], variance[index], old.points.score[index])
    values = [look_up_value(target, ray) for target in frame.targets]
    T_world_key = lie.se3_normalized(old.T_world_key @ lie.se3_inverse(T_cam_key))
    return Keyframe(frame.index, T_world_key, pixel, ray, strength[pixel], values, points, frame)
