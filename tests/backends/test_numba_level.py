"""A level solved in one compiled call takes the steps that `solve.minimize` takes, and ends as it does."""

import math
from dataclasses import replace

import pytest
import torch
from jaxtyping import Float
from test_numba import CAMERAS, FULL, PLANE, Problem, everything, plain
from torch import Tensor

from torchvo360 import lie, pairs
from torchvo360.alignment import AlignConfig, PosePrior, solve_level
from torchvo360.backends import backend
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import PIVOT_TOLERANCE, LMConfig, Solution, Status, solve_ldl

rigid = pytest.importorskip("torchvo360.backends.numba.kernels.rigid")
symmetric = pytest.importorskip("torchvo360.backends.numba.kernels.symmetric")

CONFIG = AlignConfig(loss=LossConfig(scale=0.2))
BOTH = pytest.mark.parametrize("damping", ["gain_ratio", "lsd"])


def near(problem: Problem, share: float = 0.3) -> Problem:
    """Start nearer to where the images agree."""
    reference, target, T, affine = problem
    return reference, target, lie.se3_exp(share * lie.se3_log(T)), share * affine


def solved(
    problem: Problem, config: AlignConfig = CONFIG, *, max_steps: int = 30, prior: PosePrior | None = None, **options
) -> tuple[Solution, Solution]:
    """Return the compiled call's solution, and that of `minimize` over the compiled sums."""
    assert pairs.serves(problem[0], problem[1], problem[2], problem[3], *(prior or ()))
    found = solve_level(*problem, config, max_steps=max_steps, prior=prior, **options)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pairs, "serves", lambda *_: False)
        return found, solve_level(*problem, config, max_steps=max_steps, prior=prior, **options)


def assert_same(found: Solution, truth: Solution, atol: float = 1e-7) -> None:
    assert found.status.tolist() == truth.status.tolist()
    assert found.steps.tolist() == truth.steps.tolist()
    for one, other in zip(found.state, truth.state, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=atol, equal_nan=True)
    for one, other in zip(found.equations, truth.equations, strict=True):
        torch.testing.assert_close(
            one, other, rtol=1e-5, atol=1e-5 * float(other.nan_to_num().abs().max()), equal_nan=True
        )


def names(solution: Solution) -> list[str]:
    return [Status(value).name for value in solution.status.tolist()]


@CAMERAS
@BOTH
@pytest.mark.parametrize("known", [False, True], ids=["alone", "with a prior"])
def test_it_takes_the_steps_of_minimize(camera, damping, known):
    for problem in (near(everything(camera, 4, 1)), plain(near(everything(camera, 4, 3, shared=False), 0.6))):
        information = torch.diag(torch.tensor([300.0, 0, 0, 20, 20, 20])).double().expand(4, 6, 6)
        prior = PosePrior(problem[2].flip(0).contiguous(), information) if known else None
        config = replace(CONFIG, solver=LMConfig(damping=damping, cost_tolerance=1e-3))
        found, truth = solved(problem, config, prior=prior)
        assert_same(found, truth)
        assert names(found).count("CONVERGED") >= 3


@BOTH
@pytest.mark.parametrize("fixed_steps", [False, True])
def test_steps_run_out_as_in_minimize(damping, fixed_steps):
    solver = LMConfig(damping=damping, cost_tolerance=1e-30, step_tolerance=1e-30, fixed_steps=fixed_steps)
    for steps in (1, 2, 3, 4):
        found, truth = solved(plain(everything(FULL, 3, 1)), replace(CONFIG, solver=solver), max_steps=steps)
        assert_same(found, truth)
        assert names(found).count("MAX_STEPS") >= 2


