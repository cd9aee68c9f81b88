"""The contract of a central camera: one kernel serves whatever fulfils it (mathematics.md, sections 1 to 3).

Pixels are continuous with the image's outer corner as origin and centres at +0.5. The camera frame has x right, y down,
z forward. A ray is a point with range 1 in the camera's own measure: `scale(ray) == 1`.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from numbers import Integral
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.checks import InputError, check_finite_number, check_shape

Intrinsics = tuple[float | Tensor, float | Tensor, float | Tensor, float | Tensor]
"""fx, fy, cx, cy in pixels: numbers, or tensors that broadcast with the points."""


@dataclass(frozen=True)
class Camera(ABC):
    """A central camera with intrinsics k = (fx, fy, cx, cy), in pixels.

    Every point below is in the camera frame; functions take any batch shape. Rays and points are given on the last
    axis, which need not be the contiguous one. Where a function takes k, it stands in for the camera's own intrinsics
    and carries gradients; whether the image wraps and how large it is stays the camera's.
    """

    width: int
    height: int

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if not isinstance(size, Integral) or isinstance(size, bool) or size < 1:
                raise InputError(f"{name}: expected a positive integer, got {size!r}.")
        for name, value in zip(("fx", "fy", "cx", "cy"), self.intrinsics, strict=True):
            check_finite_number(name, value)
            if name in ("fx", "fy") and value == 0:
                raise InputError(f"{name}: expected a focal length other than zero, got 0.")

    @property
    @abstractmethod
    def intrinsics(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) in pixels."""

    @property
    @abstractmethod
    def wraps(self) -> bool:
        """Whether column 0 is the last one's neighbour and the poles lie on the top and bottom edges."""

    @abstractmethod
    def ray(self, uv: Float[Tensor, "*batch 2"], k: Intrinsics | None = None) -> Float[Tensor, "*batch 3"]:
        """Return the ray of a pixel: a point with `scale(ray) == 1`."""

    @abstractmethod
    def scale(self, p_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Return a point's range in this camera's measure; its inverse is the point's rho."""

    @abstractmethod
    def scale_of(
        self, x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Return `scale` from components, for the hot path: kept from zero, so that its inverse is finite."""

    @abstractmethod
    def pixel_of(
        self,
        x: Float[Tensor, "*batch"],
        y: Float[Tensor, "*batch"],
        z: Float[Tensor, "*batch"],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Return u and v of a point: the bare formula, without seam handling or validity, for the hot path.

        Components come and go apart because stacking them costs more than the formula.
        """

    def pixel_and_inverse_scale_of(
        self,
        x: Float[Tensor, "*batch"],
        y: Float[Tensor, "*batch"],
        z: Float[Tensor, "*batch"],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Return `pixel_of` and the inverse of `scale_of`, for cameras whose formulas share their terms."""
        return *self.pixel_of(x, y, z, k), self.scale_of(x, y, z).reciprocal()

    @abstractmethod
    def normalized_of(
        self, x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Return a point's normalised coordinates, `(u - cx) / fx` and `(v - cy) / fy`; finite everywhere."""

    @abstractmethod
    def covector_of(
        self,
        ray: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
        g_u: Float[Tensor, "*batch"],
        g_v: Float[Tensor, "*batch"],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Return the three components of `covector`, for the hot path."""

    @abstractmethod
    def gradient_of(
        self,
        ray: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
        G: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
        k: Intrinsics | None = None,
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Return g_u and g_v of a covector on its ray: what `covector_of` was given, where that is exact."""

    def pixel(self, p_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Return the pixel of a point without seam handling or validity; finite everywhere."""
        x, y, z = p_cam.unbind(-1)
        return torch.stack(self.pixel_of(x, y, z), -1)

    @abstractmethod
    def project(self, p_cam: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Map points to pixels.

        Args:
            p_cam: Points; any positive multiple gives the same pixel.

        Returns:
            uv: Pixels; finite everywhere.
            valid: Whether the point is seen: False outside the image and where the pixel has no value.
        """

    @abstractmethod
    def sees(
        self, p_cam: Float[Tensor, "*batch 3"], uv: Float[Tensor, "*batch 2"], margin: float = 0.0
    ) -> Bool[Tensor, "*batch"] | None:
        """Return which points with pixels uv lie in view and `margin` pixels inside the image; None when all do."""

    def covector(self, ray: Float[Tensor, "*batch 3"], g_uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
        """Return the image gradient as G on the ray: `dI = G . d(ray)` with `G . ray == 0` (mathematics.md, section 3).

        Args:
            ray: Rays of this camera.
            g_uv: Gradient of a value by u and v, per pixel.
        """
        x, y, z = ray.unbind(-1)
        return torch.stack(self.covector_of((x, y, z), g_uv[..., 0], g_uv[..., 1]), -1)

    @abstractmethod
    def ray_jacobian_intrinsics(
        self, uv: Float[Tensor, "*batch 2"], k: Intrinsics | None = None
    ) -> Float[Tensor, "*batch 3 4"]:
        """Return d ray / d (fx, fy, cx, cy) at a fixed pixel."""

    def unit_ray_jacobian_intrinsics(
        self, uv: Float[Tensor, "*batch 2"], k: Intrinsics | None = None
    ) -> Float[Tensor, "*batch 3 4"]:
        """Return d (ray / |ray|) / d (fx, fy, cx, cy) at a fixed pixel: `(I - r r^T) J / |ray|` with r the unit ray.

        It serves points held by unit rays and inverse distance, whatever measure the camera has.
        """
        ray, J_ray_k = self.ray(uv, k), self.ray_jacobian_intrinsics(uv, k)
        inv_length = torch.linalg.vector_norm(ray, dim=-1).reciprocal()[..., None, None]
        unit = ray[..., None] * inv_length
        return (J_ray_k - unit * (unit.mT @ J_ray_k)) * inv_length

    @abstractmethod
    def pixel_jacobian_point(self, p_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
        """Return d pixel / d point; zero where the pixel has no derivative."""

    @abstractmethod
    def pixel_jacobian_intrinsics(self, p_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 4"]:
        """Return d pixel / d (fx, fy, cx, cy) at a fixed point."""

    @abstractmethod
    def solid_angle(self, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Return the solid angle of one pixel at uv, in steradians."""

    @abstractmethod
    def resized(self, width: int, height: int) -> Self:
        """Return the same camera for an image resampled to another size, such as a pyramid level."""

    @abstractmethod
    def recalibrated(self, fx: float, fy: float, cx: float, cy: float) -> Self:
        """Return the camera with other intrinsics; whether its image wraps stays as it is."""

    @property
    def pixel_angle(self) -> float:
        """The angle between neighbouring pixels in the middle of the image, in radians."""
        return 1.0 / abs(self.intrinsics[0])

    def pixel_grid(
        self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> Float[Tensor, "H W 2"]:
        """Return every pixel's centre."""
        u = torch.arange(self.width, dtype=dtype, device=device) + 0.5
        v = torch.arange(self.height, dtype=dtype, device=device) + 0.5
        return torch.stack([u.expand(self.height, -1), v[:, None].expand(-1, self.width)], -1)

    def ray_grid(
        self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> Float[Tensor, "H W 3"]:
        """Return the ray of every pixel's centre, computed in float64."""
        return self.ray(self.pixel_grid(dtype=torch.float64, device=device)).to(dtype)


def check_image_size(name: str, image: Tensor, camera: Camera) -> None:
    """Refuse an image [..., H, W] whose size is not the camera's.

    Raises:
        ShapeError: The sizes differ.
    """
    check_shape(name, image, f"... {camera.height} {camera.width}")
