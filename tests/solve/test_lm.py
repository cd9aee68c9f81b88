"""Every element of a batch is minimised on its own, by the schedule that was asked for, and says how it ended."""

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import jacrev, vmap

from torchvo360.checks import InputError
from torchvo360.residuals.normal import NormalEquations
from torchvo360.solve import LMConfig, Solution, Status, minimize
from torchvo360.solve.damping import Damping, initial_damping, next_damping

BOTH = pytest.mark.parametrize("damping", ["gain_ratio", "lsd"])


def precise(damping: str = "gain_ratio", max_steps: int = 30) -> LMConfig:
    """Tolerances that let a solve go on to the last digits."""
    return LMConfig(damping=damping, max_steps=max_steps, step_tolerance=1e-9, cost_tolerance=1e-14)


@dataclass
class Problem:
    """Residuals r(x, k) of elements k, linearised by autograd; it notes every point it was asked about."""

    residual: Callable[[Tensor, Tensor], Tensor]
    weight: float = 100.0
    asked: list[tuple[Tensor, Tensor]] = field(default_factory=list)

    def linearize(self, state: tuple[Tensor, ...], index: Tensor) -> NormalEquations:
        (x,) = state
        self.asked.append((x.clone(), index.clone()))
        r = vmap(self.residual)(x, index)
        J = vmap(jacrev(self.residual))(x, index)
        square = (r * r).sum(-1)
        w = torch.full_like(square, self.weight)
        return NormalEquations(J.mT @ J, (J.mT @ r[..., None])[..., 0], 0.5 * square, w, square)

    def solve(
        self, start: Float[Tensor, "B D"], config: LMConfig, *, free: list[bool] | None = None, min_weight: float = 10.0
    ) -> Solution:
        D = start.shape[-1]
        return minimize(
            self.linearize,
            lambda state, delta: (state[0] + delta,),
            (start,),
            config,
            step_scale=torch.ones_like(start),
            free=torch.tensor([True] * D if free is None else free),
            min_weight=min_weight,
        )


def rosenbrock(x: Tensor, k: Tensor) -> Tensor:
    """The curved valley, steeper for every element; its minimum is (1, 1)."""
    return torch.stack([1 - x[0], (3.0 + k) * (x[1] - x[0] ** 2)])


def curve_fit(x: Tensor, k: Tensor) -> Tensor:
    """A e^(-b s) + c fitted to samples of it, of another curve for every element, with residuals that remain."""
    s = torch.linspace(0, 3, 25, dtype=x.dtype)
    truth = 2.0 * torch.exp(-(0.5 + 0.2 * k) * s) + 0.3
    return x[0] * torch.exp(-x[1] * s) + x[2] - truth - 0.05 * torch.sin(7 * s)


def status(solution: Solution) -> list[str]:
    return [Status(int(value)).name for value in solution.status]


def starts(*rows: tuple[float, ...]) -> Float[Tensor, "B D"]:
    return torch.tensor(rows, dtype=torch.float64)


