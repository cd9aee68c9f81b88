"""`compare` on the compiled pass, and sums over what it would give."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.backends.comparison import Comparison
from torchvo360.backends.numba.arrays import ANY_LOSS, as_arrays
from torchvo360.backends.numba.kernel import kernel
from torchvo360.residuals.direct import Reference, Target


def compare(
    reference: Reference, target: Target, T_tgt_ref: Float[Tensor, "B 4 4"], affine: Float[Tensor, "B 2"]
) -> Comparison:
    """Compare as `backends.comparison.compare` does, in one pass; the arguments must be what `serves` says."""
    out = np.empty((len(T_tgt_ref), 4, *reference.value.shape[1:]), np.float32)
    kernel("samples").sample_pairs(*_arrays(reference, target, T_tgt_ref, affine), out)
    return Comparison(*torch.from_numpy(out).unbind(1))


def explained_energy(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    tolerance_px: float,
) -> Float64[Tensor, "B 3"]:
    """Return each pair's gradient energy, what of it the reference explains, and what its channels' means would.

    Args:
        reference: Points, with `target`, `T_tgt_ref` and `affine` as `compare` takes them.
        target: Images.
        T_tgt_ref: Poses.
        affine: (a, b) of each pair.
        tolerance_px: The displacement along the gradient that explains a residual.
    """
    sums = np.zeros((len(T_tgt_ref), 3))
    arrays = _arrays(reference, target, T_tgt_ref, affine)
    kernel("summaries").explain_pairs(*arrays, np.float32(tolerance_px**2), sums)
    return torch.from_numpy(sums)


def brightness_moments(
    reference: Reference, target: Target, T_tgt_ref: Float[Tensor, "B 4 4"]
) -> Float64[Tensor, "B 4"]:
    """Return mean and variance of each target where its reference's points come to lie, and those of the points.

    Args:
        reference: Points, with `target` and `T_tgt_ref` as `compare` takes them.
        target: Images.
        T_tgt_ref: Poses.
    """
    moments = np.zeros((len(T_tgt_ref), 4))
    arrays = _arrays(reference, target, T_tgt_ref, T_tgt_ref.new_zeros(len(T_tgt_ref), 2))
    kernel("summaries").measure_pairs(*arrays, moments)
    return torch.from_numpy(moments)


def _arrays(reference: Reference, target: Target, T_tgt_ref: Tensor, affine: Tensor) -> tuple[Any, ...]:
    """Return what the kernels take but for their last arguments."""
    *arguments, loss = as_arrays(reference, target, T_tgt_ref, affine, ANY_LOSS, 1.0)
    return *arguments, loss[-2], np.float32(target.camera.pixel_angle**2)
