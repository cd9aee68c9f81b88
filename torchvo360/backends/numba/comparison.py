"""`compare` on the compiled pass."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.backends.comparison import Comparison
from torchvo360.backends.numba.linearize import as_arrays, kernel
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.weights import LossConfig

ANY_LOSS = LossConfig()


def compare(
    reference: Reference, target: Target, T_tgt_ref: Float[Tensor, "B 4 4"], affine: Float[Tensor, "B 2"]
) -> Comparison:
    """Compare as `backends.comparison.compare` does, in one pass; the arguments must be what `serves` says."""
    *arguments, loss = as_arrays(reference, target, T_tgt_ref, affine, ANY_LOSS, 1.0)
    out = np.empty((4, len(T_tgt_ref), *reference.value.shape[1:]), np.float32)
    saturation, scale = loss[-2], np.float32(target.camera.pixel_angle**2)
    kernel("samples").sample_pairs(*arguments, saturation, scale, out)
    return Comparison(*torch.from_numpy(out).unbind(0))
