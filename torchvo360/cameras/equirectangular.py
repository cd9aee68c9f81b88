"""The sphere: longitude and latitude as pixels (mathematics.md, section 2; Huang and Yeung's 360VO, section 7)."""

import math
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.cameras.base import Camera, Intrinsics
from torchvo360.checks import check_shape

AXIS_SHIFT = 1e-18
"""Added to z in the longitude: its square is still a normal float32, and it changes no z above 1e-11."""

MIN_HORIZONTAL = 1e-10
"""Points nearer to the vertical axis than this have no longitude: the shift above would be seen in it."""


@dataclass(frozen=True)
class Equirectangular(Camera):
    """A panorama: `lon = (u - cx) / fx`, `lat = (v - cy) / fy`, with fy negative because v points down.

    The intrinsics default to the full sphere: fx = width / 2 pi, fy = -height / pi, and the centre of the image. Rays
    have length 1 and `scale` is the distance from the camera. Longitude has no value on the vertical axis.
    """

    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    full: bool | None = None
    """Whether the image is the full sphere whatever the intrinsics say, as while they are estimated; None: by them."""

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        return (
            self.width / math.tau if self.fx is None else self.fx,
            -self.height / math.pi if self.fy is None else self.fy,
            self.width / 2 if self.cx is None else self.cx,
            self.height / 2 if self.cy is None else self.cy,
        )

    @property
    def wraps(self) -> bool:
        if self.full is not None:
            return self.full
        fx, fy, _, cy = self.intrinsics
        return (
            math.isclose(fx, self.width / math.tau, rel_tol=1e-9)
            and math.isclose(fy, -self.height / math.pi, rel_tol=1e-9)
            and math.isclose(cy, self.height / 2, rel_tol=1e-9)
        )

    @property
    def _period(self) -> float:
        """How many pixels go around the sphere; exactly the width when the image does."""
        return float(self.width) if self.wraps else abs(self.intrinsics[0]) * math.tau

    @property
    def _least_horizontal2(self) -> float | Tensor:
        """cos(lat)^2 of the first row's centre."""
        return math.sin(0.5 / self.intrinsics[1]) ** 2

    def _longitude_latitude(
        self, uv: Float[Tensor, "*batch 2"], k: Intrinsics | None = None
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        fx, fy, cx, cy = self.intrinsics if k is None else k
        return (uv[..., 0] - cx) / fx, (uv[..., 1] - cy) / fy

    def ray(self, uv: Float[Tensor, "*batch 2"], k: Intrinsics | None = None) -> Float[Tensor, "*batch 3"]:
        check_shape("uv", uv, "... 2")
        lon, lat = self._longitude_latitude(uv, k)
        cos_lat = lat.cos()
        return torch.stack([cos_lat * lon.sin(), -lat.sin(), cos_lat * lon.cos()], -1)

    def scale(self, p_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return torch.linalg.vector_norm(p_cam, dim=-1)

    def scale_of(
        self, x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        return torch.addcmul(torch.addcmul(x * x, y, y), z, z).add(AXIS_SHIFT**2).sqrt()

    def pixel_of(
        self,
        x: Float[Tensor, "*batch"],
        y: Float[Tensor, "*batch"],
        z: Float[Tensor, "*batch"],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        lon, minus_lat = self._longitude_minus_latitude_of(x, y, z)
        return self._pixel_of_angles(lon, minus_lat, k)

    def pixel_and_inverse_scale_of(
        self,
        x: Float[Tensor, "*batch"],
        y: Float[Tensor, "*batch"],
        z: Float[Tensor, "*batch"],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        x2 = x * x
        horizontal = torch.addcmul(x2, z, z).add_(AXIS_SHIFT**2).sqrt_()
        lon, minus_lat = torch.atan2(x, z + AXIS_SHIFT), torch.atan2(y, horizontal)
        # In the order of `scale_of`: what a turn of the camera cannot change comes out as zero, not as rounding.
        inv_scale = torch.addcmul(torch.addcmul(x2, y, y), z, z).add_(AXIS_SHIFT**2).sqrt_().reciprocal()
        return *self._pixel_of_angles(lon, minus_lat, k), inv_scale

    def _pixel_of_angles(
        self, lon: Float[Tensor, "*batch"], minus_lat: Float[Tensor, "*batch"], k: Intrinsics | None
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        fx, fy, cx, cy = self.intrinsics if k is None else k
        if k is not None or not (self.wraps and cx == self.width / 2):
            u = torch.remainder(lon * fx + cx, self._period if self.wraps else abs(fx) * math.tau)
            return u, minus_lat * -fy + cy
        return lon.mul_(fx).add_(cx), minus_lat.mul_(-fy).add_(cy)

    def normalized_of(
        self, x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        lon, minus_lat = self._longitude_minus_latitude_of(x, y, z)
        return lon, -minus_lat

    def _longitude_minus_latitude_of(
        self, x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        # A shift far below the resolution of z keeps values and gradients finite on the vertical axis, and costs less
        # than a mask.
        lon = torch.atan2(x, z + AXIS_SHIFT)
        horizontal = torch.addcmul(x * x, z, z).add(AXIS_SHIFT**2).sqrt()
        return lon, torch.atan2(y, horizontal)

    def project(self, p_cam: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Map points to pixels.

        Returns:
            uv: Pixels; for the full sphere u in [0, width) and v in [0, height].
            valid: False on the vertical axis, where longitude has no value (gradients there are zero), and outside the
                image of a partial sphere.
        """
        check_shape("p_cam", p_cam, "... 3")
        x, _, z = p_cam.unbind(-1)
        valid = x * x + z * z > MIN_HORIZONTAL**2
        uv = self.pixel(torch.where(valid[..., None], p_cam, p_cam.detach()))
        u, v = torch.remainder(uv[..., 0], self._period), uv[..., 1]
        u = torch.where(u >= self._period, u - self._period, u)  # remainder rounds up to the period just below zero
        v = v.clamp(0.0, float(self.height)) if self.wraps else v  # float32 puts a pole just outside the image
        uv = torch.stack([u, v], -1)
        in_view = self.sees(p_cam, uv)
        return uv, valid if in_view is None else valid & in_view

    def sees(
        self, p_cam: Float[Tensor, "*batch 3"], uv: Float[Tensor, "*batch 2"], margin: float = 0.0
    ) -> Bool[Tensor, "*batch"] | None:
        if self.wraps:
            return None
        u, v = uv.unbind(-1)
        return (u >= margin) & (u <= self.width - margin) & (v >= margin) & (v <= self.height - margin)

    def covector_of(
        self,
        ray: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
        g_u: Float[Tensor, "*batch"],
        g_v: Float[Tensor, "*batch"],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        fx, fy, _, _ = self.intrinsics if k is None else k
        x, y, z = ray
        # Nearer to a pole than the first row's centre an interpolated gradient along u no longer shrinks with cos(lat):
        # there 1 / cos(lat) is held at that row's value, or G would grow without bound; G . ray stays 0.
        # Fresh results are written over while they are in the cache; each is mapped by `vmap` where what enters it is.
        horizontal2 = torch.addcmul(x * x, z, z)
        inv_cos_lat = horizontal2.clamp_min(self._least_horizontal2).rsqrt_()
        along_lat = g_v * fy
        radial = (along_lat * y).mul_(inv_cos_lat)
        turn = (g_u * fx * inv_cos_lat).mul_(inv_cos_lat)
        Gx = torch.addcmul(radial * x, turn, z)
        Gz = torch.addcmul(radial * z, turn, x, value=-1)
        return Gx, (along_lat * horizontal2).mul_(inv_cos_lat).neg_(), Gz

    def gradient_of(
        self,
        ray: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
        G: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        fx, fy, _, _ = self.intrinsics if k is None else k
        (x, y, z), (Gx, Gy, Gz) = ray, G
        # d ray / du = (z, 0, -x) / fx and d ray / dv = e_lat / fy. Nearer to a pole than the first row's centre G is
        # held back, and so are these: there they fall to 0 with cos(lat).
        horizontal = torch.addcmul(x * x, z, z).add(AXIS_SHIFT**2).sqrt()
        along_lat = (x * Gx + z * Gz) * (y / horizontal) - horizontal * Gy
        return (z * Gx - x * Gz) / fx, along_lat / fy

    def ray_jacobian_intrinsics(
        self, uv: Float[Tensor, "*batch 2"], k: Intrinsics | None = None
    ) -> Float[Tensor, "*batch 3 4"]:
        fx, fy, _, _ = self.intrinsics if k is None else k
        lon, lat = self._longitude_latitude(uv, k)
        sin_lon, cos_lon, sin_lat, cos_lat = lon.sin(), lon.cos(), lat.sin(), lat.cos()
        d_lon = torch.stack([cos_lat * cos_lon, torch.zeros_like(lon), -cos_lat * sin_lon], -1)
        d_lat = torch.stack([-sin_lat * sin_lon, -cos_lat, -sin_lat * cos_lon], -1)
        by_u, by_v = torch.ones_like(lon) / -fx, torch.ones_like(lat) / -fy
        rates = torch.stack([lon * by_u, lat * by_v, by_u, by_v], -1)
        return torch.stack([d_lon, d_lat, d_lon, d_lat], -1) * rates[..., None, :]

    def pixel_jacobian_point(self, p_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
        fx, fy, _, _ = self.intrinsics
        x, y, z = p_cam.unbind(-1)
        horizontal2 = x * x + z * z
        axis = horizontal2 <= MIN_HORIZONTAL**2
        safe2 = torch.where(axis, 1.0, horizontal2)
        horizontal, range2 = safe2.sqrt(), safe2 + y * y
        zero = torch.zeros_like(x)
        du = torch.stack([z / safe2, zero, -x / safe2], -1) * fx
        dv = torch.stack([x * y / horizontal, -horizontal, y * z / horizontal], -1) * (fy / range2)[..., None]
        return torch.stack([du, dv], -2) * ~axis[..., None, None]

    def pixel_jacobian_intrinsics(self, p_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 4"]:
        lon, lat = self.normalized_of(*p_cam.unbind(-1))
        zero, one = torch.zeros_like(lon), torch.ones_like(lon)
        return torch.stack([torch.stack([lon, zero, one, zero], -1), torch.stack([zero, lat, zero, one], -1)], -2)

    def solid_angle(self, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        fx, fy, _, _ = self.intrinsics
        _, lat = self._longitude_latitude(uv)
        half = 0.5 / abs(fy)
        # exact area of a latitude band of one row, so that the sphere sums to 4 pi
        return lat.cos() * (2 * math.sin(half) / abs(fx))

    def resized(self, width: int, height: int) -> Self:
        fx, fy, cx, cy = self.intrinsics
        if self.wraps and self.cx is None:
            return type(self)(width, height)
        by_u, by_v = width / self.width, height / self.height
        return type(self)(width, height, fx * by_u, fy * by_v, cx * by_u, cy * by_v, self.full)

    def recalibrated(self, fx: float, fy: float, cx: float, cy: float) -> Self:
        return type(self)(self.width, self.height, fx, fy, cx, cy, self.wraps)
