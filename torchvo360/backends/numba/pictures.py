"""What is done to whole images, compiled where numba serves: levels, the strength of gradients, selection."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from torchvo360.backends.numba.arrays import plain
from torchvo360.backends.numba.images import can_see
from torchvo360.backends.numba.kernel import kernel
from torchvo360.backends.select import use_numba
from torchvo360.cameras import Camera, Pinhole, check_image_size
from torchvo360.image import gradient_magnitude, pad_image, resample, selection
from torchvo360.residuals.direct import Target


def padded_levels(
    grey: UInt8[np.ndarray, "H W"], cameras: Sequence[Camera], blur_px: float, device: torch.device
) -> list[Float[Tensor, "1 1 Hp Wp"]]:
    """Return an image's levels in [0, 1], smoothed once and padded by one pixel for look-up.

    Args:
        grey: The image, 8 bits.
        cameras: Of the levels, the finest first.
        blur_px: Standard deviation of the smoothing, pixels of the finest level.
        device: Where they are to lie.
    """
    margin = max(1, round(3 * blur_px)) if blur_px > 0 else 0
    if device.type != "cpu" or not use_numba() or margin > min(grey.shape):
        return _padded_levels(_smoothed(grey, cameras[0], blur_px, margin).to(device), cameras)
    passes = kernel("pictures")
    taps = cv2.getGaussianKernel(2 * margin + 1, blur_px, cv2.CV_32F)[:, 0] if margin else np.ones(1, np.float32)
    out: list[Tensor] = []
    for camera in cameras:
        padded = torch.empty(1, 1, camera.height + 2, camera.width + 2)
        array = padded.numpy()[0, 0]
        if not out:
            passes.smooth(np.ascontiguousarray(grey), taps, camera.wraps, array)
        elif out[-1].shape[-2:] == (2 * camera.height + 2, 2 * camera.width + 2):
            passes.halve(out[-1].numpy()[0, 0], array)
        else:
            padded[..., 1:-1, 1:-1] = resample(out[-1][..., 1:-1, 1:-1], camera)
        passes.edge(array, camera.wraps)
        out.append(padded)
    return out


def _smoothed(grey: UInt8[np.ndarray, "H W"], camera: Camera, blur_px: float, margin: int) -> Float[Tensor, "H W"]:
    """Return the image in [0, 1], smoothed by OpenCV, which is fifteen times faster here than a convolution."""
    level = torch.from_numpy(grey.astype(np.float32) * np.float32(1 / 255))
    if margin == 0:
        return level
    wide = pad_image(level, camera, margin).numpy()
    smooth = cv2.GaussianBlur(wide, (2 * margin + 1, 2 * margin + 1), blur_px)
    return torch.from_numpy(np.ascontiguousarray(smooth[margin:-margin, margin:-margin]))


def _padded_levels(level: Float[Tensor, "H W"], cameras: Sequence[Camera]) -> list[Float[Tensor, "1 1 Hp Wp"]]:
    out = []
    for camera in cameras:
        level = resample(level, camera)
        out.append(pad_image(level[None, None], camera, 1).contiguous())
    return out


def gradient_strength(target: Target, rays: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Return `image.gradient_magnitude` of one image (batch 1) of one channel.

    Args:
        target: The image.
        rays: Its camera's `ray_grid`.
    """
    if not can_see(target):
        return gradient_magnitude(target.padded[0, 0, 1:-1, 1:-1], target.camera, rays)
    out = torch.empty(target.camera.height, target.camera.width)
    kernel("pictures").gradient_strength(plain(target.padded[0, 0]), *_covector_weights(target.camera), out.numpy())
    return out


def _covector_weights(camera: Camera) -> tuple[np.ndarray, ...]:
    """Return the weights of a squared gradient by row and by column, as the compiled pass has them.

    On a sphere the covector's parts along the parallel and the meridian are at right angles; on a pinhole's plane
    G = (G_x, G_y, -x G_x - y G_y).
    """
    fx, fy, cx, cy = camera.intrinsics
    b = (np.arange(camera.height) + 0.5 - cy) / fy
    by_v = np.full(camera.height, (fy * camera.pixel_angle) ** 2)
    if isinstance(camera, Pinhole):
        x = (np.arange(camera.width) + 0.5 - cx) / fx * (fx * camera.pixel_angle)
        parts = np.ones_like(b), by_v, x, b * (fy * camera.pixel_angle)
    else:
        cos2 = np.cos(b) ** 2
        held2 = np.maximum(cos2, math.sin(0.5 / fy) ** 2)
        parts = cos2 / held2**2, by_v * cos2 / held2, np.zeros(camera.width), np.zeros_like(b)
    by_u, by_v, x, y = (part.astype(np.float32) for part in parts)
    return by_u, by_v, x, y


def select_pixels(
    strength: Float[Tensor, "H W"], usable: Bool[Tensor, "H W"], camera: Camera, count: int, *, minimum: float
) -> Int64[Tensor, "N"]:
    """Choose the strongest usable pixel of each cell as `image.select_pixels` does."""
    if not use_numba(strength, usable) or strength.dtype != torch.float32 or not minimum > 0:
        return selection.select_pixels(strength, usable, camera, count, minimum=minimum)
    check_image_size("strength", strength, camera)
    check_image_size("usable", usable, camera)
    first, cells = selection.equal_area_rows(camera, count)
    total = int((first + cells).max())
    most, pixel = np.full(total, -1, np.int32), torch.full((total,), -1)
    bits = plain(strength).view(np.int32), plain(usable), np.array(minimum, np.float32).view(np.int32)[()]
    kernel("pictures").strongest(*bits, first.numpy(), cells.numpy(), most, pixel.numpy())
    return pixel[pixel >= 0].sort().values
