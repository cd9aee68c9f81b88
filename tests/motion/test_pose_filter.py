"""The filter on SE(3): its error dynamics, consistency, changes of frame and unit, failures, and smoothing."""

import math

import pytest
import torch
from jaxtyping import Float64
from torch import Tensor
from torch.func import jacfwd

from torchvo360 import lie
from torchvo360.checks import InputError
from torchvo360.motion import (
    Gaussian,
    PoseFilter,
    PoseFilterConfig,
    PoseState,
    predict,
    smooth,
    smooth_trajectory,
    update,
)
from torchvo360.motion.pose_filter import transition

F64 = torch.float64
DENSITY2 = torch.tensor([0.04, 0.04, 0.04, 1.0, 1.0, 1.0], dtype=F64)
R = torch.diag(torch.tensor([0.01] * 3 + [0.02] * 3, dtype=F64) ** 2)


def tangent(*values: float) -> Float64[Tensor, "6"]:
    return torch.tensor(values, dtype=F64)


def random_state(batch: tuple[int, ...], seed: int) -> PoseState:
    """A state in full motion, with a full covariance."""
    generator = torch.Generator().manual_seed(seed)
    T = lie.se3_exp(torch.randn(*batch, 6, generator=generator, dtype=F64))
    twist = torch.randn(*batch, 6, generator=generator, dtype=F64)
    factor = 0.1 * torch.randn(*batch, 12, 12, generator=generator, dtype=F64)
    covariance = factor @ factor.mT + 1e-3 * torch.eye(12, dtype=F64)
    return PoseState(T, twist, covariance, 2.0)


def assert_states_close(actual: PoseState, expected: PoseState, atol: float = 1e-12) -> None:
    for name in ("T_cam_key", "twist", "covariance"):
        torch.testing.assert_close(getattr(actual, name), getattr(expected, name), rtol=0, atol=atol)
    assert actual.median_range == pytest.approx(expected.median_range)


class TestTransition:
    TURNS = (
        tangent(0, 0, 0, 0, 0, 0),
        tangent(3, -1, 2, 0, 0, 0),
        tangent(1, 2, -1, 1e-9, 0, -1e-9),
        tangent(1, 2, -1, 0.3, -0.5, 0.2),
        tangent(-2, 1, 1, 0, math.pi - 1e-7, 0),
        tangent(-2, 1, 1, 0, 0, math.pi),
        tangent(1, 1, 5, 3, -2, 2.5),
    )

    @pytest.mark.parametrize("moved", TURNS)
    @pytest.mark.parametrize("dt", [0.03, 1.0])
    def test_jacobian_is_that_of_the_motion_itself(self, moved: Tensor, dt: float) -> None:
        twist = moved / dt
        T = lie.se3_exp(tangent(0.5, -1, 2, 1, 2, -1))
        back = lie.se3_inverse(lie.se3_exp(twist * dt) @ T)

        def error_after(error: Tensor) -> Tensor:
            T_true = lie.se3_exp((twist + error[6:]) * dt) @ lie.se3_exp(error[:6]) @ T
            return torch.cat([lie.se3_log(T_true @ back), error[6:]])

        F, _ = transition(twist, torch.tensor(dt, dtype=F64), DENSITY2)
        torch.testing.assert_close(F, jacfwd(error_after)(torch.zeros(12, dtype=F64)), rtol=0, atol=1e-10)

    @pytest.mark.parametrize("moved", TURNS)
    def test_two_uneven_steps_are_one_step(self, moved: Tensor) -> None:
        times = torch.tensor([0.3, 0.7, 1.0], dtype=F64)
        F, Q = transition(moved, times, DENSITY2)
        torch.testing.assert_close(F[1] @ F[0], F[2], rtol=0, atol=1e-11)
        torch.testing.assert_close(F[1] @ Q[0] @ F[1].mT + Q[1], Q[2], rtol=0, atol=1e-10)

    def test_noise_at_rest_is_that_of_white_acceleration(self) -> None:
        T = 0.2
        _, Q = transition(torch.zeros(6, dtype=F64), torch.tensor(T, dtype=F64), DENSITY2)
        axis = torch.tensor([[T**3 / 3, T**2 / 2], [T**2 / 2, T]], dtype=F64)
        torch.testing.assert_close(Q, torch.kron(axis, torch.diag(DENSITY2)), rtol=0, atol=1e-14)


