"""Normalised cross-correlation under many rotations as one compiled pass."""

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.backends.numba.arrays import ANY_LOSS, NOTHING, as_arrays
from torchvo360.backends.numba.kernel import kernel
from torchvo360.residuals.direct import Reference, Target


def correlate_rotations(
    reference: Reference, target: Target, T_tgt_ref: Float64[Tensor, "M 4 4"]
) -> Float64[Tensor, "M"]:
    """Return how alike one target and one reference are, for each of some rotations.

    Args:
        reference: Points of one channel at infinity, of which the weights count; as `serves` takes them.
        target: The image, of a camera that wraps; what it is unsure of counts like all else.
        T_tgt_ref: The rotations, as poses.
    """
    affine = T_tgt_ref.new_zeros(1, 2)
    points, images, _, _, k, optics, _ = as_arrays(reference, target, T_tgt_ref[:1], affine, ANY_LOSS, 1.0)
    ray, rho, value, weight = (part[0] for part in points[:4])
    weight = weight / max(float(weight.sum()), 1e-9)
    centred = value[0] - (weight * value[0]).sum()
    out = np.empty(len(T_tgt_ref))
    T = T_tgt_ref.contiguous().numpy()
    kernel("correlation").correlate(ray, rho, weight, centred, (images[0], NOTHING[1]), T, k[0], optics, out)
    return torch.from_numpy(out)
