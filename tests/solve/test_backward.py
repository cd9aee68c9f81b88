"""Gradients of a least-squares solution, by its steps and by the implicit function theorem, on fitted curves."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor
from torch.func import jacrev, vmap

from torchvo360.residuals.normal import NormalEquations
from torchvo360.solve import (
    LMConfig,
    Problem,
    Stationarity,
    attach_implicit,
    attach_newton_step,
    last_moves,
    minimize,
    replay,
)

PRECISE = LMConfig(step_tolerance=1e-9, cost_tolerance=1e-30, max_steps=60)
FREE = torch.tensor([True, True, True])


def residual(x: Tensor, data: Tensor) -> Tensor:
    s = torch.linspace(0, 3, data.shape[-1], dtype=data.dtype)
    return x[0] * torch.exp(-x[1] * s) + x[2] - data


@dataclass(frozen=True)
class Opened:
    r: Tensor
    J: Tensor

    def matrix(self) -> Tensor:
        return self.J.mT @ self.J

    def pull(self, direction: Tensor) -> Tensor:
        return ((self.J @ direction[..., None])[..., 0] * self.r).sum(-1)

    def gradient(self) -> Tensor:
        return (self.J.mT @ self.r[..., None])[..., 0]


def opened(state, parameters) -> Opened:
    (x,), (data,) = state, parameters
    return Opened(vmap(residual)(x, data), vmap(jacrev(residual))(x, data))


def retract(state, delta):
    return (state[0] + delta,)


def problem(data: Tensor, free: Tensor = FREE) -> Problem:
    def linearize(state, index):
        at = opened(state, (data[index],))
        square = (at.r * at.r).sum(-1)
        return NormalEquations(at.matrix(), at.gradient(), 0.5 * square, torch.full_like(square, 25.0), square)

    return Problem(linearize, retract, free)


def samples(noise: float = 0.05) -> Tensor:
    s = torch.linspace(0, 3, 25, dtype=torch.float64)
    rate = torch.tensor([0.5, 0.8, 1.1], dtype=torch.float64)[:, None]
    wobble = noise * torch.randn(3, 25, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return 2.0 * torch.exp(-rate * s) + 0.3 + wobble


def solve(data: Tensor, config: LMConfig = PRECISE, *, start=None, free: Tensor = FREE):
    start = torch.ones(3, 3, dtype=torch.float64) if start is None else start
    toy = problem(data.detach(), free)
    scale = torch.ones(3, 3, dtype=torch.float64)
    return minimize(toy.linearize, retract, (start,), config, step_scale=scale, free=free, min_weight=1.0, traced=True)


def stationarity(where: Tensor, *, exact: bool = True, free: Tensor = FREE) -> Stationarity:
    return Stationarity(
        gradient=lambda state, parameters: opened(state, parameters).gradient(),
        linearize=opened, retract=retract, free=free, where=where, exact=exact,
    )  # fmt: skip


ALL = torch.ones(3, dtype=torch.bool)
ATTACH = pytest.mark.parametrize("attach", [attach_implicit, attach_newton_step])


def solved_exactly(data: Tensor) -> Tensor:
    """Solutions polished by Newton's method on the gradient, which no rounding of the cost can stop."""
    (x,) = solve(data).state
    for _ in range(3):

        def gradient(x: Tensor, data: Tensor) -> Tensor:
            r, J = residual(x, data), jacrev(residual)(x, data)
            return J.mT @ r

        x = x - torch.linalg.solve(vmap(jacrev(gradient))(x, data), vmap(gradient)(x, data))
    return x


def true_gradient(data: Tensor, mix: Tensor) -> Tensor:
    """Central differences of solutions."""
    out = torch.zeros_like(data)
    h = 1e-5
    for k in range(data.shape[1]):
        shift = torch.zeros_like(data)
        shift[:, k] = h
        ends = [(solved_exactly(data + s * shift) * mix).sum(-1) for s in (1, -1)]
        out[:, k] = (ends[0] - ends[1]) / (2 * h)
    return out


@ATTACH
def test_the_implicit_gradient_is_that_of_solving_again(attach):
    data, mix = samples().requires_grad_(), torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    solution = solve(data)
    (x,) = attach(stationarity(ALL), solution.state, (data,))
    assert torch.equal(x, solution.state[0])
    (found,) = torch.autograd.grad((x * mix).sum(), data)
    torch.testing.assert_close(found, true_gradient(data.detach(), mix), rtol=1e-5, atol=1e-7)


