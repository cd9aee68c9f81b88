"""The pinhole: a plane at z = 1 (mathematics.md, section 2)."""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.cameras.base import Camera, Intrinsics
from torchvo360.checks import check_shape

MIN_DEPTH = 1e-12
"""Points nearer to the plane z = 0 than this are behind the camera."""


@dataclass(frozen=True)
class Pinhole(Camera):
    """A perspective camera: `u = fx x / z + cx`, valid in front of it. Rays have z = 1 and `scale` is z.

    The principal point counts from the outer corner: calibrations with pixel centres at integers (OpenCV, TUM, KITTI,
    EuRoC) need 0.5 added to cx and cy where they are read.
    """

    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        return self.fx, self.fy, self.cx, self.cy

    @property
    def wraps(self) -> bool:
        return False

    def ray(self, uv: Float[Tensor, "*batch 2"], k: Intrinsics | None = None) -> Float[Tensor, "*batch 3"]:
        check_shape("uv", uv, "... 2")
        fx, fy, cx, cy = self.intrinsics if k is None else k
        x, y = (uv[..., 0] - cx) / fx, (uv[..., 1] - cy) / fy
        return torch.stack([x, y, torch.ones_like(x)], -1)

    def scale(self, p_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return p_cam[..., 2]

    def scale_of(
        self, x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        return z.clamp_min(MIN_DEPTH)

    def pixel_of(
        self,
        x: Float[Tensor, "*batch"],
        y: Float[Tensor, "*batch"],
        z: Float[Tensor, "*batch"],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        fx, fy, cx, cy = self.intrinsics if k is None else k
        a, b = self.normalized_of(x, y, z)
        return a * fx + cx, b * fy + cy

    def normalized_of(
        self, x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        # Points at or behind the plane z = 0 get a finite pixel, and `sees` refuses them.
        inv_z = z.clamp_min(MIN_DEPTH).reciprocal()
        return x * inv_z, y * inv_z

    def project(self, p_cam: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        check_shape("p_cam", p_cam, "... 3")
        uv = self.pixel(p_cam)
        return uv, self.sees(p_cam, uv)

    def sees(
        self, p_cam: Float[Tensor, "*batch 3"], uv: Float[Tensor, "*batch 2"], margin: float = 0.0
    ) -> Bool[Tensor, "*batch"]:
        u, v = uv.unbind(-1)
        inside = (u >= margin) & (u <= self.width - margin) & (v >= margin) & (v <= self.height - margin)
        return inside & (p_cam[..., 2] > MIN_DEPTH)

    def covector_of(
        self,
        ray: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
        g_u: Float[Tensor, "*batch"],
        g_v: Float[Tensor, "*batch"],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        fx, fy, _, _ = self.intrinsics if k is None else k
        x, y, _ = ray
        Gx, Gy = g_u * fx, g_v * fy
        return Gx, Gy, -(Gx * x + Gy * y)

    def gradient_of(
        self,
        ray: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
        G: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        fx, fy, _, _ = self.intrinsics if k is None else k
        return G[0] / fx, G[1] / fy

    def ray_jacobian_intrinsics(
        self, uv: Float[Tensor, "*batch 2"], k: Intrinsics | None = None
    ) -> Float[Tensor, "*batch 3 4"]:
        fx, fy, _, _ = self.intrinsics if k is None else k
        x, y, one = self.ray(uv, k).unbind(-1)
        zero = torch.zeros_like(x)
        return torch.stack(
            [
                torch.stack([-x / fx, zero, -one / fx, zero], -1),
                torch.stack([zero, -y / fy, zero, -one / fy], -1),
                torch.stack([zero, zero, zero, zero], -1),
            ],
            -2,
        )

    def pixel_jacobian_point(self, p_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
        x, y, z = p_cam.unbind(-1)
        ahead = z > MIN_DEPTH
        inv_z = torch.where(ahead, z, 1.0).reciprocal() * ahead
        zero = torch.zeros_like(x)
        du = torch.stack([inv_z, zero, -x * inv_z * inv_z], -1) * self.fx
        dv = torch.stack([zero, inv_z, -y * inv_z * inv_z], -1) * self.fy
        return torch.stack([du, dv], -2)

    def pixel_jacobian_intrinsics(self, p_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 4"]:
        x, y, z = p_cam.unbind(-1)
        ahead = z > MIN_DEPTH
        inv_z = torch.where(ahead, z, 1.0).reciprocal() * ahead
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        return torch.stack(
            [torch.stack([x * inv_z, zero, one, zero], -1), torch.stack([zero, y * inv_z, zero, one], -1)], -2
        )

    def solid_angle(self, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        length = torch.linalg.vector_norm(self.ray(uv), dim=-1)
        return 1 / (abs(self.fx * self.fy) * length**3)

    def recalibrated(self, fx: float, fy: float, cx: float, cy: float) -> Self:
        return type(self)(self.width, self.height, fx, fy, cx, cy)

    def resized(self, width: int, height: int) -> Self:
        by_u, by_v = width / self.width, height / self.height
        return type(self)(width, height, self.fx * by_u, self.fy * by_v, self.cx * by_u, self.cy * by_v)
