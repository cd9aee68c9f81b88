"""Image pyramids: each level is half as large, so that a pixel at uv lies at uv / 2 (mathematics.md, section 1)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.image.padding import pad_image

SMALL_PLANE = 2**16
"""Pixels of an image below which torch convolves one alone in another way than several."""


def blur(image: Float[Tensor, "*batch H W"], camera: Camera, sigma_px: float) -> Float[Tensor, "*batch H W"]:
    """Smooth by a Gaussian of `sigma_px` pixels, around the seam and over the poles; 0 leaves the image as it is."""
    if sigma_px <= 0:
        return image
    from kornia.filters import get_gaussian_kernel1d  # here: a run of the odometry starts faster without

    radius = blur_radius(sigma_px)
    kernel = get_gaussian_kernel1d(2 * radius + 1, sigma_px, dtype=image.dtype, device=image.device)[0]
    padded = pad_image(image, camera, radius).reshape(-1, 1, camera.height + 2 * radius, camera.width + 2 * radius)
    alone = len(padded) == 1 and padded.numel() < SMALL_PLANE
    # A small image alone takes another path in torch, and comes out with other last digits: let it have company.
    vertical = F.conv2d(padded.expand(2, -1, -1, -1) if alone else padded, kernel.reshape(1, 1, -1, 1))
    smooth = F.conv2d(vertical, kernel.reshape(1, 1, 1, -1))
    return (smooth[:1] if alone else smooth).reshape(image.shape)


def blur_radius(sigma_px: float) -> int:
    """Return how many pixels `blur` reaches to each side."""
    return max(1, round(3 * sigma_px)) if sigma_px > 0 else 0


def level_camera(camera: Camera, level: int) -> Camera:
    """Return the camera of a pyramid level; sizes are rounded to even ones, which a panorama's poles need."""
    if level == 0:
        return camera
    width = 2 * max(1, round(camera.width / 2 ** (level + 1)))
    height = max(1, round(camera.height / 2**level))
    return camera.resized(width, height)


def resample(image: Float[Tensor, "*batch H W"], camera: Camera) -> Float[Tensor, "*batch h w"]:
    """Return the image at a level camera's size, by means over the whole pixels that each new pixel touches."""
    height, width = image.shape[-2:]
    flat = image.reshape(-1, 1, height, width)
    if (height, width) == (camera.height, camera.width):
        small = flat
    elif height == 2 * camera.height and width == 2 * camera.width:
        small = F.avg_pool2d(flat, 2)
    else:
        small = F.interpolate(flat, (camera.height, camera.width), mode="area")
    return small.reshape(*image.shape[:-2], camera.height, camera.width)


def pyramid(
    image: Float[Tensor, "*batch H W"], camera: Camera, levels: int
) -> list[tuple[Camera, Float[Tensor, "*batch h w"]]]:
    """Return (camera, image) of each level, the finest first."""
    out = [(camera, image)]
    for level in range(1, levels):
        smaller = level_camera(camera, level)
        out.append((smaller, resample(out[-1][1], smaller)))
    return out


def masked_pyramid(
    value: Float[Tensor, "*batch H W"], known: Bool[Tensor, "*batch H W"], cameras: Sequence[Camera]
) -> list[tuple[Float[Tensor, "*batch h w"], Bool[Tensor, "*batch h w"]]]:
    """Return (mean of the known values, where at least half of the area is known) at each camera's size.

    Args:
        value: May be anything where it is not known.
        known: Where it counts.
        cameras: Each of the size of the one before or smaller.
    """
    share = known.to(value.dtype)
    total = torch.where(known, value, 0.0)
    out: list[tuple[Tensor, Tensor]] = []
    for camera in cameras:
        share, total = resample(share, camera), resample(total, camera)
        out.append((total / share.clamp_min(1e-6), share >= 0.5))
    return out
