"""What a file's pixels were taken with: a projection with distortion, exactly forwards, by Newton's method backwards.

A lens is no `Camera`: the odometry sees images that were resampled into one (torchvo360.data.undistort). Like a
camera's, its pixels count from the image's outer corner with centres at +0.5; its frame has x right, y down, z forward.

Both models end where their radial polynomial stops growing: there the image folds back over itself, and what lies
beyond would be seen at pixels that belong to other rays.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from torchvo360.cameras.pinhole import MIN_DEPTH, Pinhole
from torchvo360.checks import InputError, check_choice, check_finite_number, check_shape

COEFFICIENTS = {"none": (0,), "radtan": (4, 5), "equidistant": (4,)}
"""Distortion models and how many numbers each takes."""

NEWTON_STEPS = 40
"""Of a search that a bracket guards: bisection alone would reach 1e-12 of it."""

PLANE_STEPS = 10
"""Newton steps for the tangential part, which is small: from the radial solution four are usual."""

CONVERGED_PX = 1e-6
"""A ray whose pixel is farther than this from the given one was not found."""

MAX_SLOPE = 1e4
"""Farthest point of the plane z = 1 that is looked at where the polynomial never folds."""

LEAST_FOCAL = 0.02
"""Of a calibration, in widths or heights of the image: a plane would be seen 175 degrees across."""


@dataclass(frozen=True)
class Lens:
    """An image's size, its intrinsics in pixels (principal point from the outer corner) and its distortion.

    `none` is a pinhole. `radtan` is OpenCV's polynomial on the plane z = 1 (Kalibr's radial-tangential): k1, k2, p1,
    p2 and, with five numbers, k3. `equidistant` is the Kannala-Brandt polynomial in the angle from the optical axis
    (OpenCV's fisheye, Kalibr's equidistant): k1 to k4; it may see more than a half space.

    Source: OpenCV, calib3d, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model".
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "none"
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if not isinstance(size, int) or isinstance(size, bool) or size < 1:
                raise InputError(f"{name}: expected a positive integer, got {size!r}.")
        for name in ("fx", "fy", "cx", "cy"):
            check_finite_number(name, getattr(self, name))
            if name in ("fx", "fy") and getattr(self, name) == 0:
                raise InputError(f"{name}: expected a focal length other than zero, got 0.")
        check_choice("model", self.model, tuple(COEFFICIENTS))
        counts = COEFFICIENTS[self.model]
        if len(self.distortion) not in counts:
            expected = " or ".join(map(str, counts))
            raise InputError(f"distortion: expected {expected} numbers for {self.model}, got {len(self.distortion)}.")
        for number, value in enumerate(self.distortion, 1):
            check_finite_number(f"distortion, number {number}", value)

    @classmethod
    def of_opencv(
        cls,
        width: int,
        height: int,
        intrinsics: tuple[float, float, float, float],
        model: str = "none",
        distortion: tuple[float, ...] = (),
    ) -> "Lens":
        """Return the lens of a calibration whose pixel centres are at integers: OpenCV, Kalibr, TUM, KITTI, EuRoC.

        Args:
            width: Of the calibrated images, pixels.
            height: Of the calibrated images, pixels.
            intrinsics: fx, fy, cx, cy; 0.5 is added to cx and cy.
            model: `none`, `radtan` or `equidistant`.
            distortion: The model's coefficients.

        Raises:
            InputError: A number is impossible, or there are too many or too few.
        """
        fx, fy, cx, cy = intrinsics
        lens = cls(width, height, fx, fy, cx + 0.5, cy + 0.5, model, tuple(distortion))
        for name, focal, side, length in (("fx", fx, "width", width), ("fy", fy, "height", height)):
            if abs(focal) < LEAST_FOCAL * length:
                raise InputError(
                    f"{name}: expected at least {LEAST_FOCAL:g} of the image's {side}, got {focal:g} pixels."
                )
        return lens

    @property
    def pinhole(self) -> Pinhole:
        """The camera that the image would have without its distortion."""
        return Pinhole(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def resized(self, width: int, height: int) -> "Lens":
        """Return the lens of images resampled to another size."""
        by_u, by_v = width / self.width, height / self.height
        scaled = self.fx * by_u, self.fy * by_v, self.cx * by_u, self.cy * by_v
        return Lens(width, height, *scaled, self.model, self.distortion)

    @property
    def _radial(self) -> tuple[float, ...]:
        """c of the odd polynomial t (1 + c1 t^2 + c2 t^4 + ...), in the slope or in the angle."""
        if self.model == "radtan":
            return (*self.distortion[:2], *self.distortion[4:])
        return self.distortion

    @cached_property
    def limit(self) -> float:
        """Where the image folds or ends: an angle from the axis for `equidistant` (radians, at most pi), else a slope
        (at most infinite)."""
        most = math.pi if self.model == "equidistant" else math.inf
        derivative = [(2 * order + 1) * c for order, c in enumerate((1.0, *self._radial))]
        roots = np.roots(derivative[::-1])  # in t^2
        real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
        return min(most, math.sqrt(real.min())) if real.size else most

    def project(self, ray: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Map rays to pixels.

        Args:
            ray: Points in the lens's frame; any positive multiple gives the same pixel.

        Returns:
            uv: Pixels; finite for finite rays.
            valid: Whether the ray is seen: False outside the image, beyond the fold of the distortion, and for all
                models but `equidistant` at or behind the plane z = 0.

        Raises:
            ShapeError: The last axis is not 3.
        """
        check_shape("ray", ray, "... 3")
        xy, valid = self._distort_ray(ray)
        u, v = xy[..., 0] * self.fx + self.cx, xy[..., 1] * self.fy + self.cy
        valid = valid & (u >= 0) & (u <= self.width) & (v >= 0) & (v <= self.height)
        return torch.stack([u, v], -1), valid

    def _distort_ray(self, ray: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        z = ray[..., 2]
        if self.model == "equidistant":
            xy = ray[..., :2]
            off_axis = (xy != 0).any(-1)
            radius = torch.linalg.vector_norm(torch.where(off_axis[..., None], xy, 1.0), dim=-1)
            theta = torch.atan2(radius, z)
            bent = torch.where(off_axis, _odd(self._radial, theta) / radius, 0.0)
            return xy * bent[..., None], torch.where(off_axis, theta < self.limit, z > 0)
        ahead = z > MIN_DEPTH
        slope = ray[..., :2] / torch.where(ahead, z, 1.0)[..., None]
        xy, J = self._distort_plane(slope)
        one_to_one = J[..., 0, 0] * J[..., 1, 1] > J[..., 0, 1] * J[..., 1, 0]
        return xy, ahead & one_to_one & (slope.square().sum(-1) < self.limit**2)

    def _distort_plane(
        self, slope: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch 2 2"]]:
        """Distort points of the plane z = 1, and return the derivative."""
        k = [*self._radial, *[0.0] * 3][:3]
        p1, p2 = self.distortion[2:4] if self.model == "radtan" else (0.0, 0.0)
        x, y = slope.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))
        growth = 2 * (k[0] + r2 * (2 * k[1] + r2 * 3 * k[2]))  # d radial / dx is growth x
        bent = torch.stack(
            [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
            -1,
        )
        across = growth * x * y + 2 * p1 * x + 2 * p2 * y
        J_xx = radial + growth * x * x + 2 * p1 * y + 6 * p2 * x
        J_yy = radial + growth * y * y + 6 * p1 * y + 2 * p2 * x
        return bent, torch.stack([torch.stack([J_xx, across], -1), torch.stack([across, J_yy], -1)], -2)

    def ray(self, uv: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Map pixels to rays of length 1, by Newton's method in float64; there are no gradients.

        Args:
            uv: Pixels; they need not lie inside the image.

        Returns:
            ray: Of length 1; finite for finite pixels.
            valid: False where no ray before the fold leads to the pixel.

        Raises:
            ShapeError: The last axis is not 2.
        """
        check_shape("uv", uv, "... 2")
        with torch.no_grad():
            fine = uv.double()
            xy = torch.stack([(fine[..., 0] - self.cx) / self.fx, (fine[..., 1] - self.cy) / self.fy], -1)
            ray = self._ray_of_angle(xy) if self.model == "equidistant" else self._ray_of_slope(xy)
            again, seen = self._distort_ray(ray)
            error = (again - xy).abs() * fine.new_tensor([abs(self.fx), abs(self.fy)])
            valid = seen & (error < CONVERGED_PX).all(-1)
            return ray.to(uv.dtype), valid

    def _ray_of_angle(self, xy: Float64[Tensor, "*batch 2"]) -> Float64[Tensor, "*batch 3"]:
        radius = torch.linalg.vector_norm(xy, dim=-1)
        theta = _invert_odd(self._radial, radius, self.limit)
        towards = xy / radius.clamp_min(torch.finfo(torch.float64).tiny)[..., None]
        return torch.cat([towards * theta.sin()[..., None], theta.cos()[..., None]], -1)

    def _ray_of_slope(self, xy: Float64[Tensor, "*batch 2"]) -> Float64[Tensor, "*batch 3"]:
        slope = xy
        if self.model == "radtan":
            radius = torch.linalg.vector_norm(xy, dim=-1)
            undistorted = _invert_odd(self._radial, radius, min(self.limit, MAX_SLOPE))
            slope = xy * (undistorted / radius.clamp_min(torch.finfo(torch.float64).tiny))[..., None]
            for _ in range(PLANE_STEPS):
                bent, J = self._distort_plane(slope)
                step, info = torch.linalg.solve_ex(J, (xy - bent)[..., None])
                # near the fold the derivative is next to singular: a step no longer than the point itself
                length = torch.linalg.vector_norm(step[..., 0], dim=-1, keepdim=True)
                shorter = (torch.linalg.vector_norm(slope, dim=-1, keepdim=True) / length).clamp(max=1)
                good = (info == 0)[..., None] & (length > 0)
                slope = torch.where(good, slope + step[..., 0] * shorter, slope)
        ray = torch.cat([slope, torch.ones_like(slope[..., :1])], -1)
        return ray / torch.linalg.vector_norm(ray, dim=-1, keepdim=True)


def _odd(c: tuple[float, ...], t: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return t (1 + c1 t^2 + c2 t^4 + ...)."""
    t2, sum_ = t * t, torch.zeros_like(t)
    for coefficient in reversed(c):
        sum_ = (sum_ + coefficient) * t2
    return t * (1 + sum_)


def _invert_odd(c: tuple[float, ...], value: Float64[Tensor, "*batch"], limit: float) -> Float64[Tensor, "*batch"]:
    """Return t in [0, limit] with `_odd(c, t) == value`, limit where the value is larger than any.

    Newton's method inside a bracket, halved where a step would leave it: the polynomial grows all the way.
    """
    derivative = tuple((2 * order + 1) * coefficient for order, coefficient in enumerate(c, 1))
    low, high = torch.zeros_like(value), torch.full_like(value, limit)
    t = value.clamp(max=limit)
    for _ in range(NEWTON_STEPS):
        error = _odd(c, t) - value
        low, high = torch.where(error <= 0, t, low), torch.where(error >= 0, t, high)
        # d/dt of the odd polynomial: its own kind without the factor t
        slope = torch.where(t > 0, _odd(derivative, t) / t.clamp_min(torch.finfo(torch.float64).tiny), 1.0)
        newton = t - error / torch.where(slope > 0, slope, 1.0)
        inside = (slope > 0) & (newton >= low) & (newton <= high)
        t = torch.where(inside, newton, (low + high) / 2)
    return t
