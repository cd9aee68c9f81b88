"""Gradients of a least-squares solution by the implicit function theorem: their cost does not depend on the steps.

At the solution x the gradient of the cost vanishes, `g(x, theta) = 0`, so that `dx = -H^-1 dg` with
`H = dg / dx`: undamped, either J^T W J (Gauss-Newton: exact where residuals vanish) or the exact Hessian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.solve.linear import solve_ldl
from torchvo360.solve.step import State

Parameters = tuple[Tensor, ...]
"""All tensors that the cost depends on besides the state."""


class Linearization(Protocol):
    """A linearisation that is kept open, for two questions about it."""

    def matrix(self) -> Float[Tensor, "B D D"]:
        """Return J^T W J."""
        ...

    def pull(self, direction: Float[Tensor, "B D"]) -> Float[Tensor, "B"]:
        """Return g along a direction."""
        ...


@dataclass(frozen=True)
class Stationarity:
    """What holds at a solution, as functions of the state and the parameters; elements do not depend on each other."""

    gradient: Callable[[State, Parameters], Float[Tensor, "B D"]]
    linearize: Callable[[State, Parameters], Linearization]
    retract: Callable[[State, Float[Tensor, "B D"]], State]
    free: Bool[Tensor, "D"]
    where: Bool[Tensor, "B"]
    """Elements that are solutions: the others have no gradient."""
    exact: bool
    """Whether H is the exact Hessian."""

    def completed(self, H: Float[Tensor, "B D D"]) -> Float[Tensor, "B D D"]:
        """Return H with the identity in place of what is not free, and for elements that are not solutions."""
        use = self.free[:, None] & self.free & self.where[:, None, None]
        eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
        return torch.where(use, H, 0.0) + eye * ~use.diagonal(dim1=-2, dim2=-1)[:, None]

    def hessian(self, state: State, parameters: Parameters) -> Float[Tensor, "B D D"]:
        """Return the exact dg / dx."""

        def total(delta: Tensor) -> Tensor:
            # Elements are independent: the sum over them has every element's row.
            return self.gradient(self.retract(state, delta), parameters).sum(0)

        zero = torch.zeros(*self.where.shape, len(self.free), dtype=state[0].dtype, device=state[0].device)
        return torch.func.jacrev(total, chunk_size=1)(zero).transpose(0, 1)  # pyright: ignore[reportAttributeAccessIssue]

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
        exact = problem.exact
        H = problem.hessian(state, constant) if exact else problem.linearize(state, constant).matrix()
        H = problem.completed(H)
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
        device = saved[0].device.type
        with torch.enable_grad(), torch.autocast(device, enabled=False):
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
            at = problem.linearize(state, parameters)
            with torch.set_grad_enabled(again):
                if problem.exact:
                    H = problem.hessian(state, saved[count:])
                else:
                    H = (problem.linearize(state, saved[count:]) if again else at).matrix()
                s = problem.solve_transposed(problem.completed(H), by_delta * problem.free)
            chosen = [part for part, want in zip(parameters, wanted, strict=True) if want]
            found = iter(torch.autograd.grad(at.pull(-s).sum(), chosen, create_graph=again, allow_unused=True))
        return (None, None, *[None] * count, *(next(found) if want else None for want in wanted))
