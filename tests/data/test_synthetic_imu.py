"""The synthetic IMU: it measures the path that is rendered, with the noise, biases, offset and gap asked for."""

import math

import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.data.synthetic.motion import MOTIONS, trajectory
from torchvo360.inertial import ImuNoise, ImuSensor, predict, preintegrate
from torchvo360.lie import so3_angle

GRAVITY = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
ZERO = torch.zeros(3, dtype=torch.float64)
PERFECT = {"imu_noise": 0.0, "imu_bias": 0.0}


def sequence(**settings) -> SyntheticSequence:
    return SyntheticSequence(
        SyntheticConfig(**{"width": 64, "height": 32, "frames": 151, "imu_rate": 200.0, **settings})
    )


def velocity(known: SyntheticSequence, imu: ImuSensor) -> torch.Tensor:
    """Return the IMU's velocity at the first frame, by the path a tenth of a millisecond before and after."""
    config = known.config
    at = torch.tensor([-1e-4, 1e-4], dtype=torch.float64) * config.fps
    path = trajectory(config.motion, known.world.walkway, config.frames, config.fps, seed=config.seed, at=at)
    before, after = (path @ imu.T_cam_imu)[:, :3, 3]
    return (after - before) / 2e-4


@pytest.mark.parametrize("motion", MOTIONS)
def test_perfect_samples_of_five_seconds_lead_along_the_path(motion):
    for seed in range(2):
        known = sequence(motion=motion, seed=seed, **PERFECT)
        imu, t_ns = known.imu, known.truth.t_ns
        T_world_imu = known.truth.T_world_cam @ imu.T_cam_imu
        pre = preintegrate(imu.samples, t_ns[:1].expand(5), t_ns[30::30], ZERO, ZERO, imu.noise)
        T, _ = predict(T_world_imu[:1].expand(5, 4, 4), velocity(known, imu).expand(5, 3), pre, GRAVITY)
        assert bool(pre.ok.all())
        assert float((T[:, :3, 3] - T_world_imu[30::30, :3, 3]).norm(dim=-1).max()) < 1e-3
        assert math.degrees(so3_angle(T[:, :3, :3].mT @ T_world_imu[30::30, :3, :3]).max()) < 2e-3


def test_a_walk_is_lively_enough_to_tell_a_scale():
    force = sequence(**PERFECT).imu.samples.accel.norm(dim=-1)
    assert 1.0 < float(force.std()) < 3.0
    assert float(force.mean()) == pytest.approx(9.81, abs=0.5)


def test_noise_and_biases_are_those_asked_for():
    clean, grade, twice = (sequence(seed=4, frames=1200, imu_noise=n, imu_bias=b) for n, b in ((0, 0), (1, 0), (2, 0)))
    for known, scale in ((grade, 1), (twice, 2)):
        made = known.synthetic_imu
        for name, density in (("gyro", ImuNoise().gyro), ("accel", ImuNoise().accel)):
            bias = getattr(made, f"bias_{name}")
            white = getattr(made.sensor.samples, name) - getattr(clean.imu.samples, name) - bias
            assert float(white.std()) == pytest.approx(scale * density * math.sqrt(200), rel=0.05)
            walk = bias.diff(dim=0).std()
            assert float(walk) == pytest.approx(scale * getattr(ImuNoise(), f"{name}_walk") / math.sqrt(200), rel=0.05)
        assert made.sensor.noise.gyro == pytest.approx(scale * ImuNoise().gyro)
    assert clean.imu.noise == ImuNoise()
    biased = sequence(seed=4, imu_noise=0.0, imu_bias=1.0)
    plain = sequence(seed=4, **PERFECT)
    torch.testing.assert_close(biased.imu.samples.gyro - plain.imu.samples.gyro, biased.synthetic_imu.bias_gyro)
    torch.testing.assert_close(biased.imu.samples.accel - plain.imu.samples.accel, biased.synthetic_imu.bias_accel)
    assert 0.01 < float(biased.synthetic_imu.bias_gyro[0].norm()) < 0.12


def test_equal_seeds_give_equal_samples_and_no_other_bits_of_the_images():
    first, second, other = (sequence(seed=seed, frames=10) for seed in (5, 5, 6))
    assert torch.equal(first.imu.samples.gyro, second.imu.samples.gyro)
    assert not torch.equal(first.imu.samples.gyro, other.imu.samples.gyro)
    without = sequence(seed=5, frames=10, imu_rate=0.0)
    assert without.imu is None
    assert (without.frame(3).image == first.frame(3).image).all()


def test_the_offset_shifts_the_times_and_is_not_told():
    plain, late = (sequence(seed=2, frames=31, imu_offset_ms=ms, **PERFECT) for ms in (0.0, 17.0))
    assert late.imu.offset_s == 0
    assert late.synthetic_imu.offset_s == 0.017
    assert ((plain.imu.samples.t_ns - late.imu.samples.t_ns) - 17_000_000).abs().max() <= 1
    assert torch.equal(plain.imu.samples.accel, late.imu.samples.accel)


def test_the_gap_is_at_the_middle_and_the_rate_is_kept_elsewhere():
    known = sequence(imu_gap_s=0.5, imu_rate=100.0)
    t_s = known.imu.samples.t_ns.double() / 1e9
    step = t_s.diff()
    assert int((step > 0.011).sum()) == 1
    k = int(step.argmax())
    assert float(step[k]) == pytest.approx(0.5, abs=0.011)
    assert float(t_s[k] + t_s[k + 1]) / 2 == pytest.approx(2.5, abs=0.011)
    assert float(t_s[0]) < 0 < 5 < float(t_s[-1])
    assert known.synthetic_imu.bias_gyro.shape == known.imu.samples.gyro.shape


def test_a_blackout_is_at_the_middle():
    known = sequence(frames=31, blackout_s=0.5, stereo_baseline=0.1)
    dark = [frame for frame in known if frame.problem]
    assert [frame.index for frame in dark] == list(range(8, 23))
    for frame in dark:
        assert frame.problem == "black"
        assert not frame.image.any()
        assert len(frame.others) == 1
        assert not frame.others[0].any()
    assert not any(frame.problem for frame in sequence(frames=5))


def test_the_pose_of_the_imu_is_that_of_the_settings():
    known = sequence(frames=3, imu_lever=[0.1, 0.2, 0.3], imu_turn_deg=[0.0, 0.0, 90.0])
    expected = torch.tensor([[0.0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(known.imu.T_cam_imu, expected)


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ({"imu_rate": 5.0}, "imu_rate: expected 0 or a number from 20 to 2000, got 5.0"),
        ({"imu_noise": -1.0}, "imu_noise: expected a finite number of at least 0, got -1.0"),
        ({"imu_offset_ms": math.nan}, "imu_offset_ms: expected a number from -300 to 300, got nan"),
        ({"imu_lever": [1.0, 2.0]}, "imu_lever: expected three finite numbers"),
        ({"blackout_s": math.inf}, "blackout_s: expected a finite number of at least 0, got inf"),
    ],
)
def test_impossible_settings_are_refused(setting, sentence):
    with pytest.raises(InputError, match=sentence):
        sequence(**setting)


def test_a_gap_that_leaves_no_samples_is_refused():
    with pytest.raises(InputError, match="imu: expected at least two samples, got 0"):
        _ = sequence(imu_gap_s=1e9).imu