class PoseRuns:
    """200 runs of the filter's own model: white acceleration in 20 small steps between measurements, turning fast."""

    CONFIG = PoseFilterConfig(acceleration=0.3, turn_acceleration=1.2)
    DT, SUBSTEPS, STEPS, RUNS = 0.1, 20, 40, 200

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)

        def noise(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=F64)

        self.start = PoseFilter(self.CONFIG).start(torch.eye(4, dtype=F64).expand(self.RUNS, 4, 4), R)
        error = noise(self.RUNS, 12) @ self.start.covariance[0].sqrt()
        T, twist = lie.se3_exp(error[:, :6]), error[:, 6:]
        density = torch.tensor([0.3] * 3 + [1.2] * 3, dtype=F64)
        dt = self.DT / self.SUBSTEPS
        poses, twists = [], []
        for _ in range(self.STEPS):
            for _ in range(self.SUBSTEPS):
                kick = density * math.sqrt(dt) * noise(self.RUNS, 6)
                T, twist = lie.se3_exp((twist + kick / 2) * dt) @ T, twist + kick
            poses.append(T)
            twists.append(twist)
        self.T, self.twist = torch.stack(poses), torch.stack(twists)
        self.measured = lie.se3_exp(noise(self.STEPS, self.RUNS, 6) @ R.sqrt()) @ self.T

    def nees(self, config: PoseFilterConfig) -> tuple[Tensor, Tensor]:
        """Mean NEES at every step, and the squared Mahalanobis distances of the measurements."""
        motion, state = PoseFilter(config), self.start
        means, distances = [], []
        for k in range(self.STEPS):
            state, innovation = motion.update(motion.predict(state, self.DT), self.measured[k], R)
            xi = lie.se3_log(self.T[k] @ lie.se3_inverse(state.T_cam_key))
            error = torch.cat([xi, self.twist[k] - state.twist], -1)
            means.append((error * torch.linalg.solve(state.covariance, error)).sum(-1).mean())
            distances.append(innovation.mahalanobis2)
        return torch.stack(means), torch.stack(distances)


def chi_square_mean_interval(dof: int, runs: int) -> tuple[float, float]:
    """The 95 % interval of the mean of `runs` chi-square values; normal, as `dof * runs` is in the thousands."""
    half = 1.959964 * math.sqrt(2 * dof / runs)
    return dof - half, dof + half


class TestConsistency:
    def test_nees_lies_within_its_95_percent_bounds(self) -> None:
        runs = PoseRuns(seed=0)
        mean, distances = runs.nees(runs.CONFIG)
        low, high = chi_square_mean_interval(12, runs.RUNS)
        assert low < float(mean[-1]) < high
        assert float(((low < mean) & (mean < high)).double().mean()) > 0.85
        low, high = chi_square_mean_interval(6, distances.numel())
        assert low < float(distances.mean()) < high

    @pytest.mark.parametrize("factor", [0.6, 1.6])
    def test_nees_tells_a_filter_with_the_wrong_noise(self, factor: float) -> None:
        runs = PoseRuns(seed=0)
        mean, _ = runs.nees(PoseFilterConfig(acceleration=0.3 * factor, turn_acceleration=1.2 * factor))
        low, high = chi_square_mean_interval(12, runs.RUNS)
        assert float(mean[-1]) > high if factor < 1 else float(mean[-1]) < low

    def test_an_update_carries_its_covariance_to_the_moved_pose(self) -> None:
        state = random_state((), seed=1)
        xi = tangent(0.4, -0.2, 0.3, 0.5, 0.9, -0.4)
        covariance = state.prediction.covariance
        updated, _ = PoseFilter().update(state, lie.se3_exp(xi) @ state.T_cam_key, covariance)
        moved = lie.se3_log(updated.T_cam_key @ lie.se3_inverse(state.T_cam_key))
        torch.testing.assert_close(moved, xi / 2, rtol=0, atol=1e-12)

        def about_moved(error: Tensor) -> Tensor:
            return lie.se3_log(lie.se3_exp(xi / 2 + error) @ lie.se3_exp(-xi / 2))

        J = jacfwd(about_moved)(torch.zeros(6, dtype=F64))
        torch.testing.assert_close(updated.prediction.covariance, J @ covariance @ J.mT / 2, rtol=0, atol=1e-12)


