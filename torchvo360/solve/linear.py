"""Small symmetric systems by LDL^T, batched, with failure as a value."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

PIVOT_TOLERANCE = 1e-12
"""Pivots of the unit-diagonal matrix below this are zero to the accuracy of float64 sums of float32 rows."""


def solve_ldl(
    A: Float[Tensor, "*batch D D"], b: Float[Tensor, "*batch D"]
) -> tuple[Float[Tensor, "*batch D"], Bool[Tensor, "*batch"]]:
    """Solve `A x = b` for symmetric positive definite A by LDL^T (equations.md, section 7).

    The matrix is first scaled to a unit diagonal, so that parameters of different units weigh alike. The signs and
    sizes of D tell whether it is positive definite.

    Returns:
        x: The solution; zero where A is not positive definite or not finite.
        ok: Whether it is.
    """
    scale = A.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(A.dtype).tiny).rsqrt()
    factor, pivots, info = torch.linalg.ldl_factor_ex(A * scale[..., None] * scale[..., None, :])
    # A negative pivot marks a 2 x 2 block of D, which only an indefinite matrix has; NaN fails every comparison.
    positive = (factor.diagonal(dim1=-2, dim2=-1) > PIVOT_TOLERANCE) & (pivots > 0)
    ok = positive.all(-1) & (info == 0) & torch.isfinite(b).all(-1)
    x = torch.linalg.ldl_solve(factor, pivots, (b * scale)[..., None])[..., 0] * scale
    return torch.where(ok[..., None], x, 0.0), ok


def inverse_ldl(A: Float[Tensor, "*batch D D"]) -> tuple[Float[Tensor, "*batch D D"], Bool[Tensor, "*batch"]]:
    """Return the inverse of symmetric positive definite matrices, and where they are; NaN-free: zero elsewhere."""
    D = A.shape[-1]
    eye = torch.eye(D, dtype=A.dtype, device=A.device).expand(A.shape)
    columns, ok = solve_ldl(A[..., None, :, :].expand(*A.shape[:-2], D, D, D), eye)
    return columns.mT, ok.all(-1)
