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
from torchvo360.data.synthetic.sequence import MAX_BASELINE
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
            frames = 300 if motion == "turned_loop" else 150
            poses = trajectory(motion, world.walkway, frames, 30.0, seed=seed)
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


def test_a_walk_with_a_stop_stands_still_for_its_time_and_goes_on_smoothly(plain):
    walkway = plain.world.walkway
    walk = trajectory("walk", walkway, 150, 30.0, seed=1)
    for motion, begin, end in (("pause", 53, 97), ("turn", 30, 120), ("turn_first", 0, 90)):
        poses = trajectory(motion, walkway, 150, 30.0, seed=1)
        step = poses[:, :3, 3].diff(dim=0).norm(dim=-1)
        assert step[begin:end].max() < 1e-12
        before, after = step[: max(0, begin - 1)], step[end + 2 :]
        assert min(before.min() if len(before) else 1, after.min()) > 1e-6
        assert after[16:].min() > 0.02, "at full speed half a second later"
        turn = turns(poses)[begin:end]
        if motion == "pause":
            assert turn.max() < 1e-6
        else:
            assert math.degrees(turn.sum()) > 235
            assert math.degrees(turn.max()) < 3.5
        # no kicks, neither where it stops nor where it goes on
        assert poses[:, :3, 3].diff(dim=0).diff(dim=0).norm(dim=-1).max() < 0.005
        assert turns(poses).diff().abs().max() < math.radians(0.4)
        if begin > 20:  # until it slows down it is the walk
            torch.testing.assert_close(poses[: begin - 15], walk[: begin - 15])
    short = trajectory("pause", walkway, 20, 30.0, seed=1)
    assert short[:, :3, 3].diff(dim=0).norm(dim=-1).max() < 1e-12, "shorter than its stop"


def test_the_turned_loop_comes_back_to_its_first_place_and_looks_another_way(plain):
    walkway = plain.world.walkway
    for seed in range(3):
        loop, turned = (trajectory(motion, walkway, 300, 30.0, seed=seed) for motion in ("loop", "turned_loop"))
        assert torch.equal(turned[:, :3, 3], loop[:, :3, 3])
        torch.testing.assert_close(turned[0], loop[0])
        closing = turned[[-1, 0]]
        assert closing[:, :3, 3].diff(dim=0).norm() < 0.05
        assert math.degrees(turns(closing).item()) > 140


@pytest.mark.parametrize("share", [0.1, 1 / 3])
@pytest.mark.parametrize("world", ["room", "courtyard"])
def test_a_moving_object_covers_its_share_of_the_sphere_all_the_time(world, share):
    plain, covered = (SyntheticSequence(small(world=world, moving_share=s, frames=120)) for s in (0.0, share))
    area = plain.camera.solid_angle(plain.camera.pixel_grid())
    shares, middles = [], []
    for index in range(0, 120, 17):
        (image, reach), (spoiled, nearer) = plain.render(index), covered.render(index)
        hidden = nearer < reach
        assert torch.equal(nearer[~hidden], reach[~hidden])
        shares.append(float(area[hidden].sum() / area.sum()))
        # it stands out, with a texture of its own
        assert (spoiled - image)[:, hidden].abs().mean() > 0.05
        assert spoiled[:, hidden].std(-1).min() > 0.05
        p_cam = plain.camera.ray_grid()[hidden].mean(0).double()
        middles.append((covered.pose(index)[:3, :3] @ p_cam)[:2])
    assert sum(shares) / len(shares) == pytest.approx(share, rel=0.03)
    assert min(shares) > 0.85 * share
    assert max(shares) < 1.15 * share
    # it sways about the camera
    at = torch.stack(middles)
    bearing = torch.atan2(at[:, 1], at[:, 0])
    assert torch.sin(bearing[:, None] - bearing).abs().max() > math.sin(math.radians(20))


def test_a_moving_object_changes_nothing_else_and_is_the_same_for_one_seed():
    settings = {"frames": 40, "world": "pillars", "moving_objects": 1}
    first, again, other = (SyntheticSequence(small(**settings, moving_share=s)) for s in (0.2, 0.2, 0.0))
    assert torch.equal(first.truth.T_world_cam, other.truth.T_world_cam)
    assert np.array_equal(first.frame(30).image, again.frame(30).image)
    reach, plain = first.range(30), other.range(30)
    assert torch.equal(reach[reach >= plain], plain[reach >= plain])


def test_the_field_has_sky_over_half_of_the_view_without_structure():
    sequence = SyntheticSequence(small(world="field", frames=90))
    area = sequence.camera.solid_angle(sequence.camera.pixel_grid())
    for index in (0, 45, 89):
        image, reach = sequence.render(index)
        sky = reach.isinf()
        assert 0.46 < float(area[sky].sum() / area.sum()) < 0.5
        assert image[:, sky].std(-1).max() < 0.03
        assert image[:, ~sky].std(-1).min() > 0.08


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


def test_exposure_jumps_by_two_stops_and_clips_what_is_too_bright():
    sequence = SyntheticSequence(small(exposure="jumps", motion="still", frames=60))
    assert sequence.gains[[0, 19, 20, 39, 40]].tolist() == [0.5, 0.5, 2.0, 2.0, 0.5]
    dark, bright = (sequence.frame(k).image.astype(np.float64) for k in (19, 20))
    clipped = bright == 255
    assert 0.1 < clipped.mean() < 0.9
    assert np.abs(dark * 4 - bright)[~clipped].max() <= 2.5
    colour, _ = sequence.render(20)
    expected = (2 * colour).clamp(0, 1) * 255
    shown = torch.from_numpy(sequence.frame(20).image).permute(2, 0, 1)
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


