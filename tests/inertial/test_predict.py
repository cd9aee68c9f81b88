"""Prediction by the IMU alone: through the samples, through a gap, and in any world."""

import torch
from imu_recordings import GRAVITY, ZERO, at, lively_samples, normal

from torchvo360.inertial import ImuNoise, ImuSamples, predict, preintegrate
from torchvo360.lie import se3_exp, so3_exp

NOISE = ImuNoise()


def test_two_predictions_in_turn_are_the_one_of_both():
    samples = lively_samples(2.0)
    T, v = se3_exp(normal(3, 6, seed=0)), normal(3, 3, seed=1)
    a, b, c = (torch.full((3,), int(at(s))) for s in (0.1, 0.9, 1.6))
    first, second, both = (preintegrate(samples, *ends, ZERO, ZERO, NOISE) for ends in ((a, b), (b, c), (a, c)))
    T_one, v_one = predict(T, v, both, GRAVITY)
    T_two, v_two = predict(*predict(T, v, first, GRAVITY), second, GRAVITY)
    torch.testing.assert_close(T_two, T_one)
    torch.testing.assert_close(v_two, v_one)


def test_turning_the_world_turns_the_prediction():
    pre = preintegrate(lively_samples(1.0), at(0.0), at(0.8), ZERO, ZERO, NOISE)
    T, v, turn = se3_exp(normal(1, 6, seed=2)), normal(1, 3, seed=3), se3_exp(normal(6, seed=4))
    after, velocity = predict(T, v, pre, GRAVITY)
    turned, other = predict(turn @ T, v @ turn[:3, :3].mT, pre, turn[:3, :3] @ GRAVITY)
    torch.testing.assert_close(turned, turn @ after)
    torch.testing.assert_close(other, velocity @ turn[:3, :3].mT)


def test_at_rest_and_in_a_steady_turn_it_stays_where_it_is():
    t_ns = (torch.arange(401) * 5_000_000).contiguous()
    rate = torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64).expand(401, 3).contiguous()
    force = (-GRAVITY).expand(401, 3).contiguous()
    pre = preintegrate(ImuSamples(t_ns, rate, force), at(0.0), at(2.0), ZERO, ZERO, NOISE)
    T, v = predict(torch.eye(4, dtype=torch.float64)[None], ZERO[None], pre, GRAVITY)
    torch.testing.assert_close(T[0, :3, :3], so3_exp(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)))
    assert float(T[0, :3, 3].norm()) < 1e-9
    assert float(v.norm()) < 1e-9


def test_another_bias_than_the_preintegration_had_is_taken():
    samples = lively_samples(1.0)
    gyro, accel = (0.01 * normal(1, 3, seed=k) for k in (5, 6))
    T, v = se3_exp(normal(1, 6, seed=7)), normal(1, 3, seed=8)
    at_zero = preintegrate(samples, at(0.0), at(0.5), ZERO, ZERO, NOISE)
    exact = predict(T, v, preintegrate(samples, at(0.0), at(0.5), gyro, accel, NOISE), GRAVITY)
    for got, expected, plain in zip(
        predict(T, v, at_zero, GRAVITY, gyro, accel), exact, predict(T, v, at_zero, GRAVITY), strict=True
    ):
        assert float((got - expected).norm()) < 0.02 * float((plain - expected).norm())


def test_without_samples_the_pose_goes_on_with_its_velocity():
    samples = lively_samples(1.0)
    pre = preintegrate(samples, at(0.2, 5.0), at(0.4, 5.5), ZERO, ZERO, NOISE)
    T, v = se3_exp(normal(2, 6, seed=9)), normal(2, 3, seed=10)
    after, velocity = predict(T, v, pre, GRAVITY, 0.1 * normal(2, 3, seed=11), 0.1 * normal(2, 3, seed=12))
    torch.testing.assert_close(after[1, :3, :3], T[1, :3, :3])
    torch.testing.assert_close(after[1, :3, 3], T[1, :3, 3] + 0.5 * v[1])
    torch.testing.assert_close(velocity[1], v[1])
    assert float((after[0] - T[0]).abs().max()) > 1e-3
