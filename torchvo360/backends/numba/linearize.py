"""`linearize` on the compiled pass: sums to normal equations."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.backends.numba.arrays import as_arrays
from torchvo360.backends.numba.kernel import kernel
from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig

UPPER = np.array([[min(p, q) * (17 - min(p, q)) // 2 + max(p, q) for q in range(9)] for p in range(9)])
"""Where an entry of the 9 x 9 matrix lies among the sums of its upper triangle."""


def serves(reference: Reference, target: Target, T_tgt_ref: Tensor, affine: Tensor) -> bool:
    """Return whether `linearize` takes these: float32 on the CPU, a known camera, and no gradient asked."""
    inputs = [
        *(reference.ray, reference.rho, reference.value, reference.weight, reference.variance),
        *(target.padded, target.confidence, target.intrinsics),
    ]
    tensors = [value for value in inputs if value is not None]
    if torch.is_grad_enabled() and any(value.requires_grad for value in (*tensors, T_tgt_ref, affine)):
        return False
    return type(target.camera) in (Equirectangular, Pinhole) and all(
        value.dtype == torch.float32 and value.device.type == "cpu" for value in tensors
    )


def linearize(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    loss: LossConfig,
    *,
    noise: float = 4 / 255,
) -> NormalEquations:
    """Linearise as `backends.eager.linearize` does, in one pass over the points, on `torch.get_num_threads()` threads.

    Arguments give the same bits on any number of threads, and a pair gives the same bits whatever else is in its batch.

    Raises:
        InputError: numba is missing (the extra `fast` brings it), or the arguments are not what `serves` says.
        ShapeError: Shapes do not belong together.
    """
    if not serves(reference, target, T_tgt_ref, affine):
        raise InputError(
            "linearize: expected float32 tensors on the CPU without gradients, and a panorama or a pinhole, for numba, "
            "got others."
        )
    arguments = as_arrays(reference, target, T_tgt_ref, affine, loss, noise)
    sums = kernel("pairs").sum_pairs(*arguments, torch.get_num_threads())
    M = torch.from_numpy(sums[:, UPPER])
    cost, weight = torch.from_numpy(sums[:, 45:].copy()).unbind(1)
    return NormalEquations(M[:, :8, :8], M[:, :8, 8], cost, weight, M[:, 8, 8])