class TestFilter:
    def test_constant_motion_is_learned_and_predicted(self) -> None:
        motion, twist = PoseFilter(), tangent(0.3, 0.1, -0.2, 0.5, -0.8, 0.4)
        state = motion.start(torch.eye(4, dtype=F64))
        for k in range(1, 60):
            T = lie.se3_exp(twist * k / 30)
            state, innovation = motion.update(motion.predict(state, 1 / 30), T, 1e-8 * torch.eye(6, dtype=F64))
            assert bool(motion.plausible(innovation))
        ahead = motion.predict(state, 0.5).prediction
        torch.testing.assert_close(ahead.T_cam_key, lie.se3_exp(twist * (59 / 30 + 0.5)), rtol=0, atol=1e-3)
        assert bool((ahead.covariance.diagonal() > state.prediction.covariance.diagonal()).all())

    @pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
    def test_a_batch_is_its_elements(self, batch: tuple[int, ...]) -> None:
        motion, state = PoseFilter(), random_state(batch, seed=2)
        generator = torch.Generator().manual_seed(3)
        dt_s = torch.rand(batch, generator=generator, dtype=F64)
        measured = lie.se3_exp(torch.randn(*batch, 6, generator=generator, dtype=F64))
        together, seen = motion.update(motion.predict(state, dt_s), measured, R)
        assert seen.ok.shape == batch
        for index in torch.cartesian_prod(*[torch.arange(n) for n in (1, *batch)]).reshape(-1, len(batch) + 1)[:, 1:]:
            at = tuple(index.tolist())
            one = PoseState(state.T_cam_key[at], state.twist[at], state.covariance[at], 2.0)
            alone, _ = motion.update(motion.predict(one, float(dt_s[at])), measured[at], R)
            here = PoseState(together.T_cam_key[at], together.twist[at], together.covariance[at], 2.0)
            assert_states_close(here, alone, atol=1e-10)

    def test_one_state_is_predicted_to_many_times(self) -> None:
        motion, state = PoseFilter(), random_state((), seed=10)
        dt_s = torch.tensor([0.0, 0.1, 0.5], dtype=F64)
        many = motion.predict(state, dt_s)
        assert many.T_cam_key.shape == (3, 4, 4)
        assert many.twist.shape == (3, 6)
        last = PoseState(many.T_cam_key[2], many.twist[2], many.covariance[2], 2.0)
        assert_states_close(last, motion.predict(state, 0.5))
        first = PoseState(many.T_cam_key[0], many.twist[0], many.covariance[0], 2.0)
        assert_states_close(first, state)

    @pytest.mark.parametrize("fault", ["pose", "skew pose", "covariance", "negative covariance"])
    def test_a_failed_element_keeps_its_prediction_and_leaves_its_neighbours_untouched(self, fault: str) -> None:
        motion, state = PoseFilter(), random_state((4,), seed=4)
        measured, covariance = state.T_cam_key @ lie.se3_exp(tangent(0.1, 0, 0, 0, 0.1, 0)), R.expand(4, 6, 6).clone()
        sound, _ = motion.update(state, measured, covariance)
        if fault == "pose":
            measured[2, 0, 3] = math.nan
        elif fault == "skew pose":
            measured[2, :3, :3] = 0
        else:
            covariance[2] = math.inf if fault == "covariance" else -1e3 * torch.eye(6, dtype=F64)
        measured.requires_grad_()
        found, innovation = motion.update(state, measured, covariance)
        assert innovation.ok.tolist() == [True, True, False, True]
        assert motion.plausible(innovation).tolist()[2] is False
        for name in ("T_cam_key", "twist", "covariance"):
            now = getattr(found, name).detach()
            assert torch.equal(now[[0, 1, 3]], getattr(sound, name)[[0, 1, 3]])
            torch.testing.assert_close(now[2], getattr(state, name)[2], rtol=0, atol=1e-14)
        (gradient,) = torch.autograd.grad(found.T_cam_key.sum() + found.covariance.sum(), measured)
        assert bool(torch.isfinite(gradient).all())

    def test_a_jump_is_not_plausible_and_time_makes_it_so(self) -> None:
        motion = PoseFilter()
        state = motion.start(torch.eye(4, dtype=F64))
        for _ in range(10):
            state, _ = motion.update(
                motion.predict(state, 1 / 30), torch.eye(4, dtype=F64), 1e-6 * torch.eye(6, dtype=F64)
            )
        jump = lie.se3_exp(tangent(0.2, 0, 0, 0, 0.5, 0))
        judged = [
            bool(motion.plausible(motion.update(motion.predict(state, dt), jump, 1e-6 * torch.eye(6, dtype=F64))[1]))
            for dt in (1 / 30, 2.0)
        ]
        assert judged == [False, True]

    def test_another_keyframe_changes_nothing_but_the_frame(self) -> None:
        motion, state = PoseFilter(), random_state((3,), seed=5)
        T_new_old = lie.se3_exp(tangent(1, -2, 0.5, 1, 0.3, -2))
        measured = lie.se3_exp(tangent(0.3, 0.1, 0, 0.1, 0, 0.1)) @ state.T_cam_key
        after, seen = motion.update(
            motion.predict(state.rekeyed(T_new_old), 0.1), measured @ lie.se3_inverse(T_new_old), R
        )
        before, expected = motion.update(motion.predict(state, 0.1), measured, R)
        assert_states_close(after, before.rekeyed(T_new_old))
        assert torch.equal(after.rekeyed(T_new_old, 7.0).covariance, after.covariance)
        torch.testing.assert_close(seen.mahalanobis2, expected.mahalanobis2, rtol=1e-9, atol=0)
        assert state.rekeyed(T_new_old, 7.0).median_range == 7.0

    def test_another_unit_of_length_changes_nothing_but_the_unit(self) -> None:
        motion, state, factor = PoseFilter(), random_state((3,), seed=6), 40.0
        measured = lie.se3_exp(tangent(0.3, 0.1, 0, 0.1, 0, 0.1)) @ state.T_cam_key
        unit = torch.diag(tangent(factor, factor, factor, 1, 1, 1))
        scaled = lie.se3(measured[:, :3, :3], measured[:, :3, 3] * factor)
        after, seen = motion.update(motion.predict(state.rescaled(factor), 0.1), scaled, unit @ R @ unit)
        before, expected = motion.update(motion.predict(state, 0.1), measured, R)
        assert_states_close(after, before.rescaled(factor), atol=1e-9)
        torch.testing.assert_close(seen.mahalanobis2, expected.mahalanobis2, rtol=1e-9, atol=0)

    def test_the_unknown_speed_at_the_start_is_in_ranges_of_the_scene(self) -> None:
        motion, T = PoseFilter(), lie.se3_exp(tangent(1, 2, 3, 0.1, 0.2, 0.3))
        far = motion.start(lie.se3(T[:3, :3], 3 * T[:3, 3]), median_range=3.0)
        assert_states_close(far, motion.start(T).rescaled(3.0))

    def test_a_thousand_turning_steps_stay_a_rotation_and_positive(self) -> None:
        motion = PoseFilter()
        state = motion.start(torch.eye(4, dtype=F64).expand(2, 4, 4))
        state = PoseState(state.T_cam_key, state.twist + tangent(0, 0, 1, 0.3, 2, 0), state.covariance, 1.0)
        tiny = 1e-14 * torch.eye(6, dtype=F64)
        for k in range(1_000):
            state = motion.predict(state, 1 / 30)
            state, innovation = motion.update(state, state.T_cam_key, tiny)
            assert bool(innovation.ok.all()), k
            assert torch.equal(state.covariance, state.covariance.mT)
        assert int(torch.linalg.cholesky_ex(state.covariance).info.abs().sum()) == 0
        rotation = state.T_cam_key[:, :3, :3]
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=F64).expand(2, 3, 3), rtol=0, atol=1e-14)

    def test_what_cannot_be_is_refused_in_a_sentence(self) -> None:
        motion, eye = PoseFilter(), torch.eye(4, dtype=F64)
        with pytest.raises(InputError, match="turn_acceleration: expected a finite number above 0, got -1"):
            PoseFilterConfig(turn_acceleration=-1.0)
        with pytest.raises(InputError, match="T_cam_key: expected rigid motions"):
            motion.start(2 * eye)
        with pytest.raises(InputError, match="median_range: expected a finite number above 0"):
            motion.start(eye, median_range=0.0)
        with pytest.raises(InputError, match="covariance: expected finite numbers"):
            motion.start(eye, math.inf * torch.eye(6, dtype=F64))
        with pytest.raises(InputError, match=r"dt_s: expected finite numbers of at least 0, got -0\.1"):
            motion.predict(motion.start(eye), -0.1)
        with pytest.raises(InputError, match="factor: expected a finite number above 0"):
            motion.start(eye).rescaled(0.0)


