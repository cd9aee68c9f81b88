"""The inertial start: scale, gravity and biases from a real flight and synthetic walks, and honesty where it fails."""

import math
from pathlib import Path

import pytest
import torch
from imu_recordings import GRAVITY, at, normal, read_flight
from torch import Tensor

from torchvo360.checks import InputError, ShapeError
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.inertial import ImuNoise, ImuSamples, ImuSensor, InertialStart, InertialStartConfig, initialise
from torchvo360.lie import se3, se3_exp, se3_inverse, so3_exp


def as_map(
    T_world_cam: Tensor, scale: float, seed: int, position: float = 0.0, rotation: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return T_cam_world in a map of its own unit and axes with noise, and gravity in its axes."""
    turn = se3_exp(normal(6, seed=seed))
    moved = turn @ T_world_cam
    moved[:, :3, 3] /= scale
    noise = torch.cat([normal(len(moved), 3, seed=seed + k, scale=s) for k, s in ((1, position), (2, rotation))], -1)
    return se3_exp(noise) @ se3_inverse(moved), turn[:3, :3] @ GRAVITY


def errors(start: InertialStart, scale: float, gravity: Tensor) -> tuple[float, float]:
    """Return the error of the scale, a share of it, and of gravity, degrees."""
    cosine = (start.gravity @ gravity / (start.gravity.norm() * gravity.norm())).clamp(-1, 1)
    return float(start.log_scale.exp()) / scale - 1, math.degrees(float(cosine.acos()))


def walk(frames: int, seed: int, **settings) -> SyntheticSequence:
    return SyntheticSequence(
        SyntheticConfig(**{"width": 64, "height": 32, "frames": frames, "seed": seed, "imu_rate": 200.0, **settings})
    )


@pytest.mark.parametrize(("position", "rotation"), [(1e-4, 1e-4), (1e-3, 1e-3), (4e-3, 2e-3)])
def test_a_real_flight_gives_scale_gravity_and_gyro_bias(shared: Path, position: float, rotation: float):
    """Forty poses of ten seconds of EuRoC's V1_02. The truth's own gravity is off by 0.2 deg, its forces by 0.5 %."""
    flight = read_flight(shared)
    T_cam_imu = se3(so3_exp(normal(3, seed=1)), 0.1 * normal(3, seed=2))
    for seed, first in enumerate((40, 640, 940)):
        k = first + 10 * torch.arange(40)
        T_world_cam = se3(flight.R_world_imu[k], flight.position[k]) @ se3_inverse(T_cam_imu)
        T_cam_world, gravity = as_map(T_world_cam, 2.5, 10 * seed, position, rotation)
        start = initialise(T_cam_world, flight.t_ns[k], ImuSensor(flight.samples, T_cam_imu=T_cam_imu))
        assert start.ok, start.reason
        scale, angle = errors(start, 2.5, gravity)
        assert abs(scale) < 0.03
        assert angle < 0.8
        assert float((start.motions[:, 3:6] - flight.bias_gyro[k]).norm(dim=-1).max()) < 0.003
        assert float((start.motions[:, 6:] - flight.bias_accel[k]).norm(dim=-1).max()) < 0.2
        assert float(start.gravity.norm()) == pytest.approx(9.81)


def test_perfect_measurements_give_the_scale_itself():
    sequence = walk(61, 3, imu_noise=0.0)
    T_cam_world, gravity = as_map(sequence.truth.T_world_cam[::6], 0.3, 5)
    start = initialise(
        T_cam_world, sequence.truth.t_ns[::6], sequence.imu, InertialStartConfig(position=1e-5, rotation=1e-5)
    )
    assert start.ok, start.reason
    scale, angle = errors(start, 0.3, gravity)
    assert abs(scale) < 2e-3
    assert angle < 0.02
    imu = sequence.synthetic_imu
    assert float((start.motions[:, 3:6] - imu.bias_gyro[0]).norm(dim=-1).max()) < 1e-3
    assert float((start.motions[:, 6:] - imu.bias_accel[0]).norm(dim=-1).max()) < 1e-2


def test_the_errors_are_as_large_as_said():
    """Over ten five-second walks with noise: of the scale, of gravity, and of the images' poses."""
    off, turned, visual = [], [], []
    for seed in range(10):
        sequence = walk(151, seed)
        T_cam_world, gravity = as_map(sequence.truth.T_world_cam[::6], 2.2, 10 * seed, 2e-3, 1e-3)
        start = initialise(T_cam_world, sequence.truth.t_ns[::6], sequence.imu)
        assert start.ok, start.reason
        scale, angle = errors(start, 2.2, gravity)
        off.append(scale / float(start.covariance[0, 0].sqrt()))
        turned.append(math.radians(angle) / float(start.covariance[1:, 1:].trace().sqrt()))
        visual.append((start.position_deviation / 2e-3, start.rotation_deviation / 1e-3))
    assert 0.5 < math.sqrt(sum(x * x for x in off) / 10) < 1.6
    assert 0.4 < math.sqrt(sum(x * x for x in turned) / 10) < 1.7
    found = torch.tensor(visual).mean(0)
    assert float((found - 1).abs().max()) < 0.15


def test_noise_of_the_images_does_not_draw_the_scale_to_zero():
    """With 9 mm of noise between poses a sixth of a second apart the linear solution loses a fifth of the scale."""
    logs = []
    for seed in range(6):
        sequence = walk(151, seed)
        T_cam_world, _ = as_map(sequence.truth.T_world_cam[::5], 2.2, 10 * seed, 4e-3, 1e-3)
        start = initialise(T_cam_world, sequence.truth.t_ns[::5], sequence.imu)
        logs.append(float(start.log_scale) - math.log(2.2))
    assert abs(sum(logs) / len(logs)) < 0.05


@pytest.mark.parametrize("motion", ["rotation", "still"])
def test_a_motion_that_does_not_tell_the_scale_is_not_ok(motion: str):
    for seed in range(3):
        sequence = walk(91, seed, motion=motion)
        T_cam_world, _ = as_map(sequence.truth.T_world_cam[::6], 2.0, seed, 1e-3, 1e-3)
        start = initialise(T_cam_world, sequence.truth.t_ns[::6], sequence.imu)
        assert not start.ok
        assert start.reason.startswith("The motion does not tell the scale")
        for value in (start.log_scale, start.gravity, start.motions, start.covariance):
            assert bool(value.isfinite().all())


def test_a_gap_in_the_samples_is_survived():
    sequence = walk(151, 1, imu_gap_s=1.0)
    T_cam_world, gravity = as_map(sequence.truth.T_world_cam[::6], 2.2, 4, 1e-3, 1e-3)
    start = initialise(T_cam_world, sequence.truth.t_ns[::6], sequence.imu)
    assert start.ok, start.reason
    scale, angle = errors(start, 2.2, gravity)
    assert abs(scale) < 3.5 * float(start.covariance[0, 0].sqrt()) < 0.15
    assert angle < 0.5


def test_the_sensors_offset_is_applied():
    sequence = walk(121, 2, imu_offset_ms=-80.0)
    T_cam_world, gravity = as_map(sequence.truth.T_world_cam[::6], 2.2, 4, 1e-3, 1e-3)
    known = ImuSensor(sequence.imu.samples, T_cam_imu=sequence.imu.T_cam_imu, offset_s=-0.08)
    start = initialise(T_cam_world, sequence.truth.t_ns[::6], known)
    assert start.ok, start.reason
    assert errors(start, 2.2, gravity)[1] < 0.3
    assert start.rotation_deviation < 1.5e-3
    assert initialise(T_cam_world, sequence.truth.t_ns[::6], sequence.imu).rotation_deviation > 5e-3


def test_too_little_is_told_in_a_sentence():
    samples = ImuSamples(at(0.0, 0.1, 0.2), *torch.ones(2, 3, 3, dtype=torch.float64))
    sensor, T = ImuSensor(samples, ImuNoise()), torch.eye(4, dtype=torch.float64).repeat(6, 1, 1)
    apart = initialise(T, at(*(5 + 0.2 * k for k in range(6))), sensor)
    assert not apart.ok
    assert apart.reason == "The IMU's samples do not cover the time of the poses."
    few = initialise(T[:3], at(0.0, 0.1, 0.2), sensor)
    assert few.reason == "The inertial start needs 4 poses, got 3."
    with pytest.raises(InputError, match="t_ns: expected increasing times in integer nanoseconds"):
        initialise(T[:2], at(1.0, 0.5), sensor)
    with pytest.raises(ShapeError, match=r"t_ns: expected shape \[6\], got \[2\]"):
        initialise(T, at(1.0, 2.0), sensor)
    with pytest.raises(InputError, match="bias_accel: expected a finite number above 0"):
        InertialStartConfig(bias_accel=-1.0)
