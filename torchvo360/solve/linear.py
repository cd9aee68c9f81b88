"""Small symmetric systems by LDL^T, batched, differentiable, with failure as a value."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

PIVOT_TOLERANCE = 1e-12
"""Pivots of the unit-diagonal matrix below this are zero to the accuracy of float64 sums of float32 rows."""


def solve_ldl(
    A: Float[Tensor, "*batch D D"], b: Float[Tensor, "*batch D"]
) -> tuple[Float[Tensor, "*batch D"], Bool[Tensor, "*batch"]]:
    """Solve `A x = b` for symmetric positive definite A by LDL^T (mathematics.md, section 7).

    The matrix is first scaled to a unit diagonal, so that parameters of different units weigh alike. The signs and
    sizes of D tell whether it is positive definite. Gradients of any order reach A and b, under `torch.func.vmap` too;
    that of A is symmetric, as A is.

    Returns:
        x: The solution; zero, with zero gradients, where A is not positive definite or not finite.
        ok: Whether it is.
    """
    return _SolveLDL.apply(A, b)  # pyright: ignore[reportReturnType]


def inverse_ldl(A: Float[Tensor, "*batch D D"]) -> tuple[Float[Tensor, "*batch D D"], Bool[Tensor, "*batch"]]:
    """Return the inverse of symmetric positive definite matrices, and where they are; NaN-free: zero elsewhere."""
    D = A.shape[-1]
    eye = torch.eye(D, dtype=A.dtype, device=A.device).expand(A.shape)
    columns, ok = solve_ldl(A[..., None, :, :].expand(*A.shape[:-2], D, D, D), eye)
    return columns.mT, ok.all(-1)


class _SolveLDL(torch.autograd.Function):
    """The derivative that `torch.linalg.ldl_solve` lacks: `db = s`, `dA = -(s x^T + x s^T) / 2` with `s = A^-1 dx`."""

    @staticmethod
    def forward(A: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        scale = A.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(A.dtype).tiny).rsqrt()
        factor, pivots, info = torch.linalg.ldl_factor_ex(A * scale[..., None] * scale[..., None, :])
        # A negative pivot marks a 2 x 2 block of D, which only an indefinite matrix has; NaN fails every comparison.
        positive = (factor.diagonal(dim1=-2, dim2=-1) > PIVOT_TOLERANCE) & (pivots > 0)
        ok = positive.all(-1) & (info == 0) & torch.isfinite(b).all(-1)
        x = torch.linalg.ldl_solve(factor, pivots, (b * scale)[..., None])[..., 0] * scale
        return torch.where(ok[..., None], x, 0.0), ok

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor]) -> None:
        x, ok = output
        ctx.mark_non_differentiable(ok)
        ctx.save_for_backward(inputs[0], x, ok)

    @staticmethod
    def vmap(  # pyright: ignore[reportIncompatibleMethodOverride]
        info: Any, in_dims: tuple[int | None, int | None], A: Tensor, b: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        """Take the mapped axis as one more batch axis."""
        A, b = (
            value.expand(info.batch_size, *value.shape) if dim is None else value.movedim(dim, 0)
            for value, dim in zip((A, b), in_dims, strict=True)
        )
        return solve_ldl(A, b), (0, 0)

    @staticmethod
    def backward(ctx: Any, grad_x: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        A, x, ok = ctx.saved_tensors
        s, _ = solve_ldl(A, torch.where(ok[..., None], grad_x, 0.0))
        outer = s[..., None] * x[..., None, :]
        return -0.5 * (outer + outer.mT), s