@ATTACH
def test_gauss_newton_is_exact_without_residuals_and_near_with_them(attach):
    mix = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    for noise, tolerance in ((0.0, 1e-6), (0.05, 0.2)):
        data = samples(noise).requires_grad_()
        (x,) = attach(stationarity(ALL, exact=False), solve(data).state, (data,))
        (found,) = torch.autograd.grad((x * mix).sum(), data)
        expected = true_gradient(data.detach(), mix)
        assert float((found - expected).norm() / expected.norm()) < tolerance


@ATTACH
def test_elements_that_are_no_solutions_have_exactly_no_gradient(attach):
    data = samples()
    data[1] = torch.nan
    data.requires_grad_()
    state = (torch.ones(3, 3, dtype=torch.float64),)
    where = torch.tensor([True, False, True])
    # What is not a number stays away from the others, and from itself.
    clean = torch.where(torch.isfinite(data), data, 0.0)
    (x,) = attach(stationarity(where, exact=False), state, (clean,))
    (found,) = torch.autograd.grad(x.sum(), data)
    assert not found[1].any()
    assert torch.isfinite(found).all()
    assert found[[0, 2]].any(1).all()


@ATTACH
def test_parameters_that_are_not_free_have_no_gradient(attach):
    free = torch.tensor([True, False, True])
    data = samples().requires_grad_()
    solution = solve(data, free=free)
    for exact in (True, False):
        (x,) = attach(stationarity(ALL, exact=exact, free=free), solution.state, (data,))
        (fixed,) = torch.autograd.grad(x[:, 1].sum(), data, retain_graph=True)
        assert not fixed.any()
        (moved,) = torch.autograd.grad(x[:, 0].sum(), data)
        assert moved.any()


def test_second_derivatives_are_those_of_the_solution():
    data = samples().requires_grad_()
    mix = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    d = torch.randn(3, 25, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def first(values: Tensor) -> Tensor:
        (x,) = attach_implicit(stationarity(ALL), solve(values).state, (values,))
        return torch.autograd.grad((x * mix).sum(), values, create_graph=True)[0]

    (second,) = torch.autograd.grad((first(data) * d).sum(), data)
    h = 1e-5
    e = torch.randn(3, 25, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    ends = [(first((data.detach() + s * h * e).requires_grad_()) * d).sum().detach() for s in (1, -1)]
    torch.testing.assert_close((second * e).sum(), (ends[0] - ends[1]) / (2 * h), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("fixed", [False, True])
def test_replayed_steps_end_where_the_solve_did(fixed):
    data = samples().requires_grad_()
    config = replace(PRECISE, fixed_steps=fixed, max_steps=20)
    start = torch.tensor([[1.0, 1.0, 1.0], [5.0, 3.0, -1.0], [0.3, 0.1, 0.0]], dtype=torch.float64)
    solution = solve(data, config, start=start)
    trace = solution.trace
    assert (trace.tried.sum(0) == solution.steps).all()
    assert not (trace.moved & ~trace.tried).any()
    assert torch.equal(trace.state[0][0], start)
    (x,) = replay(problem(data), (start,), trace, masked=fixed)
    torch.testing.assert_close(x, solution.state[0], rtol=0, atol=1e-12)
    (unrolled,) = torch.autograd.grad(x.sum(), data)
    (implicit,) = torch.autograd.grad(attach_implicit(stationarity(ALL), solution.state, (data,))[0].sum(), data)
    torch.testing.assert_close(unrolled, implicit, rtol=1e-5, atol=1e-7)


def test_the_last_moves_are_the_end_of_all_of_them():
    data = samples()
    start = torch.tensor([[1.0, 1.0, 1.0], [5.0, 3.0, -1.0], [2.0, 0.5, 0.3]], dtype=torch.float64)
    solution = solve(data, start=start)
    assert len(set(solution.trace.moved.sum(0).tolist())) > 1
    for count in (1, 2, 3, 100):
        before, trace = last_moves(solution.trace, count, solution.state)
        assert torch.equal(trace.moved.sum(0), solution.trace.moved.sum(0).clamp(max=count))
        (x,) = replay(problem(data), before, trace, masked=False)
        torch.testing.assert_close(x, solution.state[0], rtol=0, atol=1e-12)
    before, _ = last_moves(solution.trace, 100, solution.state)
    torch.testing.assert_close(before[0], start)


def test_a_solve_without_steps_has_an_empty_trace():
    data = samples()
    toy = problem(data)
    start = torch.ones(3, 3, dtype=torch.float64)
    ended = minimize(
        toy.linearize, retract, (start,), PRECISE, step_scale=start, free=FREE, min_weight=100.0, traced=True
    )
    assert ended.trace.moved.shape == (0, 3)
    before, trace = last_moves(ended.trace, 2, ended.state)
    assert before is ended.state
    assert replay(toy, (start,), trace, masked=False)[0] is start