@pytest.mark.parametrize("camera", ["equirectangular", "pinhole"])
@pytest.mark.parametrize(("axis", "offset"), [("x", (0.2, 0.0, 0.0)), ("y", (0.0, 0.2, 0.0))])
def test_a_stereo_pair_shows_what_the_moved_camera_sees_at_the_same_time(camera, axis, offset):
    settings = {"camera": camera, "frames": 30, "exposure": "drift", "moving_objects": 2}
    single = SyntheticSequence(small(**settings))
    pair = SyntheticSequence(small(**settings, stereo_baseline=0.2, stereo_axis=axis))
    assert single.rig is None
    assert pair.rig is not None
    assert pair.rig.cameras == (pair.camera, pair.camera)
    assert pair.rig.baseline(1) == pytest.approx(0.2)
    assert torch.equal(single.truth.T_world_cam, pair.truth.T_world_cam)
    alone, frame = single.frame(20), pair.frame(20)
    assert alone.others == ()
    assert np.array_equal(alone.image, frame.image)
    T_world_second = pair.pose(20).clone()
    T_world_second[:3, 3] += T_world_second[:3, :3] @ torch.tensor(offset, dtype=torch.float64)
    assert frame.image is not None
    colour, _ = pair.world.render(pair.camera, T_world_second, t=20 / 30)
    expected = (float(pair.gains[20]) * colour + float(pair.offsets[20])).clamp(0, 1) * 255
    (second,) = frame.others
    assert second.dtype == np.uint8
    torch.testing.assert_close(torch.from_numpy(second).permute(2, 0, 1).float(), expected, atol=0.51, rtol=0)
    assert not np.array_equal(second, frame.image)
    T_second_first = pair.rig.T_other_first(1)
    torch.testing.assert_close(T_second_first, se3_inverse(T_world_second) @ pair.pose(20), atol=1e-12, rtol=0)


def test_the_noise_of_a_stereo_pair_is_independent_and_leaves_the_first_image_alone():
    noisy, clean = (SyntheticSequence(small(noise=noise, stereo_baseline=0.1)).frame(3) for noise in (0.05, 0.0))
    single = SyntheticSequence(small(noise=0.05)).frame(3)
    assert np.array_equal(single.image, noisy.image)
    first, second = (noisy.image, clean.image), (noisy.others[0], clean.others[0])
    inner = (np.minimum(first[1], second[1]) > 64) & (np.maximum(first[1], second[1]) < 191)
    noise = [(seen.astype(np.float64) - true)[inner] / 255 for seen, true in (first, second)]
    assert noise[1].std() == pytest.approx(0.05, rel=0.05)
    assert abs(np.corrcoef(*noise)[0, 1]) < 0.05


@pytest.mark.parametrize("name", WORLDS)
def test_the_second_camera_stays_in_free_space(name):
    world = make_world(name, seed=9, moving_objects=2)
    for seed in range(5):
        poses = trajectory("walk", world.walkway, 150, 30.0, seed=seed)
        for axis in range(2):
            at = poses[:, :3, 3] + MAX_BASELINE * poses[:, :3, axis]
            for t in (0.0, 1.5, 3.0):
                assert world.clearance(at, t).min() > 0.1


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"world": "cave"}, "world: expected one of room, pillars, courtyard, field, got 'cave'."),
        ({"camera": "fisheye"}, "camera: expected one of equirectangular, pinhole, got 'fisheye'."),
        ({"motion": "fly"}, f"motion: expected one of {', '.join(MOTIONS)}, got 'fly'."),
        ({"exposure": "auto"}, "exposure: expected one of constant, steps, jumps, drift, got 'auto'."),
        ({"frames": 0}, "frames: expected an integer of at least 1, got 0."),
        ({"seed": 2**32}, "seed: expected at most 4294967295, got 4294967296."),
        ({"frames": 2.5}, "frames: expected an integer of at least 1, got 2.5."),
        ({"width": 300, "height": 200}, "width: expected twice the height for a panorama, got 300 x 200."),
        ({"fps": 0.0}, "fps: expected a finite number above 0 at most 1e+06, got 0.0."),
        ({"fov_deg": 180.0}, "fov_deg: expected a finite number above 0 at most 170, got 180.0."),
        ({"stereo_baseline": -0.1}, "stereo_baseline: expected 0 or a number from 0.001 to 0.4, got -0.1."),
        ({"stereo_baseline": math.nan}, "stereo_baseline: expected 0 or a number from 0.001 to 0.4, got nan."),
        (
            {"moving_share": 0.2, "stereo_baseline": 0.1},
            "moving_share: expected 0 with a second camera, got 0.2.",
        ),
        ({"stereo_axis": "z"}, "stereo_axis: expected one of x, y, got 'z'."),
        ({"noise": -0.1}, "noise: expected a number from 0 to 1, got -0.1."),
        ({"noise": math.nan}, "noise: expected a number from 0 to 1, got nan."),
        ({"moving_share": 0.5}, "moving_share: expected a number from 0 to 0.4, got 0.5."),
        ({"moving_share": math.nan}, "moving_share: expected a number from 0 to 0.4, got nan."),
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
