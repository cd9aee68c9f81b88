"""The image gradient as a covector field on the rays (mathematics.md, section 3)."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.image.padding import pad_image


def gradient(
    image: Float[Tensor, "*batch H W"], camera: Camera
) -> tuple[Float[Tensor, "*batch H W"], Float[Tensor, "*batch H W"]]:
    """Return central differences along u and v, per pixel, around the seam and over the poles."""
    padded = pad_image(image, camera, 1)
    g_u = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) * 0.5
    g_v = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) * 0.5
    return g_u, g_v


def covector_field(
    image: Float[Tensor, "*batch H W"], camera: Camera, rays: Float[Tensor, "H W 3"] | None = None
) -> Float[Tensor, "*batch 3 H W"]:
    """Return G at every pixel's centre, from central differences: `dI = G . d(ray)`, `G . ray = 0`.

    Args:
        image: Values at the camera's pixels.
        camera: The image's camera.
        rays: `camera.ray_grid()`, where it is at hand already.
    """
    rays = camera.ray_grid(dtype=image.dtype, device=image.device) if rays is None else rays
    x, y, z = rays.unbind(-1)
    return torch.stack(camera.covector_of((x, y, z), *gradient(image, camera)), -3)


def gradient_magnitude(
    image: Float[Tensor, "*batch H W"], camera: Camera, rays: Float[Tensor, "H W 3"] | None = None
) -> Float[Tensor, "*batch H W"]:
    """Return |G| in intensity per pixel of the image's middle: equally strong edges are equal at every latitude."""
    Gx, Gy, Gz = covector_field(image, camera, rays).unbind(-3)
    return (Gx * Gx + Gy * Gy + Gz * Gz).sqrt() * camera.pixel_angle
