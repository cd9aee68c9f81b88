"""The linear filter: a batch solution, its consistency, its numerical form, its failures; and the planar model."""

import math

import pytest
import torch
from jaxtyping import Float64
from torch import Tensor
from torch.func import jacfwd

from torchvo360 import lie
from torchvo360.checks import InputError, ShapeError
from torchvo360.motion import Gaussian, PlanarMotion, constant_velocity, correct, predict, smooth, update

F64 = torch.float64
ACCELERATION = torch.tensor([0.7, 1.3], dtype=F64)
C_POSITION = torch.eye(4, dtype=F64)[::2]
R_POSITION = torch.tensor([[0.04, 0.01], [0.01, 0.09]], dtype=F64)


def chi_square_mean_interval(dof: int, runs: int) -> tuple[float, float]:
    """The 95 % interval of the mean of `runs` chi-square values, by Wilson and Hilferty's cube."""
    n = dof * runs
    low, high = (n * (1 - 2 / (9 * n) + side * math.sqrt(2 / (9 * n))) ** 3 for side in (-1.959964, 1.959964))
    return low / runs, high / runs


def nees(error: Float64[Tensor, "*batch D"], covariance: Float64[Tensor, "*batch D D"]) -> Float64[Tensor, "*batch"]:
    return (error * torch.linalg.solve(covariance, error)).sum(-1)


