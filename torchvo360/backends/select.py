"""`linearize` on the fastest backend there is for its arguments."""

import importlib.util

from jaxtyping import Float
from torch import Tensor

from torchvo360.backends import eager, numba
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig


def linearize(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    loss: LossConfig,
    *,
    noise: float = 4 / 255,
) -> NormalEquations:
    """Linearise as `backends.eager.linearize` does: by numba where it is installed and serves, else in eager torch."""
    compiled = has_numba() and numba.serves(reference, target, T_tgt_ref, affine)
    return (numba if compiled else eager).linearize(reference, target, T_tgt_ref, affine, loss, noise=noise)


def has_numba() -> bool:
    """Return whether numba is installed."""
    return importlib.util.find_spec("numba") is not None