@pytest.mark.parametrize("free", [[1, 1, 1, 1, 1, 1, 0, 0], [0, 0, 0, 1, 1, 1, 1, 1], [0] * 8])
def test_what_is_not_free_stays_to_the_last_bit(free):
    problem = plain(near(everything(PLANE, 2, 1)))
    free = torch.tensor(free, dtype=torch.bool)
    found, truth = solved(problem, free=free)
    assert_same(found, truth)
    if not free[6]:
        assert torch.equal(found.state[1], problem[3])
    if not free[0]:
        assert bool((found.state[0][:, :3, 3] == problem[2][:, :3, 3]).all()) == (not free[3])


def with_points(problem: Problem, **parts: Tensor) -> Problem:
    return replace(problem[0], **parts), *problem[1:]


def nothing_in_view(problem: Problem) -> Problem:
    turn = lie.se3_exp(torch.tensor([0.0, 0, 0, 0, math.pi, 0], dtype=torch.float64))
    return *problem[:2], turn @ problem[2], problem[3]


def at_infinity(problem: Problem) -> Problem:
    return with_points(problem, rho=torch.zeros_like(problem[0].rho))


def without_texture(problem: Problem) -> Problem:
    return problem[0], replace(problem[1], padded=torch.full_like(problem[1].padded, 0.5)), *problem[2:]


def without_weight(problem: Problem) -> Problem:
    return with_points(problem, weight=torch.zeros_like(problem[0].weight))


def from_nan(problem: Problem) -> Problem:
    return *problem[:2], torch.full_like(problem[2], math.nan), problem[3]


def from_infinity(problem: Problem) -> Problem:
    affine = torch.tensor([[800.0, 0.0]], dtype=torch.float64).expand(len(problem[2]), 2)
    return *problem[:3], affine


def one_stripe(problem: Problem) -> Problem:
    """Only one line of points: they tell little, and nothing of some directions."""
    weight = torch.zeros_like(problem[0].weight)
    weight[:, : problem[1].camera.width] = 1.0
    return with_points(problem, weight=weight)


HARD = [nothing_in_view, at_infinity, without_texture, without_weight, from_nan, from_infinity, one_stripe]


@pytest.mark.parametrize("camera", [FULL, PLANE], ids=["sphere", "pinhole"])
@pytest.mark.parametrize("change", HARD, ids=lambda change: change.__name__)
@BOTH
def test_hard_cases_end_as_in_minimize(camera, change, damping):
    config = replace(CONFIG, solver=LMConfig(damping=damping, cost_tolerance=1e-3))
    found, truth = solved(change(plain(near(everything(camera, 2, 1)))), config)
    assert_same(found, truth, atol=1e-6)


def test_every_pair_has_its_own_end():
    problem = plain(near(everything(FULL, 4, 1)))
    weight, T = problem[0].weight.clone(), problem[2].clone()
    weight[1] = 0.0
    T[2] = math.nan
    hard = with_points((*problem[:2], T, problem[3]), weight=weight)
    found, truth = solved(hard)
    assert_same(found, truth)
    assert names(found)[1:3] == ["TOO_FEW_PIXELS", "DIVERGED"]
    easy = solve_level(*problem, CONFIG, max_steps=30)
    for one, other in zip((*found.state, *found.equations), (*easy.state, *easy.equations), strict=True):
        assert torch.equal(one[[0, 3]], other[[0, 3]])


def element(problem: Problem, at: int) -> Problem:
    index = torch.tensor([at])
    reference, target, T, affine = problem
    return reference.take(index), target.take(index), T[index], affine[index]


def test_threads_and_the_rest_of_a_batch_change_no_bit():
    problem = everything(FULL, 5, 2)
    one = solve_level(*problem, CONFIG, max_steps=20)
    torch.set_num_threads(2)
    try:
        two = solve_level(*problem, CONFIG, max_steps=20)
    finally:
        torch.set_num_threads(1)
    for k in range(5):
        alone = solve_level(*element(problem, k), CONFIG, max_steps=20)
        for a, b, c in zip(*((*s.state, *s.equations, s.status, s.steps) for s in (one, two, alone)), strict=True):
            assert torch.equal(a, b)
            assert torch.equal(a[k], c[0])


