"""Elimination of the window's points: the compiled product where the compiled pass left their equations, else torch's.

The compiled one takes half the product, for it is symmetric, block by block in the cache.
"""

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.backends import use_numba
from torchvo360.backends.numba.kernel import kernel
from torchvo360.solve import schur
from torchvo360.solve.schur import Reduced

TILE = 4
"""Unknowns that the compiled product takes together."""


def reduce(
    H: Float64[Tensor, "D D"],
    g: Float64[Tensor, "D"],
    cross: Float64[Tensor, "N D"],
    diagonal: Float64[Tensor, "N"],
    slope: Float64[Tensor, "N"],
) -> Reduced:
    """Eliminate the points as `schur.reduce` does; infinite ones of the diagonal leave theirs out."""
    if not _serves(cross):
        return schur.reduce(H, g, cross, diagonal, slope)
    arrays = cross.mT.numpy(), diagonal.contiguous().numpy(), slope.contiguous().numpy()
    A, b = kernel("normal").eliminate_points(*arrays)
    return Reduced(H - torch.from_numpy(A), torch.from_numpy(b) - g)


def back_substitute(
    x: Float64[Tensor, "D"],
    cross: Float64[Tensor, "N D"],
    diagonal: Float64[Tensor, "N"],
    slope: Float64[Tensor, "N"],
) -> Float64[Tensor, "N"]:
    """Return the points' step as `schur.back_substitute` does."""
    if not _serves(cross):
        return schur.back_substitute(x, cross, diagonal, slope)
    arrays = x.contiguous().numpy(), cross.mT.numpy(), diagonal.contiguous().numpy(), slope.contiguous().numpy()
    return torch.from_numpy(kernel("normal").step_points(*arrays))


def _serves(cross: Tensor) -> bool:
    """Return whether these are the mixed derivatives that the compiled pass left: unknown by unknown."""
    return (
        cross.dtype == torch.float64
        and cross.mT.is_contiguous()
        and cross.shape[1] % TILE == 0
        and len(cross) > 1
        and use_numba(cross)
    )
