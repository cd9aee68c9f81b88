"""LDL^T solves what is positive definite as accurately as its condition allows, and says of the rest that it is not."""

import math

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.solve import inverse_ldl, solve_ldl

BATCHES = pytest.mark.parametrize("batch", [(), (5,), (2, 3)], ids=str)


def positive_definite(batch: tuple[int, ...], D: int, condition: float, seed: int = 0) -> Float[Tensor, "*batch D D"]:
    generator = torch.Generator().manual_seed(seed)
    Q, _ = torch.linalg.qr(torch.randn(*batch, D, D, generator=generator, dtype=torch.float64))
    return (Q * torch.logspace(0, -math.log10(condition), D, dtype=torch.float64)) @ Q.mT


def vector(batch: tuple[int, ...], D: int) -> Float[Tensor, "*batch D"]:
    return torch.randn(*batch, D, generator=torch.Generator().manual_seed(9), dtype=torch.float64)


@BATCHES
@pytest.mark.parametrize("D", [1, 2, 8, 13])
@pytest.mark.parametrize("condition", [1.0, 1e3, 1e6, 1e9])
def test_solutions_equal_a_general_solvers(batch, D, condition):
    A, b = positive_definite(batch, D, condition), vector(batch, D)
    x, ok = solve_ldl(A, b)
    assert ok.shape == batch
    assert ok.all()
    expected = torch.linalg.solve(A, b)
    error = (x - expected).norm(dim=-1) / expected.norm(dim=-1)
    assert (error < 1e-13 * condition + 1e-13).all()


@pytest.mark.parametrize("spread", [1e3, 1e6, 1e9])
def test_units_of_the_parameters_do_not_matter(spread):
    A, b = positive_definite((20,), 8, 1e3), vector((20,), 8)
    units = torch.logspace(0, math.log10(spread), 8, dtype=torch.float64)
    x, ok = solve_ldl(A * units[:, None] * units, b * units)
    assert ok.all()
    torch.testing.assert_close(x * units, solve_ldl(A, b)[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_every_definite_matrix_is_recognised(seed):
    # Those with small leading pivots make a pivoting LDL^T swap rows; none may be mistaken for indefinite.
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(500, 8, 8, generator=generator, dtype=torch.float64)
    root = root * 10 ** (-3 * torch.rand(500, 8, 1, generator=generator, dtype=torch.float64))
    A = root @ root.mT
    A = A[torch.linalg.cond(A) < 1e9]
    assert len(A) > 100
    b = vector((len(A),), 8)
    x, ok = solve_ldl(A, b)
    assert ok.all()
    assert ((A @ x[..., None])[..., 0] - b).abs().max() < 1e-4


def bad_matrices() -> dict[str, Float[Tensor, "8 8"]]:
    good = positive_definite((), 8, 10.0)
    singular = good.clone()
    singular[3], singular[:, 3] = 0.0, 0.0
    dependent = good.clone()
    dependent[7], dependent[:, 7] = dependent[6].clone(), dependent[:, 6].clone()
    dependent[7, 7] = dependent[6, 6]
    indefinite = torch.diag(torch.tensor([1.0] * 7 + [-1.0], dtype=torch.float64))
    saddle = torch.eye(8, dtype=torch.float64)
    saddle[0, 1] = saddle[1, 0] = 2.0
    nan, inf = good.clone(), good.clone()
    nan[2, 5] = nan[5, 2] = math.nan
    inf[4, 4] = math.inf
    return {
        "zero": torch.zeros(8, 8, dtype=torch.float64),
        "a row of zeros": singular,
        "two equal rows": dependent,
        "rank 1": torch.ones(8, 8, dtype=torch.float64),
        "negative": -good,
        "negative pivot": indefinite,
        "saddle": saddle,
        "zero diagonal": torch.ones(8, 8, dtype=torch.float64) - torch.eye(8, dtype=torch.float64),
        "nan": nan,
        "inf": inf,
    }


@pytest.mark.parametrize("name", bad_matrices())
def test_a_bad_matrix_gives_zero_and_leaves_its_neighbours_alone(name):
    A, b = positive_definite((3,), 8, 100.0), vector((3,), 8)
    expected, _ = solve_ldl(A, b)
    A[1] = bad_matrices()[name]
    x, ok = solve_ldl(A, b)
    assert ok.tolist() == [True, False, True]
    assert not x[1].any()
    assert torch.equal(x[[0, 2]], expected[[0, 2]])
    inverse, invertible = inverse_ldl(A)
    assert invertible.tolist() == [True, False, True]
    assert torch.isfinite(inverse).all()
    assert not inverse[1].any()


def test_a_bad_right_side_is_not_solved():
    A, b = positive_definite((2,), 8, 10.0), vector((2,), 8)
    b[0, 3] = math.nan
    x, ok = solve_ldl(A, b)
    assert ok.tolist() == [False, True]
    assert torch.isfinite(x).all()


@BATCHES
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_the_inverse_is_the_inverse(batch, dtype):
    A = positive_definite(batch, 8, 100.0).to(dtype)
    inverse, ok = inverse_ldl(A)
    assert ok.all()
    assert inverse.dtype == dtype
    eye = torch.eye(8, dtype=dtype).expand(*batch, 8, 8)
    torch.testing.assert_close(A @ inverse, eye, atol=1e-4 if dtype == torch.float32 else 1e-12, rtol=0)
    torch.testing.assert_close(inverse, inverse.mT, atol=1e-3 if dtype == torch.float32 else 1e-11, rtol=0)


def test_an_empty_batch_is_solved():
    x, ok = solve_ldl(torch.zeros(0, 8, 8, dtype=torch.float64), torch.zeros(0, 8, dtype=torch.float64))
    assert x.shape == (0, 8)
    assert ok.shape == (0,)
