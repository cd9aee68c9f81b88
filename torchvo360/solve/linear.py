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
    diagonal = A.diagonal(dim1=-2, dim2=-1)
    finite = torch.isfinite(A).flatten(-2).all(-1) & torch.isfinite(b).all(-1) & (diagonal > 0).all(-1)
    safe_diagonal = torch.where(finite[..., None], diagonal, torch.ones_like(diagonal))
    scale = safe_diagonal.rsqrt()
    eye = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
    scaled = torch.where(finite[..., None, None], A * scale[..., None] * scale[..., None, :], eye)
    factor, pivots, info = torch.linalg.ldl_factor_ex(scaled)
    # A negative pivot marks a 2 x 2 block of D, which only an indefinite matrix has.
    ok = finite & (info == 0) & (pivots > 0).all(-1) & (factor.diagonal(dim1=-2, dim2=-1) > PIVOT_TOLERANCE).all(-1)
    factor = torch.where(ok[..., None, None], factor, eye)
    pivots = torch.where(ok[..., None], pivots, torch.arange(1, A.shape[-1] + 1, dtype=pivots.dtype, device=A.device))
    right = torch.where(ok[..., None], b * scale, torch.zeros_like(b))
    x = torch.linalg.ldl_solve(factor, pivots, right[..., None])[..., 0] * scale
    return torch.where(ok[..., None], x, torch.zeros_like(x)), ok


def inverse_ldl(A: Float[Tensor, "*batch D D"]) -> tuple[Float[Tensor, "*batch D D"], Bool[Tensor, "*batch"]]:
    """Return the inverse of symmetric positive definite matrices, and where they are; NaN-free: zero elsewhere."""
    D = A.shape[-1]
    eye = torch.eye(D, dtype=A.dtype, device=A.device).expand(A.shape)
    columns, ok = solve_ldl(A[..., None, :, :].expand(*A.shape[:-2], D, D, D), eye)
    return columns.mT, ok.all(-1)
