"""Gradients of a least-squares solution by the implicit function theorem: their cost does not depend on the steps.

At the solution x the gradient of the cost vanishes, `g(x, theta) = 0`, so that `dx = -H^-1 dg` with
`H = dg / dx`: undamped, either J^T W J (Gauss-Newton: exact where residuals vanish) or the exact Hessian.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.solve.linear import solve_ldl
from torchvo360.solve.step import State

Parameters = tuple[Tensor, ...]
"""All tensors that the cost depends on besides the state."""


@dataclass(frozen=True)
class Stationarity:
    """What holds at a solution, as functions of the state and the parameters; elements do not depend on each other."""

    gradient: Callable[[State, Parameters], Float[Tensor, "B D"]]
    normal_matrix: Callable[[State, Parameters], Float[Tensor, "B D D"]]
    """J^T W J."""
    retract: Callable[[State, Float[Tensor, "B D"]], State]
    free: Bool[Tensor, "D"]
    where: Bool[Tensor, "B"]
    """Elements that are solutions: the others have no gradient."""
    exact: bool
    """Whether H is the exact Hessian."""

    def matrix(self, state: State, parameters: Parameters, *, create_graph: bool) -> Float[Tensor, "B D D"]:
        """Return H, with the identity in place of what is not free, and for elements that are not solutions."""
        if self.exact:
            H = self._hessian(state, parameters, create_graph=create_graph)
        else:
            H = self.normal_matrix(state, parameters)
        use = self.free[:, None] & self.free & self.where[:, None, None]
        eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
        kept = torch.where(use, H, 0.0)
        return kept + eye * ~use.diagonal(dim1=-2, dim2=-1)[:, None]

    def _hessian(self, state: State, parameters: Parameters, *, create_graph: bool) -> Float[Tensor, "B D D"]:
        with torch.enable_grad():
            zero = torch.zeros(*self.where.shape, len(self.free), dtype=state[0].dtype, device=state[0].device)
            delta = zero.requires_grad_()
            g = self.gradient(self.retract(state, delta), parameters)
            # Elements are independent: the sum over them has every element's row.
            sums = g.sum(0).unbind()
            rows = [torch.autograd.grad(x, delta, retain_graph=True, create_graph=create_graph)[0] for x in sums]
            H = torch.stack(rows, 1)
        return H if create_graph else H.detach()

    def solve_transposed(self, H: Float[Tensor, "B D D"], b: Float[Tensor, "B D"]) -> Float[Tensor, "B D"]:
        """Return `H^-T b`, zero where H cannot be inverted."""
        if not self.exact:
            return solve_ldl(H, b)[0]
        # The target's confidence weighs without being part of the cost's derivative: H need not be symmetric.
        scale = H.diagonal(dim1=-2, dim2=-1).abs().clamp_min(torch.finfo(H.dtype).tiny).rsqrt()
        x, info = torch.linalg.solve_ex(H.mT * scale[..., None] * scale[..., None, :], b * scale)
        ok = (info == 0) & torch.isfinite(x).all(-1)
        return torch.where(ok[..., None], x * scale, 0.0)


def attach_implicit(problem: Stationarity, solution: State, parameters: Parameters) -> State:
    """Return a solution with the gradients that the implicit function theorem gives it.

    Nothing but the parameters and the solution is kept for the backward pass, which linearises once. Double backward
    differentiates the very formula: with the exact Hessian that is the solution's second derivative.

    Args:
        problem: What holds at the solution.
        solution: The state.
        parameters: What gradients flow to.
    """
    return _Implicit.apply(problem, len(solution), *solution, *parameters)  # pyright: ignore[reportReturnType]


def attach_newton_step(problem: Stationarity, solution: State, parameters: Parameters) -> State:
    """Return what `attach_implicit` does, by the operations of one Newton step whose value is zero.

    For `torch.compile` and `torch.func`, which cannot look into a backward pass that calls autograd itself. The step's
    graph is kept, and second derivatives are not those of the solution.
    """
    state = tuple(part.detach() for part in solution)
    constant = tuple(part.detach() for part in parameters)
    with torch.no_grad():
        H = problem.matrix(state, constant, create_graph=False)
    g = problem.gradient(state, parameters) * problem.free
    g = torch.where(problem.where[:, None], g - g.detach(), 0.0)
    step = problem.solve_transposed(H.mT, -g)
    return problem.retract(state, step)


class _Implicit(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, problem: Stationarity, count: int, *tensors: Tensor) -> State:
        ctx.problem, ctx.count = problem, count
        solution = tuple(part.clone() for part in tensors[:count])
        ctx.save_for_backward(*solution, *tensors[count:])
        return solution

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        problem: Stationarity = ctx.problem
        saved, count = ctx.saved_tensors, ctx.count
        again = torch.is_grad_enabled()  # only then is this pass to be differentiated itself
        wanted = ctx.needs_input_grad[2 + count :]
        with torch.enable_grad():
            if again:
                # Aliases: the derivative is by the parameters alone, not by way of the solution that depends on them.
                state, parameters = saved[:count], tuple(part.view_as(part) for part in saved[count:])
            else:
                state = tuple(part.detach() for part in saved[:count])
                parameters = tuple(
                    part.detach().requires_grad_(want) for part, want in zip(saved[count:], wanted, strict=True)
                )
            zero = torch.zeros(*problem.where.shape, len(problem.free), dtype=state[0].dtype, device=state[0].device)
            delta = zero.requires_grad_()
            # Elements without a solution are cut off before anything is multiplied with their numbers.
            cut = tuple(torch.where(problem.where.reshape(-1, *[1] * (g.ndim - 1)), g, 0.0) for g in grads)
            (by_delta,) = torch.autograd.grad(problem.retract(state, delta), delta, cut, create_graph=again)
            with torch.set_grad_enabled(again):
                H = problem.matrix(state, saved[count:], create_graph=again)
                s = problem.solve_transposed(H, by_delta * problem.free)
            pull = (problem.gradient(state, parameters) * -s).sum()
            chosen = [part for part, want in zip(parameters, wanted, strict=True) if want]
            found = iter(torch.autograd.grad(pull, chosen, create_graph=again, allow_unused=True))
        return (None, None, *[None] * count, *(next(found) if want else None for want in wanted))