def sequence(steps: int, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Uneven steps, A and Q of two axes, and noisy positions z [steps + 1, 2]."""
    generator = torch.Generator().manual_seed(seed)
    dt_s = 0.05 + 0.2 * torch.rand(steps, generator=generator, dtype=F64)
    z = torch.randn(steps + 1, 2, generator=generator, dtype=F64).cumsum(0)
    return dt_s, *constant_velocity(dt_s, ACCELERATION), z


def run_filter(start: Gaussian, A: Tensor, Q: Tensor, z: Tensor) -> Gaussian:
    """Updated states with time first."""
    states = [update(start, z[0], C_POSITION, R_POSITION)[0]]
    for k in range(len(A)):
        states.append(update(predict(states[-1], A[k], Q[k]), z[k + 1], C_POSITION, R_POSITION)[0])
    return Gaussian(torch.stack([s.mean for s in states]), torch.stack([s.covariance for s in states]))


def batch_solution(start: Gaussian, dt_s: Tensor, A: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """All states by one least-squares problem in the first state and the accelerations: no recursion over Gaussians."""
    N = len(dt_s)
    unknowns = 4 + 2 * N
    maps = [torch.eye(4, unknowns, dtype=F64)]
    for k in range(N):
        by_acceleration = torch.zeros(4, unknowns, dtype=F64)
        for axis in range(2):
            by_acceleration[2 * axis, 4 + 2 * k + axis] = dt_s[k] ** 2 / 2
            by_acceleration[2 * axis + 1, 4 + 2 * k + axis] = dt_s[k]
        maps.append(A[k] @ maps[-1] + by_acceleration)
    prior = torch.block_diag(start.covariance, *[torch.diag(ACCELERATION**2)] * N)
    mean = torch.cat([start.mean, torch.zeros(2 * N, dtype=F64)])
    rows = torch.cat([C_POSITION @ one for one in maps])
    information = torch.block_diag(*[torch.linalg.inv(R_POSITION)] * (N + 1))
    normal = torch.linalg.inv(prior) + rows.mT @ information @ rows
    solution = mean + torch.linalg.solve(normal, rows.mT @ information @ (z.flatten() - rows @ mean))
    spread = torch.linalg.inv(normal)
    return torch.stack([one @ solution for one in maps]), torch.stack([one @ spread @ one.mT for one in maps])


START = Gaussian(torch.tensor([0.3, -0.2, 0.5, 1.0], dtype=F64), torch.diag(torch.tensor([1.0, 4.0, 2.0, 3.0])).to(F64))


class TestLinearFilter:
    def test_last_state_is_the_batch_least_squares_solution(self) -> None:
        dt_s, A, Q, z = sequence(25, seed=1)
        filtered = run_filter(START, A, Q, z)
        mean, covariance = batch_solution(START, dt_s, A, z)
        torch.testing.assert_close(filtered.mean[-1], mean[-1], rtol=0, atol=1e-9)
        torch.testing.assert_close(filtered.covariance[-1], covariance[-1], rtol=0, atol=1e-9)

    def test_smoothed_states_are_the_batch_least_squares_solution(self) -> None:
        dt_s, A, Q, z = sequence(25, seed=2)
        smoothed, ok = smooth(run_filter(START, A, Q, z), A, Q)
        mean, covariance = batch_solution(START, dt_s, A, z)
        assert bool(ok)
        torch.testing.assert_close(smoothed.mean, mean, rtol=0, atol=1e-8)
        torch.testing.assert_close(smoothed.covariance, covariance, rtol=0, atol=1e-8)

    def test_joseph_form_stays_symmetric_and_positive_where_the_plain_form_fails(self) -> None:
        A, Q = constant_velocity(torch.tensor(0.01, dtype=F64), torch.tensor([1e-6], dtype=F64))
        C, R = torch.tensor([[1.0, 0.0]], dtype=F64), torch.tensor([[1e-12]], dtype=F64)
        state = Gaussian(torch.zeros(2, dtype=F64), 1e6 * torch.eye(2, dtype=F64))
        plain, plain_skew, plain_negative = state.covariance, 0, 0
        z, eye = torch.zeros(1, dtype=F64), torch.eye(2, dtype=F64)
        for _ in range(10_000):
            state, innovation = update(predict(state, A, Q), z, C, R)
            assert bool(innovation.ok)
            assert torch.equal(state.covariance, state.covariance.mT)
            assert int(torch.linalg.cholesky_ex(state.covariance).info) == 0
            plain = A @ plain @ A.mT + Q
            plain = (eye - plain @ C.mT / (C @ plain @ C.mT + R) @ C) @ plain
            plain_skew += not torch.equal(plain, plain.mT)
            plain_negative += int(torch.linalg.cholesky_ex((plain + plain.mT) / 2).info) != 0
        assert plain_skew > 5_000
        assert plain_negative > 100

    @pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
    def test_a_batch_is_its_elements(self, batch: tuple[int, ...]) -> None:
        generator = torch.Generator().manual_seed(3)
        mean = torch.randn(*batch, 4, generator=generator, dtype=F64)
        spread = torch.randn(*batch, 4, 4, generator=generator, dtype=F64)
        state = Gaussian(mean, spread @ spread.mT + torch.eye(4, dtype=F64))
        dt_s = torch.rand(batch, generator=generator, dtype=F64)
        z = torch.randn(*batch, 2, generator=generator, dtype=F64)
        together, seen = update(predict(state, *constant_velocity(dt_s, ACCELERATION)), z, C_POSITION, R_POSITION)
        assert together.mean.shape == (*batch, 4)
        assert seen.mahalanobis2.shape == batch
        for index in torch.cartesian_prod(*[torch.arange(n) for n in (1, *batch)]).reshape(-1, len(batch) + 1)[:, 1:]:
            at = tuple(index.tolist())
            one = Gaussian(state.mean[at], state.covariance[at])
            alone, _ = update(predict(one, *constant_velocity(dt_s[at], ACCELERATION)), z[at], C_POSITION, R_POSITION)
            torch.testing.assert_close(together.mean[at], alone.mean, rtol=0, atol=1e-13)
            torch.testing.assert_close(together.covariance[at], alone.covariance, rtol=0, atol=1e-13)

    @pytest.mark.parametrize("fault", ["z is NaN", "z is infinite", "R is NaN", "R is infinite", "R is negative"])
    def test_a_failed_element_keeps_its_prediction_and_leaves_its_neighbours_untouched(self, fault: str) -> None:
        _, _, _, z = sequence(3, seed=4)
        R = R_POSITION.expand(4, 2, 2).clone()
        state = Gaussian(START.mean.expand(4, 4), START.covariance.expand(4, 4, 4))
        sound, _ = update(state, z, C_POSITION, R)
        value = {"NaN": math.nan, "infinite": math.inf, "negative": -100.0}[fault.split()[-1]]
        if fault.startswith("z"):
            z[2, 1] = value
        else:
            R[2] = value * torch.eye(2, dtype=F64)
        z, R, prior = z.requires_grad_(), R.requires_grad_(), state.covariance.clone().requires_grad_()
        found, innovation = update(Gaussian(state.mean, prior), z, C_POSITION, R)
        assert innovation.ok.tolist() == [True, True, False, True]
        assert bool(torch.isposinf(innovation.mahalanobis2[2]))
        assert bool(torch.isfinite(innovation.residual).all() & torch.isfinite(innovation.covariance).all())
        others = [0, 1, 3]
        assert torch.equal(found.mean[others], sound.mean[others])
        assert torch.equal(found.covariance[others], sound.covariance[others])
        assert torch.equal(found.mean[2], START.mean)
        assert torch.equal(found.covariance[2], START.covariance)
        gradients = torch.autograd.grad(found.mean.sum() + found.covariance.sum(), (z, R, prior))
        assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)

    def test_gradients_of_an_update_are_those_of_finite_differences(self) -> None:
        def final_mean(z: Tensor, R: Tensor) -> Tensor:
            return update(START, z, C_POSITION, (R + R.mT) / 2)[0].mean

        z = torch.tensor([0.5, -0.4], dtype=F64, requires_grad=True)
        assert torch.autograd.gradcheck(final_mean, (z, R_POSITION.clone().requires_grad_()))

    def test_a_singular_prediction_smooths_nothing_and_says_so(self) -> None:
        still = torch.zeros(3, 2, 2, 2, dtype=F64)
        still[:, 1] = torch.eye(2, dtype=F64)
        filtered = Gaussian(torch.arange(12, dtype=F64).view(3, 2, 2), still)
        smoothed, ok = smooth(filtered, torch.eye(2, dtype=F64), 0.1 * still[1:])
        assert ok.tolist() == [False, True]
        assert torch.equal(smoothed.mean[:, 0], filtered.mean[:, 0])
        assert not torch.equal(smoothed.mean[0, 1], filtered.mean[0, 1])

    def test_wrong_shapes_and_dtypes_are_refused(self) -> None:
        with pytest.raises(ShapeError, match="covariance: expected shape"):
            Gaussian(torch.zeros(3, dtype=F64), torch.zeros(2, 2, dtype=F64))
        with pytest.raises(InputError, match="mean: expected float64"):
            Gaussian(torch.zeros(2), torch.eye(2))
        with pytest.raises(ShapeError, match="z: expected shape"):
            update(START, torch.zeros(3, dtype=F64), C_POSITION, R_POSITION)
        with pytest.raises(ShapeError, match="R: expected shape"):
            correct(START, torch.zeros(2, dtype=F64), C_POSITION, torch.eye(3, dtype=F64))
        with pytest.raises(InputError, match="time as the first axis"):
            smooth(START, torch.eye(4, dtype=F64), torch.eye(4, dtype=F64))


def test_constant_velocity_is_the_matrix_of_equations_section_9() -> None:
    T, k = 0.5, 3.0
    A, Q = constant_velocity(torch.tensor(T, dtype=F64), torch.tensor([k, 2 * k], dtype=F64))
    block = k**2 * torch.tensor([[T**4 / 4, T**3 / 2], [T**3 / 2, T**2]], dtype=F64)
    step = torch.tensor([[1.0, T], [0.0, 1.0]], dtype=F64)
    torch.testing.assert_close(A, torch.block_diag(step, step))
    torch.testing.assert_close(Q, torch.block_diag(block, 4 * block))


class PlanarRuns:
    """200 runs of the planar model at once: truth and measurements drawn from it."""

    MODEL = PlanarMotion(acceleration=0.8, turn_acceleration=1.5)
    R = torch.diag(torch.tensor([0.02, 0.03, 0.05], dtype=F64) ** 2)
    DT = torch.tensor(0.1, dtype=F64)
    RUNS, STEPS = 200, 60

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)

        def noise(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=F64)

        covariance = torch.diag(torch.tensor([0.1, 1.0, 0.1, 1.0, 0.3, 2.0], dtype=F64) ** 2)
        self.start = Gaussian(torch.zeros(self.RUNS, 6, dtype=F64), covariance.expand(self.RUNS, 6, 6))
        truth = [noise(self.RUNS, 6) @ covariance.sqrt()]
        # The accelerations themselves are drawn, not the noise of Q.
        k = torch.tensor([0.8, 0.8, 1.5], dtype=F64)
        for _ in range(self.STEPS):
            x, speed = truth[-1][:, ::2], truth[-1][:, 1::2]
            acceleration = k * noise(self.RUNS, 3)
            x = x + speed * self.DT + acceleration * self.DT**2 / 2
            truth.append(torch.stack([x, speed + acceleration * self.DT], -1).flatten(1))
        self.truth = torch.stack(truth)
        self.z = self.truth[1:, :, ::2] + noise(self.STEPS, self.RUNS, 3) @ self.R.sqrt()
        turns = torch.randint(-2, 3, self.z.shape[:2], generator=generator)
        self.z[..., 2] += math.tau * turns

    def filtered(self, model: PlanarMotion) -> tuple[Gaussian, Tensor]:
        """States at every time, and the squared Mahalanobis distances of the measurements."""
        state, states, distances = self.start, [], []
        for z in self.z:
            state, innovation = model.update(model.predict(state, self.DT), z, self.R)
            states.append(state)
            distances.append(innovation.mahalanobis2)
        stacked = Gaussian(torch.stack([s.mean for s in states]), torch.stack([s.covariance for s in states]))
        return stacked, torch.stack(distances)


class TestPlanarMotion:
    def test_nees_lies_within_its_95_percent_bounds(self) -> None:
        runs = PlanarRuns(seed=0)
        states, distances = runs.filtered(runs.MODEL)
        low, high = chi_square_mean_interval(6, runs.RUNS)
        mean = nees(runs.truth[1:] - states.mean, states.covariance).mean(1)
        assert low < float(mean[-1]) < high
        assert float(((low < mean) & (mean < high)).double().mean()) > 0.85
        low, high = chi_square_mean_interval(3, distances.numel())
        assert low < float(distances.mean()) < high

    @pytest.mark.parametrize("factor", [0.6, 1.6])
    def test_nees_tells_a_filter_with_the_wrong_noise(self, factor: float) -> None:
        runs = PlanarRuns(seed=0)
        states, _ = runs.filtered(PlanarMotion(acceleration=0.8 * factor, turn_acceleration=1.5 * factor))
        low, high = chi_square_mean_interval(6, runs.RUNS)
        mean = float(nees(runs.truth[-1] - states.mean[-1], states.covariance[-1]).mean())
        assert mean > high if factor < 1 else mean < low

    def test_smoothing_lowers_the_error_and_is_consistent(self) -> None:
        runs = PlanarRuns(seed=5)
        states, _ = runs.filtered(runs.MODEL)
        k = torch.tensor([0.8, 0.8, 1.5], dtype=F64)
        smoothed, ok = smooth(states, *constant_velocity(runs.DT, k))
        assert bool(ok.all())
        before = (runs.truth[1:] - states.mean).square().mean((0, 1)).sqrt()
        after = (runs.truth[1:] - smoothed.mean).square().mean((0, 1)).sqrt()
        assert bool((after < 0.8 * before).all())
        low, high = chi_square_mean_interval(6, runs.RUNS)
        middle = runs.STEPS // 2
        assert (
            low < float(nees(runs.truth[1 + middle] - smoothed.mean[middle], smoothed.covariance[middle]).mean()) < high
        )

    def test_heading_runs_on_through_pi(self) -> None:
        model, dt = PlanarMotion(), torch.tensor(0.1, dtype=F64)
        R = 1e-4 * torch.eye(3, dtype=F64)
        state = Gaussian(torch.zeros(6, dtype=F64), torch.eye(6, dtype=F64))
        headings = []
        for step in range(1, 101):
            theta = 0.1 * step
            T_world_cam = lie.se3(lie.so3_exp(torch.tensor([0.0, theta, 0.0], dtype=F64)), torch.zeros(3, dtype=F64))
            z = model.from_pose(T_world_cam)
            assert float(z[2].abs()) <= math.pi
            state, innovation = model.update(model.predict(state, dt), z, R)
            assert float(innovation.residual[2].abs()) < 0.2
            headings.append(float(state.mean[4]))
        assert headings[-1] == pytest.approx(10.0, abs=0.01)
        assert float(state.mean[5]) == pytest.approx(1.0, abs=0.01)

    @pytest.mark.parametrize("theta", [-3.1, -1.0, 0.0, 0.4, 3.14159])
    @pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)], ids=["pitch", "roll"])
    @pytest.mark.parametrize("tilt", [0.0, 1.0, math.pi / 2, 3.0])
    def test_heading_is_the_turn_about_the_vertical_whatever_the_pitch_or_roll(
        self, theta: float, axis: tuple[float, float, float], tilt: float
    ) -> None:
        turn = lie.so3_exp(torch.tensor([0.0, theta, 0.0], dtype=F64))
        tilted = lie.so3_exp(tilt * torch.tensor(axis, dtype=F64))
        t = torch.tensor([1.0, 2.0, 3.0], dtype=F64)
        z = PlanarMotion().from_pose(lie.se3(turn @ tilted, t))
        torch.testing.assert_close(z, torch.tensor([1.0, 3.0, theta], dtype=F64), rtol=0, atol=1e-12)

    def test_an_upside_down_camera_has_heading_zero_and_finite_gradients(self) -> None:
        T = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=F64)).requires_grad_()
        z = PlanarMotion().from_pose(T)
        (gradient,) = torch.autograd.grad(z.sum(), T)
        assert float(z[2].detach()) == 0
        assert bool(torch.isfinite(gradient).all())

    def test_measurement_covariance_is_that_of_the_derivative(self) -> None:
        generator = torch.Generator().manual_seed(6)
        tangent = torch.randn(8, 6, generator=generator, dtype=F64)
        factor = torch.randn(8, 6, 6, generator=generator, dtype=F64)
        covariance = factor @ factor.mT
        model, T_world_cam = PlanarMotion(), lie.se3_exp(tangent)

        def measured(xi: Tensor) -> Tensor:
            return model.from_pose(lie.se3_inverse(lie.se3_exp(xi) @ lie.se3_inverse(T_world_cam)))

        J = jacfwd(measured)(torch.zeros(8, 6, dtype=F64)).diagonal(dim1=0, dim2=2).permute(2, 0, 1)
        expected = J @ covariance @ J.mT
        torch.testing.assert_close(
            model.measurement_covariance(T_world_cam, covariance), expected, rtol=1e-10, atol=1e-10
        )

    def test_an_impossible_acceleration_is_refused(self) -> None:
        with pytest.raises(InputError, match="turn_acceleration: expected a finite number above 0"):
            PlanarMotion(turn_acceleration=0.0)