def test_no_points_and_no_pairs_are_answered():
    reference, target, T, affine = plain(everything(FULL, 2, 1))
    found, truth = solved((reference.chunk(0, 0), target, T, affine))
    assert_same(found, truth)
    assert names(found) == ["TOO_FEW_PIXELS"] * 2
    none = solve_level(reference.take(slice(0, 0)), target.take(slice(0, 0)), T[:0], affine[:0], CONFIG, max_steps=5)
    assert none.state[0].shape == (0, 4, 4)


def test_what_it_does_not_serve_is_left_to_minimize():
    problem: tuple[Reference, Target, Float[Tensor, "B 4 4"], Tensor] = plain(near(everything(FULL, 1, 1)))
    reference, target, T, affine = problem
    assert pairs.serves(*problem)
    assert not pairs.serves(*problem[:2], T.float(), affine)
    assert not pairs.serves(*problem[:2], T.clone().requires_grad_(), affine)
    assert not pairs.serves(reference, replace(target, padded=target.padded.double()), T, affine)
    with backend("eager"):
        assert not pairs.serves(*problem)
        eager = solve_level(*problem, CONFIG, max_steps=30)
    found = solve_level(*problem, CONFIG, max_steps=30)
    assert names(found) == names(eager)
    torch.testing.assert_close(found.state[0], eager.state[0], rtol=0, atol=1e-6)
    traced = solve_level(*problem, CONFIG, max_steps=30, traced=True)
    assert traced.trace is not None


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, 0.1, 0.499, 0.501, 2.0, 3.1, math.pi - 1e-7, math.pi])
def test_rigid_motions_are_those_of_lie(angle):
    generator = torch.Generator().manual_seed(3)
    for axis in (*torch.eye(3), *-torch.eye(3), *torch.randn(6, 3, generator=generator)):
        xi = torch.randn(6, generator=generator, dtype=torch.float64)
        xi[3:] = angle * axis.double() / axis.double().norm()
        T = lie.se3_exp(xi)
        torch.testing.assert_close(torch.from_numpy(rigid.se3_exp(xi.numpy())), T, rtol=0, atol=1e-14)
        back = torch.from_numpy(rigid.se3_log(T.numpy()))
        torch.testing.assert_close(lie.se3_exp(back), T, rtol=0, atol=1e-13)
        torch.testing.assert_close(back, lie.se3_log(T), rtol=0, atol=1e-12)
        both = rigid.times_inverse(T.numpy(), rigid.se3_exp(xi.flip(0).numpy()))
        expected = T @ lie.se3_inverse(lie.se3_exp(xi.flip(0)))
        torch.testing.assert_close(torch.from_numpy(both), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("seed", range(3))
def test_systems_are_solved_and_refused_as_by_solve_ldl(seed):
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(300, 8, 20, generator=generator, dtype=torch.float64)
    A = root @ root.mT
    A[1::3] -= torch.diag_embed(0.3 * A[1::3].diagonal(dim1=1, dim2=2))  # some indefinite
    A[2::3] = root[2::3, :, :5] @ root[2::3, :, :5].mT  # singular
    A[0, 0] = A[0, :, 0] = 0.0
    A[3, 4, 4] = math.nan
    A[6, 2, 2] = math.inf
    units = torch.logspace(-4, 4, 8, dtype=torch.float64)
    A, b = A * units[:, None] * units, torch.randn(300, 8, generator=generator, dtype=torch.float64) * units
    b[9, 3] = math.nan
    truth, ok = solve_ldl(A, b)
    assert 80 < int(ok.sum()) < 200
    for k in range(300):
        x = b[k].clone()
        assert symmetric.solve_ldl(A[k].clone().numpy(), x.numpy(), PIVOT_TOLERANCE) == bool(ok[k])
        torch.testing.assert_close(x * units, truth[k] * units, rtol=1e-9, atol=1e-9)
