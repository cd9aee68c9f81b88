"""Synthetic sequences and pairs: paths in free space, exposure, noise, and the same bits from the same seed."""

import math
import time

import numpy as np
import pytest
import torch

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.data.synthetic import WORLDS, SyntheticConfig, SyntheticSequence, make_world, sample_pairs
from torchvo360.data.synthetic.motion import MOTIONS, trajectory
from torchvo360.lie import se3_inverse, so3_angle

MIDDLE = 75


def small(**settings) -> SyntheticConfig:
    return SyntheticConfig(**{"width": 128, "height": 64, "seed": 2, **settings})


@pytest.fixture(scope="module")
def plain() -> SyntheticSequence:
    return SyntheticSequence(small())


def turns(poses: torch.Tensor) -> torch.Tensor:
    """Return the rotation angles between consecutive poses, radians."""
    return so3_angle(poses[:-1, :3, :3].mT @ poses[1:, :3, :3])


def test_a_sequence_yields_its_frames_in_order_with_times_and_truth():
    sequence = SyntheticSequence(small(frames=3, fps=24.0))
    frames = list(sequence)
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.t_ns for frame in frames] == [0, 41_666_667, 83_333_333] == sequence.truth.t_ns.tolist()
    assert sequence.length == len(sequence) == len(sequence.truth) == 3
    assert sequence.camera == Equirectangular(128, 64)
    for frame in frames:
        assert frame.image is not None
        assert frame.image.shape == (64, 128, 3)
        assert frame.image.dtype == np.uint8
        assert frame.problem == ""
    torch.testing.assert_close(sequence.truth.T_world_cam[1], sequence.pose(1), rtol=0, atol=0)
    assert torch.equal(sequence.world.render(sequence.camera, sequence.pose(2), t=2 / 24)[1], sequence.range(2))


def test_a_pinhole_sequence_has_the_field_of_view_asked_for():
    sequence = SyntheticSequence(small(camera="pinhole", fov_deg=70.0, width=90, height=60, frames=2))
    assert isinstance(sequence.camera, Pinhole)
    left, right = sequence.camera.ray(torch.tensor([[0.0, 30.0], [90.0, 30.0]], dtype=torch.float64))
    angle = math.acos(float(left @ right / left.norm() / right.norm()))
    assert math.degrees(angle) == pytest.approx(70.0)
    assert sequence.frame(1).image.shape == (60, 90, 3)


def test_equal_settings_give_equal_bits_in_any_order_and_another_seed_others():
    settings = {"noise": 0.02, "exposure": "steps", "moving_objects": 1, "frames": 40}
    first, second = (SyntheticSequence(small(**settings)) for _ in range(2))
    for index in (25, 0):
        assert np.array_equal(first.frame(index).image, second.frame(index).image)
    assert np.array_equal(first.frame(25).image, second.frame(25).image)
    assert torch.equal(first.truth.T_world_cam, second.truth.T_world_cam)
    other = SyntheticSequence(small(**{**settings, "seed": 3}))
    assert not torch.equal(first.truth.T_world_cam, other.truth.T_world_cam)
    assert not np.array_equal(first.frame(0).image, other.frame(0).image)


@pytest.mark.parametrize("name", WORLDS)
def test_every_path_stays_in_free_space_and_is_smooth(name):
    world = make_world(name, seed=9, moving_objects=2)
    for motion in MOTIONS:
        for seed in range(5):
            poses = trajectory(motion, world.walkway, 150, 30.0, seed=seed)
            at = poses[:, :3, 3]
            for t in (0.0, 1.5, 3.0):
                assert world.clearance(at, t).min() > 0.3
            assert turns(poses).max() < math.radians(4.0)
            step = at.diff(dim=0)
            assert step.norm(dim=-1).max() < 0.12
            # no kicks: the change of the step is far below the step
            assert step.diff(dim=0).norm(dim=-1).max() < 0.01
    _, reach = world.render(Equirectangular(64, 32), trajectory("walk", world.walkway, 6, 1.2, seed=0))
    assert reach.min() > 0.2