def wavy(count: int) -> tuple[Tensor, Tensor]:
    """Uneven times and a smooth trajectory T_world_cam that turns and swings."""
    t = torch.arange(count, dtype=F64) / 20 + 0.01 * torch.sin(torch.arange(count, dtype=F64))
    zero = torch.zeros_like(t)
    rotation = lie.so3_exp(torch.stack([0.2 * torch.sin(2 * t), 0.8 * t, zero], -1))
    position = torch.stack([torch.cos(t), 0.1 * torch.sin(3 * t), torch.sin(t)], -1)
    return (t * 1e9).round().to(torch.int64), lie.se3(rotation, position)


def left_error(T_world_cam: Tensor, T_true: Tensor) -> Float64[Tensor, "N 6"]:
    """xi of T_cam_world,true = Exp(xi) T_cam_world."""
    return lie.se3_log(lie.se3_inverse(T_true) @ T_world_cam)


class TestSmoothing:
    def test_smoothing_lowers_the_error_of_position_and_rotation(self) -> None:
        t_ns, truth = wavy(80)
        generator = torch.Generator().manual_seed(7)
        noise = torch.randn(80, 6, generator=generator, dtype=F64) @ R.sqrt()
        measured = truth @ lie.se3_exp(noise)
        found = smooth_trajectory(t_ns, measured, R)
        before, after = left_error(measured, truth).square(), left_error(found.T_world_cam, truth).square()
        assert float(after[:, :3].mean()) < 0.5 * float(before[:, :3].mean())
        assert float(after[:, 3:].mean()) < 0.75 * float(before[:, 3:].mean())
        assert bool((found.covariance.diagonal(dim1=1, dim2=2) < R.diagonal()).all())

    def test_a_pose_that_is_not_believed_is_interpolated(self) -> None:
        t_ns, truth = wavy(30)
        measured, covariance = truth.clone(), (1e-2 * R).expand(30, 6, 6).clone()
        measured[12:15] = torch.eye(4, dtype=F64)
        covariance[12:15] = math.inf
        found = smooth_trajectory(t_ns, measured, covariance)
        assert float(left_error(found.T_world_cam, truth)[12:15].abs().max()) < 0.02
        spread = found.covariance.diagonal(dim1=1, dim2=2)
        assert bool((spread[13] > 2 * spread[8]).all())
        assert bool(torch.isfinite(found.covariance).all())

    def test_a_camera_that_cannot_move_has_one_pose_and_one_covariance(self) -> None:
        still = PoseFilterConfig(acceleration=1e-9, turn_acceleration=1e-9, start_speed=1e-9, start_turn_rate=1e-9)
        xi = tangent(0.4, -0.2, 0.3, 0.5, 0.9, -0.4)
        T_world_cam = torch.stack([torch.eye(4, dtype=F64), lie.se3_exp(-xi)])
        found = smooth_trajectory(torch.tensor([0, 100_000_000]), T_world_cam, R, still)
        torch.testing.assert_close(found.T_world_cam, lie.se3_exp(-xi / 2).expand(2, 4, 4), rtol=0, atol=1e-9)
        torch.testing.assert_close(found.covariance[0], found.covariance[1], rtol=0, atol=1e-12)

    def test_the_choice_of_world_changes_nothing(self) -> None:
        t_ns, truth = wavy(20)
        T_new_world = lie.se3_exp(tangent(3, -1, 2, 1, -2, 0.5))
        one, other = smooth_trajectory(t_ns, truth, R), smooth_trajectory(t_ns, T_new_world @ truth, R)
        torch.testing.assert_close(other.T_world_cam, T_new_world @ one.T_world_cam, rtol=0, atol=1e-11)
        torch.testing.assert_close(other.covariance, one.covariance, rtol=0, atol=1e-12)

    def test_without_rotation_it_is_the_linear_smoother(self) -> None:
        generator = torch.Generator().manual_seed(8)
        N, sigma, density = 20, 0.05, 0.4
        t_ns = torch.randint(50_000_000, 150_000_000, (N,), generator=generator).cumsum(0)
        z = torch.randn(N, 3, generator=generator, dtype=F64).cumsum(0) * 0.05
        stiff = PoseFilterConfig(acceleration=density, turn_acceleration=1e-9, start_speed=0.7, start_turn_rate=1e-9)
        covariance = torch.diag(tangent(sigma, sigma, sigma, 1e-9, 1e-9, 1e-9) ** 2)
        T = lie.se3(torch.eye(3, dtype=F64).expand(N, 3, 3), z)
        found = smooth_trajectory(t_ns, T, covariance, stiff)

        dt = t_ns.diff().double() * 1e-9
        A = torch.eye(2, dtype=F64).repeat(N - 1, 1, 1, 1)
        A[:, 0, 0, 1] = dt
        Q = density**2 * torch.stack([dt**3 / 3, dt**2 / 2, dt**2 / 2, dt], -1).view(N - 1, 1, 2, 2)
        C, noise = torch.tensor([[1.0, 0.0]], dtype=F64), torch.tensor([[sigma**2]], dtype=F64)
        start = torch.stack([z[0], torch.zeros(3, dtype=F64)], -1)
        state = Gaussian(start, torch.diag(torch.tensor([sigma**2, 0.7**2], dtype=F64)).expand(3, 2, 2))
        states = [state]
        for k in range(N - 1):
            states.append(update(predict(states[-1], A[k], Q[k]), z[k + 1, :, None], C, noise)[0])
        stacked = Gaussian(torch.stack([s.mean for s in states]), torch.stack([s.covariance for s in states]))
        expected, _ = smooth(stacked, A, Q)
        torch.testing.assert_close(found.T_world_cam[:, :3, 3], expected.mean[..., 0], rtol=0, atol=1e-8)
        variance = found.covariance.diagonal(dim1=1, dim2=2)[:, :3]
        torch.testing.assert_close(variance, expected.covariance[..., 0, 0], rtol=1e-6, atol=0)
        torch.testing.assert_close(-found.twist[:, :3], expected.mean[..., 1], rtol=0, atol=1e-7)

    def test_smoothed_covariance_is_that_of_the_error(self) -> None:
        runs = PoseRuns(seed=9)
        count, steps, middle = 40, 16, 8
        t_ns = (torch.arange(1, steps + 1) * 100_000_000).to(torch.int64)
        normalized = []
        for run in range(count):
            measured, truth = (lie.se3_inverse(T[:steps, run]) for T in (runs.measured, runs.T))
            found = smooth_trajectory(t_ns, measured, R, runs.CONFIG)
            error = left_error(found.T_world_cam, truth)[middle]
            normalized.append(float(error @ torch.linalg.solve(found.covariance[middle], error)))
        low, high = chi_square_mean_interval(6, count)
        assert low < sum(normalized) / count < high

    def test_what_cannot_be_smoothed_is_refused_in_a_sentence(self) -> None:
        t_ns, truth = wavy(5)
        with pytest.raises(InputError, match="T_world_cam: expected at least two poses, got 1"):
            smooth_trajectory(t_ns[:1], truth[:1], R)
        with pytest.raises(InputError, match="t_ns: expected strictly increasing times"):
            smooth_trajectory(t_ns.flip(0), truth, R)
        with pytest.raises(InputError, match="T_world_cam: expected rigid motions"):
            smooth_trajectory(t_ns, 2 * truth, R)


