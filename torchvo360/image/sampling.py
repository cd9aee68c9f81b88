"""Bilinear look-up of images at continuous pixels, around the seam and over the poles.

Two ways. `sample` is torch's grid sampling, for whole images. `interpolate` serves the hot kernel: it gathers the four
neighbours by one flat index and returns the value with the exact derivative of the bilinear interpolant. That costs a
fifth of grid sampling value and gradient as four channels, and is consistent with autograd (docs/decisions.md).
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.checks import check_shape
from torchvo360.image.padding import pad_image

MAX_EXACT_FLOAT32 = 2**24
"""Integers up to here are exact in float32, so that an index may be computed in floating point, which is faster."""


def sample(
    image: Float[Tensor, "B C H W"], uv: Float[Tensor, "B *points 2"], camera: Camera
) -> Float[Tensor, "B C *points"]:
    """Look up an image at continuous pixels.

    Args:
        image: Values at the camera's pixels.
        uv: Pixels; u of a full panorama may be any number.
        camera: The image's camera.

    Returns:
        Bilinear values; beyond the edge of a camera that does not wrap, the edge's.
    """
    check_shape("image", image, f"B C {camera.height} {camera.width}")
    check_shape("uv", uv, "... 2")
    u, v = uv.unbind(-1)
    if camera.wraps:
        u = torch.remainder(u, camera.width)
    size = uv.new_tensor([camera.width + 2, camera.height + 2])
    grid = (torch.stack([u, v], -1) + 1) * (2 / size) - 1
    flat = F.grid_sample(
        pad_image(image, camera, 1), grid.flatten(1, -2)[:, None], padding_mode="border", align_corners=False
    )
    return flat[:, :, 0].unflatten(-1, uv.shape[1:-1]) if uv.ndim != 3 else flat[:, :, 0]


class Interpolated(NamedTuple):
    """A value and its derivative by u and v, per pixel, each [B, C, N]."""

    value: Float[Tensor, "B C N"]
    g_u: Float[Tensor, "B C N"]
    g_v: Float[Tensor, "B C N"]


class Taps(NamedTuple):
    """Where samples lie in padded images: flat indices of their upper left corners, and the fractions beyond."""

    corner: Tensor
    across: Float[Tensor, "B N"]
    down: Float[Tensor, "B N"]
    pitch: int


def locate(u: Float[Tensor, "B N"], v: Float[Tensor, "B N"], camera: Camera) -> Taps:
    """Find the four neighbours of pixels in images padded by one pixel; pixels outside are moved to the edge."""
    pitch = camera.width + 2
    column, row = (u + 0.5).clamp(0.0, camera.width + 0.5), (v + 0.5).clamp(0.0, camera.height + 0.5)
    left, top = column.detach().floor(), row.detach().floor()
    if pitch * (camera.height + 2) < MAX_EXACT_FLOAT32:
        index = torch.add(left, top, alpha=float(pitch)).long()
    else:
        index = torch.add(left.long(), top.long(), alpha=pitch)
    if u.shape[0] > 1:
        images = torch.arange(u.shape[0], device=u.device) * (pitch * (camera.height + 2))
        index = index + images[:, None]
    return Taps(index, column - left, row - top, pitch)


def _corners(padded: Float[Tensor, "B C Hp Wp"], taps: Taps) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    B, C, height, _ = padded.shape
    index = taps.corner
    if C > 1:
        area = height * taps.pitch
        images = torch.arange(B, device=index.device)[:, None, None] * ((C - 1) * area)
        index = index[:, None] + images + torch.arange(C, device=index.device)[:, None] * area
    flat, shape = padded.reshape(-1), (B, C, taps.corner.shape[-1])
    index = index.reshape(-1)
    # Shifted views share one index: cheaper than three more index tensors.
    upper_left, upper_right, lower_left, lower_right = (
        flat[shift:].index_select(0, index).view(shape) for shift in (0, 1, taps.pitch, taps.pitch + 1)
    )
    return upper_left, upper_right, lower_left, lower_right


def interpolate(padded: Float[Tensor, "B C Hp Wp"], taps: Taps) -> Interpolated:
    """Return bilinear values with the exact derivative of the interpolant.

    Args:
        padded: Images padded by one pixel (`pad_image`), contiguous.
        taps: From `locate`.
    """
    upper_left, upper_right, lower_left, lower_right = _corners(padded, taps)
    across, down = taps.across[:, None], taps.down[:, None]
    upper_slope, lower_slope = upper_right - upper_left, lower_right - lower_left
    upper = torch.addcmul(upper_left, across, upper_slope)
    lower = torch.addcmul(lower_left, across, lower_slope)
    g_v = lower - upper
    return Interpolated(torch.addcmul(upper, down, g_v), torch.lerp(upper_slope, lower_slope, down), g_v)
