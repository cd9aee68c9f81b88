"""Images as compiled passes take them: a target's arrays and numbers."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.backends.numba.arrays import optics_of, plain
from torchvo360.backends.numba.kernel import kernel
from torchvo360.backends.select import use_numba
from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.residuals import direct
from torchvo360.residuals.direct import Target

NO_CONFIDENCE = np.empty((0, 0), np.float32)

ImageView = tuple[np.ndarray, np.ndarray, np.ndarray, int, np.float32, bool, bool, np.float32]
"""As `kernels.sight.see` has it."""


def can_see(*targets: Target, also: tuple[Tensor, ...] = ()) -> bool:
    """Return whether compiled passes may look up these images, with these further tensors: float32 on the CPU."""
    tensors = [*also, *(part for target in targets for part in (target.padded, target.confidence) if part is not None)]
    return (
        use_numba(*tensors)
        and all(type(target.camera) in (Equirectangular, Pinhole) for target in targets)
        and all(tensor.dtype == torch.float32 for tensor in tensors)
    )


def image_view(target: Target, *, usable: bool = True) -> ImageView:
    """Return one image (batch 1) of one channel for `see`.

    Args:
        target: The image.
        usable: Whether only what is usable is to be seen; else all, and out of view the nearest edge.
    """
    camera = target.camera
    kind, wraps, wrap_again, _ = optics_of(target)
    confidence = NO_CONFIDENCE
    if usable and target.confidence is not None:
        confidence = plain(target.confidence[0, 0])
    saturation = np.float32(target.saturation if usable and target.saturation is not None else np.inf)
    k = np.array(camera.intrinsics, np.float32)
    period = np.float32(camera.width if wraps else abs(camera.intrinsics[0]) * math.tau)
    return plain(target.padded[0, 0]), confidence, k, kind, period, wrap_again, usable and not wraps, saturation


def look_up_usable(target: Target, ray: Float[Tensor, "3 *points"]) -> Float[Tensor, "*points"]:
    """Look up as `residuals.direct.look_up_usable` does, compiled where numba serves."""
    if not can_see(target, also=(ray,)):
        return direct.look_up_usable(target, ray)
    return _look_up(image_view(target), ray)


def look_up_value(target: Target, ray: Float[Tensor, "3 *points"]) -> Float[Tensor, "*points"]:
    """Look up as `residuals.direct.look_up_value` does, compiled where numba serves."""
    if not can_see(target, also=(ray,)):
        return direct.look_up_value(target, ray)
    return _look_up(image_view(target, usable=False), ray)


def _look_up(view: ImageView, ray: Float[Tensor, "3 *points"]) -> Float[Tensor, "*points"]:
    out = ray.new_empty(ray.shape[1:])
    kernel("sight").see_rays(plain(ray).reshape(3, -1), view, out.numpy().reshape(-1))
    return out
