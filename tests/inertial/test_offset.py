"""The time offset between camera and IMU: found on a real flight and synthetic motions, or said not to be told."""

import pytest
import torch
from imu_recordings import at, normal, read_flight

from torchvo360.checks import InputError
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.inertial import ImuSamples, ImuSensor, estimate_offset
from torchvo360.inertial.offset import _Gyro
from torchvo360.lie import se3, so3_exp


def sequence(**settings) -> SyntheticSequence:
    return SyntheticSequence(
        SyntheticConfig(**{"width": 64, "height": 32, "imu_rate": 200.0, "motion": "rotation", **settings})
    )


def noisy(R: torch.Tensor, seed: int, scale: float = 1e-3) -> torch.Tensor:
    return R @ so3_exp(normal(len(R), 3, seed=seed, scale=scale))


@pytest.mark.parametrize("shift_s", [0.017, -0.25, 0.0])
def test_a_shift_of_a_real_flight_is_found_to_a_millisecond(shared, shift_s):
    """The truth's own clock is 0.9 ms ahead of the gyro's, which is part of the error."""
    flight = read_flight(shared)
    R_cam_imu = so3_exp(normal(3, seed=0))
    sensor = ImuSensor(flight.samples, T_cam_imu=se3(R_cam_imu, torch.zeros(3, dtype=torch.float64)))
    R_world_cam = flight.R_world_imu @ R_cam_imu.mT
    own = estimate_offset(R_world_cam, flight.t_ns, sensor)
    found = estimate_offset(R_world_cam, flight.t_ns + round(shift_s * 1e9), sensor)
    assert own.ok
    assert found.ok
    assert abs(found.offset_s - shift_s) < 1e-3
    assert abs(found.offset_s - own.offset_s - shift_s) < 2e-5
    images = estimate_offset(noisy(R_world_cam, 1), flight.t_ns + round(shift_s * 1e9), sensor)
    assert images.ok
    assert abs(images.offset_s - found.offset_s) < 4 * images.deviation_s < 1e-3


def test_the_error_is_as_large_as_said():
    errors, deviations = [], []
    for seed in range(12):
        known = sequence(frames=121, seed=seed, imu_offset_ms=-20.0 + 7 * seed)
        R = noisy(known.truth.T_world_cam[:, :3, :3], seed)
        found = estimate_offset(R, known.truth.t_ns, known.imu)
        assert found.ok, found.reason
        errors.append(1e3 * found.offset_s - known.config.imu_offset_ms)
        deviations.append(1e3 * found.deviation_s)
    ratio = torch.tensor(errors) / torch.tensor(deviations)
    assert 0.5 < float(ratio.square().mean().sqrt()) < 1.6
    assert max(map(abs, errors)) < 1.5


def test_wrong_rotations_among_the_right_ones_do_not_spoil_it():
    known = sequence(frames=151, seed=2, imu_offset_ms=35.0)
    R = known.truth.T_world_cam[:, :3, :3].clone()
    R[40:150:10] = R[40:150:10] @ so3_exp(normal(11, 3, seed=4, scale=0.3))
    found = estimate_offset(R, known.truth.t_ns, known.imu)
    assert found.ok, found.reason
    assert found.offset_s == pytest.approx(0.035, abs=1e-3)


def test_the_search_begins_at_the_sensors_own_offset():
    known = sequence(frames=121, seed=1, imu_offset_ms=250.0)
    R, t_ns = known.truth.T_world_cam[:, :3, :3], known.truth.t_ns
    guess = ImuSensor(known.imu.samples, T_cam_imu=known.imu.T_cam_imu, offset_s=0.2)
    found = estimate_offset(R, t_ns, guess, search_s=0.1)
    assert found.ok, found.reason
    assert found.offset_s == pytest.approx(0.25, abs=1e-3)
    missed = estimate_offset(R, t_ns, known.imu, search_s=0.1)
    assert not missed.ok


def test_a_gap_in_the_samples_is_survived():
    known = sequence(frames=151, seed=3, imu_offset_ms=12.0, imu_gap_s=1.0)
    found = estimate_offset(known.truth.T_world_cam[:, :3, :3], known.truth.t_ns, known.imu)
    assert found.ok, found.reason
    assert found.offset_s == pytest.approx(0.012, abs=5e-4)


def test_a_camera_that_does_not_turn_does_not_tell():
    still = sequence(frames=91, motion="still")
    found = estimate_offset(noisy(still.truth.T_world_cam[:, :3, :3], 0), still.truth.t_ns, still.imu)
    assert not found.ok
    assert found.reason == "The camera turns too little to tell the time offset."
    assert abs(found.offset_s) <= 0.4


def test_an_hour_of_samples_beside_the_cameras_time_is_not_integrated(monkeypatch):
    known = sequence(frames=121, seed=1, imu_offset_ms=40.0)
    R, t_ns, samples = known.truth.T_world_cam[:, :3, :3], known.truth.t_ns, known.imu.samples
    beside = torch.arange(1, 360_001) * 10_000_000
    t_long = torch.cat([samples.t_ns[0] - beside.flip(0), samples.t_ns, samples.t_ns[-1] + beside])
    rest = torch.ones(len(beside), 3, dtype=torch.float64)
    long = ImuSamples(t_long, *(torch.cat([rest, part, rest]) for part in (samples.gyro, samples.accel)))
    integrated = []
    whole = _Gyro.of
    monkeypatch.setattr(_Gyro, "of", lambda of, bias: integrated.append(len(of)) or whole(of, bias))
    found = estimate_offset(R, t_ns, ImuSensor(long, T_cam_imu=known.imu.T_cam_imu))
    assert found.ok, found.reason
    assert found.offset_s == pytest.approx(estimate_offset(R, t_ns, known.imu).offset_s, abs=1e-6)
    assert max(integrated) < 1.2 * len(samples)


def test_no_overlap_is_told():
    known = sequence(frames=91)
    found = estimate_offset(known.truth.T_world_cam[:, :3, :3], known.truth.t_ns + 60 * 10**9, known.imu)
    assert not found.ok
    assert found.reason == "The IMU covers fewer than 20 turns of the camera."
    short = estimate_offset(known.truth.T_world_cam[:10, :3, :3], known.truth.t_ns[:10], known.imu)
    assert not short.ok
    single = estimate_offset(known.truth.T_world_cam[:1, :3, :3], known.truth.t_ns[:1], known.imu)
    assert not single.ok


def test_bad_arguments_are_told_in_a_sentence():
    samples = ImuSamples(at(0.0, 0.1), *torch.ones(2, 2, 3, dtype=torch.float64))
    R = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    with pytest.raises(InputError, match="t_ns: expected increasing times in integer nanoseconds"):
        estimate_offset(R, at(0.1, 0.1), ImuSensor(samples))
    with pytest.raises(InputError, match="search_s: expected a finite number above 0 at most 10, got 0"):
        estimate_offset(R, at(0.1, 0.2), ImuSensor(samples), search_s=0.0)