def twice(state: PoseState) -> PoseState:
    T, twist, covariance = (torch.stack([value] * 2) for value in (state.T_cam_key, state.twist, state.covariance))
    return PoseState(T, twist, covariance, state.median_range)


class TestSingleState:
    """One state alone is computed in NumPy: it must come out as in a batch."""

    TURNS = (0.0, 1e-9, 1e-3, 9.9e-3, 1.01e-2, 0.3, 2.0, math.pi - 1e-6)

    @pytest.mark.parametrize("turn", TURNS)
    @pytest.mark.parametrize("dt", [0.0, 1 / 30, 5.0])
    def test_its_prediction_is_that_of_a_batch(self, turn: float, dt: float) -> None:
        motion, state = PoseFilter(), random_state((), seed=20)
        twist = torch.cat([state.twist[:3], torch.nn.functional.normalize(state.twist[3:], dim=0) * turn / max(dt, 1)])
        state = PoseState(state.T_cam_key, twist, state.covariance, 3.0)
        many, one = motion.predict(twice(state), dt), motion.predict(state, dt)
        scale = float(many.covariance.abs().max())
        torch.testing.assert_close(one.T_cam_key, many.T_cam_key[0], rtol=0, atol=1e-12)
        torch.testing.assert_close(one.covariance, many.covariance[0], rtol=0, atol=1e-12 * scale)
        assert torch.equal(one.covariance, one.covariance.mT)

    @pytest.mark.parametrize("turn", TURNS)
    def test_its_correction_is_that_of_a_batch(self, turn: float) -> None:
        motion, state = PoseFilter(), random_state((), seed=21)
        axis = torch.nn.functional.normalize(tangent(0, 0, 0, 1, -2, 0.5), dim=0)
        measured = lie.se3_exp(axis * turn + tangent(0.2, 0.1, -0.3, 0, 0, 0)) @ state.T_cam_key
        many, seen = motion.update(twice(state), measured.expand(2, 4, 4), R)
        one, own = motion.update(state, measured, R)
        assert_states_close(one, PoseState(many.T_cam_key[0], many.twist[0], many.covariance[0], 2.0), atol=1e-11)
        torch.testing.assert_close(own.residual, seen.residual[0], rtol=0, atol=1e-11)
        torch.testing.assert_close(own.covariance, seen.covariance[0], rtol=0, atol=1e-14)
        torch.testing.assert_close(own.mahalanobis2, seen.mahalanobis2[0], rtol=1e-9, atol=1e-9)
        assert bool(own.ok)

    @pytest.mark.parametrize("fault", ["pose", "skew pose", "mirrored pose", "covariance", "negative covariance"])
    def test_it_keeps_its_prediction_where_the_measurement_fails(self, fault: str) -> None:
        motion, state = PoseFilter(), random_state((), seed=22)
        measured, covariance = state.T_cam_key.clone(), R.clone()
        if fault == "pose":
            measured[0, 3] = math.nan
        elif fault == "skew pose":
            measured[:3, :3] = 0
        elif fault == "mirrored pose":
            measured[:3, :3] *= -1
        else:
            covariance = torch.full_like(R, math.inf) if fault == "covariance" else -1e3 * torch.eye(6, dtype=F64)
        found, innovation = motion.update(state, measured, covariance)
        assert_states_close(found, state, atol=0)
        assert not bool(innovation.ok)
        assert float(innovation.mahalanobis2) == math.inf
        assert bool(torch.isfinite(innovation.covariance).all())
        assert not bool(motion.plausible(innovation))

    def test_it_has_derivatives_where_they_are_asked_for(self) -> None:
        motion, state = PoseFilter(), random_state((), seed=23)
        twist = state.twist.clone().requires_grad_()
        moved = motion.predict(PoseState(state.T_cam_key, twist, state.covariance, 2.0), 0.1)
        (gradient,) = torch.autograd.grad(moved.T_cam_key.sum(), twist)
        assert float(gradient.abs().max()) > 0
