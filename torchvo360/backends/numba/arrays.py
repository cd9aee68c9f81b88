"""What compiled passes take: tensors as arrays, cameras and losses as numbers."""

import functools
import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.cameras import Pinhole
from torchvo360.checks import ShapeError, check_shape
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.weights import LOSSES, LossConfig, robust

SPHERE, PINHOLE = 0, 1
"""As in `kernels.scratch`, which cannot be imported without numba."""

NOTHING = np.empty((1, 0), np.float32), np.empty((1, 0, 0, 0), np.float32)
"""Stand-ins for variances and confidences that are not there."""

ANY_LOSS = LossConfig()
"""For passes that weigh nothing."""


def as_arrays(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    loss: LossConfig,
    noise: float,
) -> tuple[Any, ...]:
    """Return what `linearize` takes as the arguments of `kernels.pairs.sum_pairs`, but for the number of threads.

    Raises:
        ShapeError: Shapes do not belong together.
    """
    _check_shapes(reference, target, T_tgt_ref, affine)
    points = tuple(_array(x) for x in (reference.ray, reference.rho, reference.value, reference.weight))
    variance = NOTHING[0] if reference.variance is None else _array(reference.variance)
    confidence = NOTHING[1] if target.confidence is None else _array(target.confidence)
    return (
        (*points, variance),
        (_array(target.padded), confidence),
        plain(T_tgt_ref.double()),
        plain(affine.double()),
        intrinsics_of(target),
        optics_of(target),
        loss_of(loss, target.saturation, noise),
    )


def plain(value: Tensor) -> np.ndarray:
    """Return a contiguous array."""
    return value.contiguous().numpy(force=True)


def _array(value: Tensor) -> np.ndarray:
    """Return a contiguous array; of what is expanded over the batch, its one element."""
    if value.stride(0) == 0:
        value = value[:1]
    return plain(value)


def intrinsics_of(target: Target) -> np.ndarray:
    """Return (fx, fy, cx, cy) of each target, or the ones that all share."""
    if target.intrinsics is None:
        return np.array([target.camera.intrinsics], np.float32)
    return _array(target.intrinsics)


def optics_of(target: Target) -> tuple[int, bool, bool, np.float32]:
    """Return how the passes project: see `kernels.pairs.sum_pairs`."""
    camera = target.camera
    if isinstance(camera, Pinhole):
        return PINHOLE, False, False, np.float32(0)
    _, fy, cx, _ = camera.intrinsics
    centred = target.intrinsics is None and camera.wraps and cx == camera.width / 2
    return SPHERE, camera.wraps, not centred, np.float32(math.sin(0.5 / fy) ** 2)


def loss_of(loss: LossConfig, saturation: float | None, noise: float) -> tuple[int | np.float32, ...]:
    """Return a loss as kernels take it: kind, scale, degrees of freedom, cut-off, cost there, saturation, noise."""
    kind, *numbers = _robust(loss.name, loss.scale, loss.degrees_of_freedom, loss.cutoff)
    return (kind, *numbers, np.float32(math.inf if saturation is None else saturation), np.float32(noise))


@functools.lru_cache
def _robust(name: str, scale: float, freedom: float, cutoff: float | None) -> tuple[int | np.float32, ...]:
    """Return a loss by its number, scale, degrees of freedom, cut-off and the cost there."""
    end, most = math.inf, math.inf
    if cutoff is not None:
        loss = LossConfig(name=name, scale=scale, degrees_of_freedom=freedom, cutoff=cutoff)
        end, most = cutoff, float(robust(torch.tensor(cutoff), loss)[1])
    return (LOSSES.index(name), *(np.float32(number) for number in (scale, freedom, end, most)))


def _check_shapes(reference: Reference, target: Target, T_tgt_ref: Tensor, affine: Tensor) -> None:
    """Refuse shapes that do not belong together: the compiled pass would read foreign memory."""
    check_shape("reference.value", reference.value, "B C N")
    B, (C, N) = T_tgt_ref.shape[0], reference.value.shape[1:]
    height, width = target.camera.height + 2, target.camera.width + 2
    expected: tuple[tuple[str, Tensor | None, tuple[int, ...]], ...] = (
        ("T_tgt_ref", T_tgt_ref, (4, 4)),
        ("affine", affine, (2,)),
        ("reference.ray", reference.ray, (3, N)),
        ("reference.rho", reference.rho, (N,)),
        ("reference.value", reference.value, (C, N)),
        ("reference.weight", reference.weight, (N,)),
        ("reference.variance", reference.variance, (N,)),
        ("target.padded", target.padded, (C, height, width)),
        ("target.confidence", target.confidence, (1, height, width)),
        ("target.intrinsics", target.intrinsics, (4,)),
    )
    for name, value, shape in expected:
        if value is not None and (value.shape[1:] != shape or value.shape[0] not in (B, 1)):
            raise ShapeError(f"{name}: expected shape {[B, *shape]}, got {list(value.shape)}.")
    if affine.shape[0] != B:
        raise ShapeError(f"affine: expected shape {[B, 2]}, got {list(affine.shape)}.")