def test_motions_are_what_their_names_say(plain):
    walkway = plain.world.walkway
    for seed in range(4):
        walk, loop, rotation, still = (
            trajectory(motion, walkway, 150, 30.0, seed=seed) for motion in ("walk", "loop", "rotation", "still")
        )
        assert 3.0 < walk[:, :3, 3].diff(dim=0).norm(dim=-1).sum() < 6.0
        assert torch.equal(rotation[:, :3, 3], rotation[:1, :3, 3].expand(150, 3))
        assert turns(rotation).mean() > math.radians(0.5)
        assert torch.equal(still, still[:1].expand(150, 4, 4))
        # the frame after the last would be the first
        closing = torch.cat([loop[-1:], loop[:1]])
        assert closing[:, :3, 3].diff(dim=0).norm() < 1.2 * loop[:, :3, 3].diff(dim=0).norm(dim=-1).max()
        assert turns(closing).item() < 1.2 * turns(loop).max()
        for poses in (walk, loop):
            ahead = poses[:-1, :3, 2] * poses[:, :3, 3].diff(dim=0)
            assert (ahead.sum(-1) > 0).all()
        down = walk[:, 2, 1]
        assert (down < -0.95).all()


@pytest.mark.parametrize("jump_deg", [20.0, -45.0])
def test_the_yaw_jump_happens_inside_two_frames_at_the_middle_and_moves_nothing(plain, jump_deg):
    walkway = plain.world.walkway
    without = trajectory("walk", walkway, 150, 30.0, seed=1)
    with_jump = trajectory("walk", walkway, 150, 30.0, seed=1, yaw_jump_deg=jump_deg)
    assert torch.equal(without[:, :3, 3], with_jump[:, :3, 3])
    extra = with_jump[:, :3, :3] @ without[:, :3, :3].mT
    yaw_deg = torch.rad2deg(torch.atan2(extra[:, 1, 0], extra[:, 0, 0]))
    torch.testing.assert_close(extra[:, 2, 2], torch.ones(150, dtype=torch.float64))
    expected = torch.tensor([0.0] * MIDDLE + [jump_deg / 2] + [jump_deg] * (150 - MIDDLE - 1), dtype=torch.float64)
    torch.testing.assert_close(yaw_deg, expected, atol=1e-6, rtol=0)


def test_exposure_steps_change_the_brightness_abruptly_and_clip():
    sequence = SyntheticSequence(small(exposure="steps", motion="still", frames=100))
    mean = np.array([sequence.frame(k).image.mean() for k in (0, 19, 20, 39, 40, 60, 80)])
    assert mean[0] == mean[1]
    assert mean[2] == mean[3]
    ratio = sequence.gains[20::20] / sequence.gains[19:-1:20]
    assert (ratio.log().abs() > math.log(1.5) - 1e-9).all()
    assert (ratio.log().abs() < math.log(2.0) + 1e-9).all()
    assert sequence.gains.min() > 0.49
    assert sequence.gains.max() < 2.01
    for before, after in ((1, 2), (3, 4), (4, 5), (5, 6)):
        assert max(mean[before], mean[after]) / min(mean[before], mean[after]) > 1.3
    colour, _ = sequence.render(0)
    k = 20 * int(sequence.gains[::20].argmax())
    expected = (float(sequence.gains[k]) * colour + float(sequence.offsets[k])).clamp(0, 1) * 255
    shown = torch.from_numpy(sequence.frame(k).image).permute(2, 0, 1)
    torch.testing.assert_close(shown.float(), expected, atol=0.51, rtol=0)


def test_exposure_drifts_slowly_within_its_bounds():
    sequence = SyntheticSequence(small(exposure="drift"))
    assert sequence.gains.diff().abs().max() < 0.03
    assert 0.7 < sequence.gains.min() < 0.8
    assert 1.3 < sequence.gains.max() < 1.41


def test_noise_has_its_deviation_and_differs_between_frames(plain):
    noisy = SyntheticSequence(small(noise=0.05, motion="still"))
    clean = SyntheticSequence(small(motion="still")).frame(0).image.astype(np.float64) / 255
    first, second = (noisy.frame(k).image.astype(np.float64) / 255 for k in (0, 1))
    inner = (clean > 0.25) & (clean < 0.75)
    assert (first - clean)[inner].std() == pytest.approx(0.05, rel=0.05)
    assert abs(np.corrcoef((first - clean)[inner], (second - clean)[inner])[0, 1]) < 0.05


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"world": "cave"}, "world: expected one of room, pillars, courtyard, got 'cave'."),
        ({"camera": "fisheye"}, "camera: expected one of equirectangular, pinhole, got 'fisheye'."),
        ({"motion": "fly"}, "motion: expected one of walk, loop, rotation, still, got 'fly'."),
        ({"exposure": "auto"}, "exposure: expected one of constant, steps, drift, got 'auto'."),
        ({"frames": 0}, "frames: expected an integer of at least 1, got 0."),
        ({"seed": 2**32}, "seed: expected at most 4294967295, got 4294967296."),
        ({"frames": 2.5}, "frames: expected an integer of at least 1, got 2.5."),
        ({"width": 300, "height": 200}, "width: expected twice the height for a panorama, got 300 x 200."),
        ({"fps": 0.0}, "fps: expected a finite number above 0 at most 1e+06, got 0.0."),
        ({"fov_deg": 180.0}, "fov_deg: expected a finite number above 0 at most 170, got 180.0."),
        ({"noise": -0.1}, "noise: expected a number from 0 to 1, got -0.1."),
        ({"noise": math.nan}, "noise: expected a number from 0 to 1, got nan."),
        ({"moving_objects": -1}, "moving_objects: expected an integer of at least 0, got -1."),
        ({"yaw_jump_deg": math.inf}, "yaw_jump_deg: expected a finite number from -180 to 180, got inf."),
    ],
)
def test_a_bad_setting_is_refused_in_one_sentence(settings, sentence):
    with pytest.raises(InputError) as caught:
        SyntheticConfig(**settings)
    assert str(caught.value) == sentence