def test_a_quadratic_is_solved_in_one_step():
    A = torch.randn(4, 6, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    b = torch.randn(4, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    problem = Problem(lambda x, k: A.index_select(0, k[None])[0] @ x - b.index_select(0, k[None])[0])
    expected = torch.linalg.lstsq(A, b[..., None]).solution[..., 0]
    # The lsd schedule starts undamped: its first step is Gauss-Newton's.
    solution = problem.solve(torch.zeros(4, 3, dtype=torch.float64), precise(damping="lsd"))
    torch.testing.assert_close(problem.asked[1][0], expected, atol=1e-9, rtol=0)
    assert status(solution) == ["CONVERGED"] * 4
    assert (solution.steps <= 3).all()
    damped = problem.solve(torch.zeros(4, 3, dtype=torch.float64), precise())
    torch.testing.assert_close(damped.state[0], expected, atol=1e-6, rtol=0)
    assert status(damped) == ["CONVERGED"] * 4


@BOTH
def test_a_curved_valley_is_followed_to_its_end(damping):
    problem = Problem(rosenbrock)
    solution = problem.solve(
        starts((-1.2, 1.0), (3.0, -2.0), (0.0, 0.0), (-3.0, 5.0)), precise(damping=damping, max_steps=1000)
    )
    assert status(solution) == ["CONVERGED"] * 4
    torch.testing.assert_close(solution.state[0], torch.ones(4, 2, dtype=torch.float64), atol=1e-5, rtol=0)


@BOTH
def test_curves_are_fitted_to_a_stationary_point(damping):
    problem = Problem(curve_fit)
    solution = problem.solve(torch.ones(5, 3, dtype=torch.float64), precise(damping=damping, max_steps=100))
    assert status(solution) == ["CONVERGED"] * 5
    assert solution.equations.g.abs().max() < 1e-6
    expected = starts(*((2.0, 0.5 + 0.2 * k, 0.3) for k in range(5)))
    torch.testing.assert_close(solution.state[0], expected, atol=0.2, rtol=0)


@BOTH
@pytest.mark.parametrize("residual", [rosenbrock, curve_fit], ids=["rosenbrock", "curves"])
def test_a_batch_equals_its_elements_solved_alone(damping, residual):
    D = 2 if residual is rosenbrock else 3
    start = 1 + torch.randn(6, D, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    start[0] = 1.0  # which ends at once, or later than the others
    config = precise(damping=damping, max_steps=60)
    together = Problem(residual).solve(start, config)
    assert len(set(together.steps.tolist())) > 1
    for k in range(6):
        alone = Problem(lambda x, _, k=k: residual(x, torch.tensor(k))).solve(start[k : k + 1], config)
        torch.testing.assert_close(together.state[0][k], alone.state[0][0], atol=1e-9, rtol=0)
        assert together.status[k] == alone.status[0]
        assert abs(int(together.steps[k] - alone.steps[0])) <= 1  # the last digits decide about a last step
        torch.testing.assert_close(together.equations.H[k], alone.equations.H[0], rtol=1e-6, atol=1e-9)


def test_elements_that_have_ended_leave_the_work():
    problem = Problem(rosenbrock)
    solution = problem.solve(starts((1.0, 1.0), (-1.2, 1.0), (3.0, -2.0)), precise(max_steps=200))
    sizes = [len(index) for _, index in problem.asked]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 3
    asked = torch.stack([(torch.stack([(index == k).any() for _, index in problem.asked])).sum() for k in range(3)])
    # Once at the start and once a step, but for a last step below the tolerance, which needs none.
    assert ((asked - 1 == solution.steps) | (asked == solution.steps)).all()


def test_a_start_at_an_exact_minimum_has_converged():
    solution = Problem(rosenbrock).solve(starts((1.0, 1.0)), LMConfig())
    assert status(solution) == ["CONVERGED"]
    assert solution.state[0].tolist() == [[1.0, 1.0]]


def test_parameters_that_are_not_free_stay():
    start = starts((1.5, 1.0, 0.3), (2.5, 0.4, 0.1))
    solution = Problem(curve_fit).solve(start, precise(max_steps=100), free=[True, True, False])
    assert torch.equal(solution.state[0][:, 2], start[:, 2])
    assert status(solution) == ["CONVERGED"] * 2
    assert solution.equations.g[:, :2].abs().max() < 1e-6
    # The equations at the end hold all parameters.
    assert (solution.equations.g[:, 2].abs() > 1e-3).all()
    assert (solution.equations.H[:, 2, 2] > 1).all()


def test_costs_are_compared_per_weight():
    # Half of the samples leave the view beyond x = 2: the sum of the costs falls there, their mean rises.
    def linearize(state: tuple[Tensor, ...], index: Tensor) -> NormalEquations:
        x = state[0][:, 0]
        weight = torch.where(x > 2, 50.0, 100.0).double()
        r = x - 3
        mean = torch.where(x > 2, 0.8, 0.5 * r * r)
        H, g = weight[:, None, None] * torch.ones(len(x), 1, 1), (weight * r)[:, None]
        return NormalEquations(H.double(), g, mean * weight, weight, 2 * mean * weight)

    solution = minimize(
        linearize, lambda s, d: (s[0] + d,), (starts((1.8,)),), LMConfig(),
        step_scale=torch.ones(1, 1), free=torch.tensor([True]), min_weight=10.0,
    )  # fmt: skip
    assert float(solution.state[0]) <= 2
    assert float(solution.state[0]) > 1.9


def test_running_out_of_steps_keeps_the_best_state():
    problem = Problem(rosenbrock)
    solution = problem.solve(starts((-1.2, 1.0)), LMConfig(max_steps=3))
    assert status(solution) == ["MAX_STEPS"]
    assert solution.steps.tolist() == [3]
    costs = [float(0.5 * (rosenbrock(x[0], torch.tensor(0)) ** 2).sum()) for x, _ in problem.asked]
    assert float(solution.equations.cost) == pytest.approx(min(costs))


@BOTH
@pytest.mark.parametrize("tolerance", [LMConfig().cost_tolerance, 1e-12])
def test_a_wrong_slope_stalls(damping, tolerance):
    # The slope points uphill: no step lowers the cost, however short.
    def linearize(state: tuple[Tensor, ...], index: Tensor) -> NormalEquations:
        x = state[0]
        one = torch.ones_like(x[:, 0])
        return NormalEquations(one[:, None, None], -one[:, None], 100 + x[:, 0], 100 * one, one)

    solution = minimize(
        linearize, lambda s, d: (s[0] + d,), (starts((0.5,)),), LMConfig(damping=damping, cost_tolerance=tolerance),
        step_scale=torch.ones(1, 1), free=torch.tensor([True]), min_weight=10.0,
    )  # fmt: skip
    assert status(solution) == ["STALLED"]
    assert solution.state[0].tolist() == [[0.5]]


@BOTH
def test_what_is_not_determined_is_singular(damping):
    problem = Problem(lambda x, k: torch.stack([x[0] + x[1] - 1, 2 * (x[0] + x[1]) + k]) * torch.where(k == 1, 1.0, 0.0)
                      + torch.where(k == 1, 0.0, 1.0) * torch.stack([x[0] - 1, x[1] ** 3 - 8]))  # fmt: skip
    solution = problem.solve(starts((3.0, 1.5), (3.0, 1.5), (0.0, 1.0)), precise(damping=damping, max_steps=60))
    # Damping makes a singular H solvable along what is determined; a parameter without any slope stays singular.
    assert status(solution)[0] == status(solution)[2] == "CONVERGED"
    torch.testing.assert_close(solution.state[0][[0, 2]], starts((1.0, 2.0), (1.0, 2.0)), atol=1e-6, rtol=0)
    blind = Problem(lambda x, k: torch.stack([x[0] - 1, 0 * x[1]]))
    ended = blind.solve(starts((3.0, 1.5)), LMConfig(damping=damping))
    assert status(ended) == ["SINGULAR"]
    assert ended.state[0].tolist() == [[3.0, 1.5]]


def test_too_little_weight_and_a_cost_that_is_not_finite_end_at_once():
    def residual(x: Tensor, k: Tensor) -> Tensor:
        return rosenbrock(x, k) + torch.where(k == 1, torch.nan, 0.0)

    problem = Problem(residual)
    start = starts((-1.2, 1.0), (-1.2, 1.0), (3.0, 1.0))
    solution = problem.solve(start, precise(max_steps=300))
    assert status(solution) == ["CONVERGED", "DIVERGED", "CONVERGED"]
    assert torch.equal(solution.state[0][1], start[1])
    assert solution.steps[1] == 0
    torch.testing.assert_close(solution.state[0][[0, 2]], starts((1.0, 1.0), (1.0, 1.0)), atol=1e-5, rtol=0)
    few = problem.solve(start, LMConfig(), min_weight=101.0)
    assert status(few) == ["TOO_FEW_PIXELS"] * 3
    assert torch.equal(few.state[0], start)


@BOTH
def test_steps_into_what_is_not_finite_or_out_of_view_are_refused(damping):
    # Beyond x = 0 nothing is finite; the full step from 1 would land there.
    problem = Problem(lambda x, k: torch.stack([torch.log(x[0]) + 2.0, 1e-3 * x[0]]))
    solution = problem.solve(starts((1.0,)), precise(damping=damping, max_steps=100))
    assert status(solution) == ["CONVERGED"]
    torch.testing.assert_close(solution.state[0], starts((0.13533,)), atol=1e-4, rtol=0)


def test_the_lsd_schedule_is_that_of_equations_7():
    # Algorithm 3: 0; refused: 0.2, then times 2^try; kept: halved, and 0 once it is at most 0.2.
    config = LMConfig(damping="lsd")
    yes, no, gain = torch.tensor([True]), torch.tensor([False]), torch.tensor([0.1])
    damping = initial_damping(config, torch.zeros(1, 8, dtype=torch.float64))
    seen = [float(damping.value)]
    for accepted in (no, no, no, yes, yes, yes, yes, yes, yes, no, yes, no, no, yes, no):
        damping = next_damping(config, damping, accepted, gain)
        seen.append(float(damping.value))
    tries_1 = [0, 0.2, 0.2 * 4, 0.2 * 4 * 8]
    halvings = [3.2, 1.6, 0.8, 0.4, 0.2, 0.0]
    again = [0.2, 0.0, 0.2, 0.8, 0.4, 0.4 * 2]
    assert seen == pytest.approx(tries_1 + halvings + again)


def test_the_gain_ratio_schedule_is_nielsens():
    config = LMConfig()
    start = initial_damping(config, torch.zeros(3, 8, dtype=torch.float64))
    assert start.value.tolist() == [1e-3] * 3
    gain = torch.tensor([1.0, 0.5, 0.1], dtype=torch.float64)
    after = next_damping(config, start, torch.ones(3, dtype=torch.bool), gain)
    expected = [1e-3 * max(1 / 3, 1 - (2 * g - 1) ** 3) for g in gain.tolist()]
    assert after.value.tolist() == pytest.approx(expected)
    refused = torch.zeros(3, dtype=torch.bool)
    values = []
    damping: Damping = start
    for _ in range(4):
        damping = next_damping(config, damping, refused, gain)
        values.append(float(damping.value[0]))
    assert values == pytest.approx([2e-3, 8e-3, 64e-3, 1.024])
    mixed = next_damping(config, damping, torch.tensor([True, False, True]), gain)
    assert mixed.value[1] > damping.value[1]
    assert mixed.value[0] < damping.value[0]
    assert mixed.growth.tolist() == [2, 64, 2]


def test_each_element_has_its_own_damping():
    # Element 0's first steps are refused, element 1's are not: were lambda shared, 1 would be slowed down by 0.
    def residual(x: Tensor, k: Tensor) -> Tensor:
        return torch.where(k == 0, torch.atan(5 * x), x - 7)

    together = Problem(residual)
    solution = together.solve(starts((3.0,), (0.0,)), precise(damping="lsd", max_steps=100))
    assert status(solution) == ["CONVERGED"] * 2
    torch.testing.assert_close(together.asked[1][0][1], torch.tensor([7.0], dtype=torch.float64))
    assert solution.steps[0] > 3
    assert solution.steps[1] <= 2


def test_every_status_has_a_sentence():
    sentences = {value.sentence for value in Status}
    assert len(sentences) == len(Status) == 7
    assert all(sentence.endswith(".") and sentence[0].isupper() for sentence in sentences)


def test_bad_settings_are_named():
    with pytest.raises(InputError, match=r"^max_steps: expected at least 1, got 0\.$"):
        LMConfig(max_steps=0)
    with pytest.raises(InputError, match=r"^damping: expected one of gain_ratio, lsd, got 'fixed'\.$"):
        LMConfig(damping="fixed")
    for name in ("initial_damping", "max_damping", "step_tolerance", "cost_tolerance"):
        config = LMConfig()
        setattr(config, name, -1)
        with pytest.raises(InputError, match=rf"^{name}: expected a finite number above 0, got -1\.$"):
            config.__post_init__()
