"""Two images compared at given poses in one compiled pass: their agreement, and their brightness."""

import math

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.backends.numba.linearize import as_arrays, kernel
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.weights import LossConfig


def gradient_energy(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    tolerance_px: float,
) -> Float64[Tensor, "B 3"]:
    """Return each pair's gradient energy, what of it the reference explains, and what its channels' means would.

    Args:
        reference: Points, with `target`, `T_tgt_ref` and `affine` as `linearize` takes them.
        target: Images.
        T_tgt_ref: Poses.
        affine: (a, b).
        tolerance_px: The displacement along the gradient that explains a residual.
    """
    sums = np.zeros((len(T_tgt_ref), 3))
    tolerance = np.float32(tolerance_px * target.camera.pixel_angle)
    kernel("agreement").sum_agreement(*_arrays(reference, target, T_tgt_ref, affine), tolerance**2, sums)
    return torch.from_numpy(sums)


def brightness_moments(
    reference: Reference, target: Target, T_tgt_ref: Float[Tensor, "B 4 4"]
) -> Float64[Tensor, "B 4"]:
    """Return mean and variance of each target where its reference's points come to lie, and those of the points.

    Args:
        reference: Points, with `target` and `T_tgt_ref` as `linearize` takes them.
        target: Images.
        T_tgt_ref: Poses.
    """
    moments = np.zeros((len(T_tgt_ref), 4))
    affine = T_tgt_ref.new_zeros(len(T_tgt_ref), 2)
    kernel("agreement").measure_brightness(*_arrays(reference, target, T_tgt_ref, affine), moments)
    return torch.from_numpy(moments)


def _arrays(reference: Reference, target: Target, T_tgt_ref: Tensor, affine: Tensor) -> tuple:
    saturation = math.inf if target.saturation is None else target.saturation
    return *as_arrays(reference, target, T_tgt_ref, affine, LossConfig(), 1.0)[:6], np.float32(saturation)
