"""Elimination of the unknowns whose block of the normal equations is diagonal, by the Schur complement."""

from typing import NamedTuple

from jaxtyping import Float64
from torch import Tensor


class Reduced(NamedTuple):
    """The normal equations `A x = b` of the unknowns that are kept."""

    A: Float64[Tensor, "D D"]
    b: Float64[Tensor, "D"]


def reduce(
    H: Float64[Tensor, "D D"],
    g: Float64[Tensor, "D"],
    cross: Float64[Tensor, "N D"],
    diagonal: Float64[Tensor, "N"],
    slope: Float64[Tensor, "N"],
) -> Reduced:
    """Eliminate N unknowns from `[[H, cross^T], [cross, diag]] [x, y] = -[g, slope]`.

    Args:
        H: Block of the unknowns that are kept.
        g: Their gradient.
        cross: Mixed second derivatives.
        diagonal: Block of the eliminated ones, positive.
        slope: Their gradient.
    """
    scaled = cross / diagonal[:, None]
    A = H - cross.mT @ scaled
    return Reduced((A + A.mT) / 2, scaled.mT @ slope - g)


def back_substitute(
    x: Float64[Tensor, "D"],
    cross: Float64[Tensor, "N D"],
    diagonal: Float64[Tensor, "N"],
    slope: Float64[Tensor, "N"],
) -> Float64[Tensor, "N"]:
    """Return the eliminated unknowns' step."""
    return -(slope + cross @ x) / diagonal