def test_a_frame_beyond_the_end_is_refused(plain):
    with pytest.raises(InputError, match="index: expected 0 to 149, got 150"):
        plain.frame(150)


def test_a_frame_of_512_by_256_renders_fast():
    sequence = SyntheticSequence(SyntheticConfig(world="pillars", frames=12))
    spent = []
    for index in range(12):
        start = time.perf_counter()
        sequence.frame(index)
        spent.append(time.perf_counter() - start)
    assert sorted(spent)[3] < 0.15


def test_pairs_are_related_by_their_motion_their_range_and_their_brightness():
    pairs = sample_pairs(6, seed=1, width=256, height=128)
    assert pairs.ref.shape == pairs.tgt.shape == (6, 3, 128, 256)
    T = pairs.T_tgt_ref_true
    y = (
        pairs.camera.ray_grid(dtype=torch.float64) @ T[:, None, :3, :3].mT
        + pairs.rho[..., None] * T[:, None, None, :3, 3]
    )
    uv, _ = pairs.camera.project(y)
    grid = (uv / torch.tensor([256.0, 128.0]) * 2 - 1).float()
    seen = torch.nn.functional.grid_sample(pairs.tgt, grid, align_corners=False, padding_mode="border")
    expected = (pairs.gain[:, None, None, None] * pairs.ref + pairs.bias[:, None, None, None]).clamp(0, 1)
    assert (seen - expected).abs().flatten(1).median(1).values.max() < 0.02
    assert (pairs.ref - pairs.tgt).abs().flatten(1).median(1).values.min() > 0.02
    assert (pairs.rho > 0).all()
    assert (pairs.rho < 1 / 0.35).all()
    assert ((pairs.gain > 0.7) & (pairs.gain < 1.4) & (pairs.bias.abs() < 0.05)).all()


def test_pairs_keep_to_their_bounds_and_fill_them():
    pairs = sample_pairs(32, seed=2, width=32, height=16, max_rotation_deg=3.0, max_translation_m=0.2, affine=False)
    angle = torch.rad2deg(so3_angle(pairs.T_tgt_ref_true[:, :3, :3]))
    distance = pairs.T_tgt_ref_true[:, :3, 3].norm(dim=-1)
    for size, bound in ((angle, 3.0), (distance, 0.2)):
        assert 0.8 * bound < size.max() < bound
        assert size.min() < 0.2 * bound
    assert (pairs.gain == 1).all()
    assert (pairs.bias == 0).all()
    inverse = se3_inverse(pairs.T_tgt_ref_true)
    torch.testing.assert_close(inverse @ pairs.T_tgt_ref_true, torch.eye(4, dtype=torch.float64).expand(32, 4, 4))


def test_a_pair_depends_on_its_seed_and_not_on_how_many_are_asked_for():
    few, many = (sample_pairs(n, seed=3, width=32, height=16, gray=True) for n in (2, 5))
    assert few.ref.shape == (2, 1, 16, 32)
    for name in ("ref", "tgt", "rho", "T_tgt_ref_true", "gain", "bias"):
        assert torch.equal(getattr(few, name), getattr(many, name)[:2])
    other = sample_pairs(2, seed=4, width=32, height=16, gray=True)
    assert not torch.equal(few.T_tgt_ref_true, other.T_tgt_ref_true)


def test_impossible_pairs_are_refused():
    with pytest.raises(InputError, match="n: expected at least 1, got 0"):
        sample_pairs(0)
    with pytest.raises(InputError, match="max_translation_m: expected a finite number"):
        sample_pairs(1, max_translation_m=2.0)
