"""Preintegration: against the plain recursion and a real flight, its Jacobians, its covariance, and its borders."""

import math
import warnings

import pytest
import torch
from imu_recordings import GRAVITY, ZERO, at, lively_samples, normal, read_flight
from torch import Tensor

from torchvo360.checks import InputError
from torchvo360.inertial import ImuNoise, ImuSamples, Preintegrated, compose, predict, preintegrate
from torchvo360.lie import se3, so3_angle, so3_exp, so3_log
from torchvo360.residuals.inertial import ACCEL, POSITION

NOISE = ImuNoise()
BIAS_GYRO = torch.tensor([0.02, -0.05, 0.08], dtype=torch.float64)
BIAS_ACCEL = torch.tensor([0.1, 0.2, -0.15], dtype=torch.float64)


@pytest.fixture(scope="module")
def samples() -> ImuSamples:
    return lively_samples(3.0)


def integrate(samples: ImuSamples, start: int, end: int, share: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Return (R, v, p) by a plain loop over the samples' intervals, each in equal parts, linear in between."""
    R, v, p = torch.eye(3, dtype=torch.float64), ZERO, ZERO
    dt = 0.005 / share
    for m in range(start, end):
        for k in range(share):
            w, a = (
                torch.lerp(x[m], x[m + 1], (k + 0.5) / share) - bias
                for x, bias in ((samples.gyro, BIAS_GYRO), (samples.accel, BIAS_ACCEL))
            )
            force = R @ so3_exp(w * dt / 2) @ a
            p = p + v * dt + force * dt**2 / 2
            v = v + force * dt
            R = R @ so3_exp(w * dt)
    return R, v, p


def assert_alike(got: Preintegrated, expected: Preintegrated, tolerance: float) -> None:
    for name, a, b in zip(got._fields, got, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance, msg=lambda m, name=name: f"{name}: {m}")


def test_the_tree_is_the_recursion_over_the_samples(samples):
    spans = ((0, 1), (3, 20), (100, 333), (0, 600))
    start, end = (at(*(span[side] * 0.005 for span in spans)) for side in (0, 1))
    pre = preintegrate(samples, start, end, BIAS_GYRO, BIAS_ACCEL, NOISE)
    assert bool(pre.ok.all())
    for k, span in enumerate(spans):
        R, v, p = integrate(samples, *span)
        torch.testing.assert_close(pre.dR[k], R)
        torch.testing.assert_close(pre.dv[k], v)
        torch.testing.assert_close(pre.dp[k], p)
    torch.testing.assert_close(pre.dt, torch.tensor([0.005, 0.085, 1.165, 3.0], dtype=torch.float64))


def test_the_error_of_one_step_a_sample_is_far_below_the_noise(samples):
    """Against twenty steps a sample, over a second."""
    pre = preintegrate(samples, at(1.0), at(2.0), BIAS_GYRO, BIAS_ACCEL, NOISE)
    R, v, p = integrate(samples, 200, 400, share=20)
    assert math.degrees(so3_angle(pre.dR[0].mT @ R)) < 1e-3
    assert (pre.dv[0] - v).norm() < 3e-4
    assert (pre.dp[0] - p).norm() < 3e-4


def test_a_second_of_a_real_flight_comes_out_where_it_went(shared):
    """All 1519 starts. The rest is the accelerometer's: 3 to 5 cm/s^2 that are no constant bias."""
    flight = read_flight(shared)
    i = torch.arange(len(flight.t_ns) - 40)
    j = i + 40
    bias = flight.bias_gyro[i], flight.bias_accel[i]
    pre = preintegrate(flight.samples, flight.t_ns[i], flight.t_ns[j], *bias, NOISE)
    assert bool(pre.ok.all())
    assert float((pre.dt - 1).abs().max()) < 1e-12
    T, _ = predict(se3(flight.R_world_imu[i], flight.position[i]), flight.velocity[i], pre, GRAVITY)
    angle = torch.rad2deg(so3_angle(T[:, :3, :3].mT @ flight.R_world_imu[j]))
    away = 100 * (T[:, :3, 3] - flight.position[j]).norm(dim=-1)
    assert float(angle.max()) < 0.3
    assert float(angle.median()) < 0.1
    assert float(away.median()) < 3.0
    assert float((away < 4.0).double().mean()) > 0.8
    assert float(away.max()) < 8.0


def test_composing_two_segments_is_the_segment_of_both(samples):
    a, b, c = at(0.4, 0.0), at(0.9, 1.205), at(1.7, 3.0)
    args = (BIAS_GYRO, BIAS_ACCEL, NOISE)
    both = compose(preintegrate(samples, a, b, *args), preintegrate(samples, b, c, *args))
    assert_alike(both, preintegrate(samples, a, c, *args), 1e-11)


def test_a_segment_may_begin_and_end_between_samples(samples):
    """Two spans of one interval have the middle's rate of each, the whole one of both: alike to third order."""
    a, b, c = at(0.4017), at(0.9031), at(1.7499)
    args = (BIAS_GYRO, BIAS_ACCEL, NOISE)
    both = compose(preintegrate(samples, a, b, *args), preintegrate(samples, b, c, *args))
    assert_alike(both, preintegrate(samples, a, c, *args), 3e-6)
    short = preintegrate(samples, at(0.5011), at(0.5012), *args)
    assert bool(short.ok.all()), "without a sample inside"
    rate = torch.lerp(samples.gyro[100], samples.gyro[101], 0.23) - BIAS_GYRO
    torch.testing.assert_close(so3_log(short.dR[0]), rate * 1e-4)


def test_the_bias_jacobians_are_central_differences(samples):
    start, end = at(0.1, 0.7031), at(0.35, 1.9)
    pre = preintegrate(samples, start, end, BIAS_GYRO, BIAS_ACCEL, NOISE)
    h = 1e-5
    for axis in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[axis] = h
        low, high = (
            preintegrate(samples, start, end, BIAS_GYRO + s * step[:3], BIAS_ACCEL + s * step[3:], NOISE)
            for s in (-1, 1)
        )
        by_axis = torch.cat([so3_log(low.dR.mT @ high.dR), high.dv - low.dv, high.dp - low.dp], -1) / (2 * h)
        torch.testing.assert_close(pre.J_bias[..., axis], by_axis, rtol=1e-6, atol=1e-7)
    assert float(pre.J_R_bg.abs().max()) > 0.2
    assert float(pre.J_bias[..., POSITION, ACCEL].abs().max()) > 0.3


def test_another_bias_is_corrected_to_first_order(samples):
    start, end = at(0.5), at(1.0)
    pre = preintegrate(samples, start, end, BIAS_GYRO, BIAS_ACCEL, NOISE)
    errors = []
    for size in (1e-2, 1e-3):
        gyro, accel = BIAS_GYRO + size * normal(3, seed=1), BIAS_ACCEL + size * normal(3, seed=2)
        exact = preintegrate(samples, start, end, gyro, accel, NOISE)
        dR, dv, dp = pre.corrected(gyro[None], accel[None])
        errors.append(
            [float(so3_angle(dR.mT @ exact.dR)), float((dv - exact.dv).norm()), float((dp - exact.dp).norm())]
        )
    for coarse, fine in zip(*errors, strict=True):
        assert coarse < 1e-3
        assert fine < 0.02 * coarse, "the error is of second order"


def test_it_is_differentiable_in_the_biases(samples):
    def motion(gyro: Tensor, accel: Tensor) -> tuple[Tensor, ...]:
        pre = preintegrate(samples, at(0.5, 2.9991), at(0.52, 4.0), gyro, accel, NOISE)
        return pre.dR, pre.dv, pre.dp, pre.J_bias, pre.covariance * 1e8

    gyro, accel = (bias.expand(2, 3).clone().requires_grad_() for bias in (BIAS_GYRO, BIAS_ACCEL))
    assert torch.autograd.gradcheck(motion, (gyro, accel), atol=1e-6)
    resting = ImuSamples(samples.t_ns, torch.zeros_like(samples.gyro), torch.zeros_like(samples.accel))
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    pre = preintegrate(resting, at(0.0), at(1.0), zero, zero, NOISE)
    (gradient,) = torch.autograd.grad(pre.dR.sum() + pre.dp.sum(), zero)
    assert bool(gradient.isfinite().all()), "at a standstill too"


@pytest.mark.parametrize("rate_hz", [200.0, 100.0])
def test_the_covariance_is_that_of_two_thousand_noisy_recordings(rate_hz):
    runs, seconds = 2000, 0.3
    clean = lively_samples(seconds, rate_hz)
    truth = preintegrate(clean, at(0.0), at(seconds), ZERO, ZERO, NOISE)
    errors = []
    for part in range(4):  # of the recordings one behind the other, as segments of one
        count, M = runs // 4, len(clean)
        t_ns = (clean.t_ns + at(1.0) * torch.arange(count)[:, None]).flatten()
        gyro, accel = (
            (x + normal(count, M, 3, seed=1000 + 10 * part + k, scale=density * math.sqrt(rate_hz))).flatten(0, 1)
            for k, (x, density) in enumerate(((clean.gyro, NOISE.gyro), (clean.accel, NOISE.accel)))
        )
        start = at(1.0) * torch.arange(count)
        pre = preintegrate(ImuSamples(t_ns, gyro, accel), start, start + at(seconds), ZERO, ZERO, NOISE)
        errors.append(torch.cat([so3_log(truth.dR.mT @ pre.dR), pre.dv - truth.dv, pre.dp - truth.dp], -1))
    error = torch.cat(errors)
    size = truth.covariance[0].diagonal().sqrt()
    seen = error.mT @ error / runs
    assert float((seen.diagonal() / size.square() - 1).abs().max()) < 0.1
    assert float(((seen - truth.covariance[0]) / (size[:, None] * size)).abs().max()) < 0.1
    nees = (error @ torch.linalg.inv(truth.covariance[0]) * error).sum(1).mean() / 9
    assert float(nees) == pytest.approx(1, abs=0.05)


def test_a_gap_is_survived_and_told(samples):
    kept = (samples.t_ns < at(1.0)) | (samples.t_ns > at(1.3))
    holed = ImuSamples(samples.t_ns[kept], samples.gyro[kept], samples.accel[kept])
    start, end = at(0.2, 0.8, 1.1, 1.2, 1.4), at(0.7, 1.05, 1.2, 1.6, 1.8)
    pre = preintegrate(holed, start, end, BIAS_GYRO, BIAS_ACCEL, NOISE)
    assert pre.ok.tolist() == [True, False, False, False, True]
    whole = preintegrate(samples, start, end, BIAS_GYRO, BIAS_ACCEL, NOISE)
    assert_alike(pre.take(pre.ok), whole.take(pre.ok), 1e-12)
    bad = pre.take(~pre.ok)
    assert torch.equal(bad.dR, torch.eye(3, dtype=torch.float64).expand(3, 3, 3))
    assert float(bad.dv.abs().max()) == float(bad.dp.abs().max()) == float(bad.J_bias.abs().max()) == 0
    assert torch.equal(bad.covariance, torch.eye(9, dtype=torch.float64).expand(3, 9, 9))
    torch.testing.assert_close(bad.dt, torch.tensor([0.25, 0.1, 0.4], dtype=torch.float64))
    longer = preintegrate(holed, start, end, BIAS_GYRO, BIAS_ACCEL, NOISE, max_gap_s=0.5)
    assert bool(longer.ok.all())
    spread = longer.covariance.diagonal(dim1=-2, dim2=-1)[:, 0] / whole.covariance.diagonal(dim1=-2, dim2=-1)[:, 0]
    assert float(spread[1]) > 5, "a lone sample's noise lasts over the gap"
    assert float(spread[0]) == pytest.approx(1)


def test_segments_outside_of_the_samples_are_not_measured_and_touch_no_other(samples):
    start = at(-5.0, -0.02, 0.5, 2.9, 2.9, 9.0, 1.0, 1.5, -1000.0)
    end = at(-4.0, 0.1, 0.6, 3.05, 3.3, 9.1, 1.0, 1.2, 1000.0)
    pre = preintegrate(samples, start, end, BIAS_GYRO, BIAS_ACCEL, NOISE)
    assert pre.ok.tolist() == [False, True, True, True, False, False, False, False, False]
    assert all(bool(value.isfinite().all()) for value in pre)
    alone = preintegrate(samples, start[2:3], end[2:3], BIAS_GYRO, BIAS_ACCEL, NOISE)
    assert_alike(pre.take(slice(2, 3)), alone, 1e-12)
    none = preintegrate(samples, at(), at(), BIAS_GYRO, BIAS_ACCEL, NOISE)
    assert none.dR.shape == (0, 3, 3)


def test_each_segment_has_its_own_bias(samples):
    start, end = at(0.5, 0.5), at(1.0, 1.0)
    gyro = torch.stack([BIAS_GYRO, ZERO])
    both = preintegrate(samples, start, end, gyro, BIAS_ACCEL, NOISE)
    for k in range(2):
        alone = preintegrate(samples, start[:1], end[:1], gyro[k], BIAS_ACCEL, NOISE)
        assert_alike(both.take(slice(k, k + 1)), alone, 1e-12)
    assert float(so3_angle(both.dR[0].mT @ both.dR[1])) > 0.02


def test_bad_arguments_are_told_in_a_sentence(samples):
    args = (BIAS_GYRO, BIAS_ACCEL, NOISE)
    with pytest.raises(InputError, match=r"start_ns: expected int64, got torch\.float64"):
        preintegrate(samples, at(0.0).double(), at(1.0), *args)
    with pytest.raises(InputError, match=r"end_ns: expected shape \[2\], got \[1\]"):
        preintegrate(samples, at(0.0, 1.0), at(1.0), *args)
    with pytest.raises(InputError, match="bias_gyro: expected shape"):
        preintegrate(samples, at(0.0), at(1.0), torch.zeros(2, dtype=torch.float64), BIAS_ACCEL, NOISE)
    with pytest.raises(InputError, match="max_gap_s: expected a finite number above 0"):
        preintegrate(samples, at(0.0), at(1.0), *args, max_gap_s=0.0)


def test_times_from_a_table_raise_no_warning(samples):
    table = torch.stack([at(0.1, 0.2), at(0.2, 0.3)], 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        preintegrate(samples, table[:, 0], table[:, 1], BIAS_GYRO, BIAS_ACCEL, NOISE)
