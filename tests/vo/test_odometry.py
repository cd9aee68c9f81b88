"""The odometry as a whole on rendered sequences: accurate on good days, honest and alive on bad ones."""

import gc
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Camera, Equirectangular
from torchvo360.checks import InputError
from torchvo360.data.frame import Frame
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.data.trajectory import Trajectory
from torchvo360.evaluation import Evaluation, evaluate
from torchvo360.vo import FrameEstimate, OdometryConfig, OdometryResult, State, VisualOdometry
from torchvo360.vo.frame import PyramidFrame

WIDTH, STEP_NS = 256, 33_333_333
CLEAN = OdometryConfig(blur_px=0.5)
WORDS = {
    "ok", "first_frame", "low_parallax", "few_tracks", "few_inliers", "low_cheirality", "refinement_failed",
    "low_agreement", "no_agreement", "restarting", "new_map", "present_keyframe", "earlier_keyframe",
    "start_corrected", "maps_joined", "bad_frame_black", "bad_frame_unreadable",
}  # fmt: skip
PLACED = (State.TRACKING, State.WEAK, State.RELOCALISED)


@dataclass(frozen=True)
class Recording:
    """Frames with their true poses, renumbered and timed anew, as a camera would have delivered them."""

    camera: Camera
    frames: list[Frame]
    T_world_cam: Tensor

    @classmethod
    def of(cls, frames: Sequence[Frame], T_world_cam: Tensor) -> "Recording":
        width = next(frame.image.shape[1] for frame in frames if frame.image is not None)
        numbered = [replace(frame, index=k, t_ns=k * STEP_NS) for k, frame in enumerate(frames)]
        return cls(Equirectangular(width, width // 2), numbered, T_world_cam)

    @classmethod
    def rendered(cls, **settings) -> "Recording":
        sequence = SyntheticSequence(SyntheticConfig(**{"width": WIDTH, "height": WIDTH // 2, **settings}))
        return cls.of(list(sequence), sequence.truth.T_world_cam)

    def __len__(self) -> int:
        return len(self.frames)

    def pick(self, order: Sequence[int]) -> "Recording":
        """Return the frames in another order, some left out or repeated."""
        return self.of([self.frames[k] for k in order], self.T_world_cam[list(order)])

    def then(self, other: "Recording") -> "Recording":
        return self.of([*self.frames, *other.frames], torch.cat([self.T_world_cam, other.T_world_cam]))

    def without_images(self, lost: range, problem: str) -> "Recording":
        frames = [replace(f, image=None, problem=problem) if f.index in lost else f for f in self.frames]
        return replace(self, frames=frames)

    def with_images(self, change) -> "Recording":
        """Apply `change(index, image)` to the images, values 0 to 255."""
        frames = []
        for frame in self.frames:
            assert frame.image is not None
            image = change(frame.index, frame.image.astype(np.float32)).clip(0, 255).astype(np.uint8)
            frames.append(replace(frame, image=np.ascontiguousarray(image)))
        return replace(self, frames=frames)

    def rolled(self, columns: Sequence[int]) -> "Recording":
        """Turn the camera about its vertical: frame k's image moves right by columns[k]."""
        out = self.with_images(lambda k, image: np.roll(image, columns[k], 1))
        return replace(out, T_world_cam=self.T_world_cam @ yaw(torch.tensor(columns)).mT)

    @property
    def truth(self) -> Trajectory:
        return Trajectory(torch.arange(len(self)) * STEP_NS, self.T_world_cam)


def yaw(columns: Tensor) -> Tensor:
    """T that turns rays as an image moved right by some columns does."""
    angle = columns.double() * (math.tau / WIDTH)
    axis = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return lie.se3(lie.so3_exp(angle[:, None] * axis), torch.zeros(len(columns), 3, dtype=torch.float64))


def run(recording: Recording, **settings) -> OdometryResult:
    odometry = VisualOdometry(recording.camera, **settings)
    for frame in recording.frames:
        odometry.step(frame)
    result = odometry.finish()
    check_complete(recording, result)
    return result


def check_complete(recording: Recording, result: OdometryResult) -> None:
    """Every frame has one finite pose, a state and a known word, whatever happened."""
    assert [estimate.index for estimate in result.frames] == [frame.index for frame in recording.frames]
    assert result.trajectory.t_ns.tolist() == [frame.t_ns for frame in recording.frames]
    stacked = torch.stack([estimate.T_world_cam for estimate in result.frames])
    assert torch.equal(stacked, result.trajectory.T_world_cam)
    assert bool(stacked.isfinite().all())
    R = stacked[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R), rtol=0, atol=1e-9)
    for estimate in result.frames:
        assert estimate.reason in WORDS
        assert estimate.milliseconds > 0
        assert math.isnan(estimate.inliers) or 0 <= estimate.inliers <= 1
        assert (estimate.state == State.TRACKING) <= (estimate.reason in ("ok", "start_corrected"))
        assert estimate.reason != "earlier_keyframe" or estimate.inliers >= OdometryConfig().weak_inliers
    assert bool(result.points.xyz.isfinite().all())
    assert len(result.points.xyz) == len(result.points.rgb)
    assert result.before_loops.t_ns.tolist() == result.trajectory.t_ns.tolist()
    if not result.loops:
        assert torch.equal(result.before_loops.T_world_cam, result.trajectory.T_world_cam)
    assert result.intrinsics is None


def states(result: OdometryResult) -> list[State]:
    return [estimate.state for estimate in result.frames]


def after_start(result: OdometryResult) -> list[FrameEstimate]:
    return [estimate for estimate in result.frames if estimate.state != State.INITIALISING]


def errors(result: OdometryResult, recording: Recording, keep: Sequence[int] | None = None) -> Evaluation:
    """Compare all frames, or some of them, with the truth."""
    keep = list(range(len(recording))) if keep is None else list(keep)
    estimate, truth = result.trajectory, recording.truth
    return evaluate(
        Trajectory(estimate.t_ns[keep], estimate.T_world_cam[keep]),
        Trajectory(truth.t_ns[keep], truth.T_world_cam[keep]),
    )


# Good days


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [{"world": "room"}, {"world": "pillars", "exposure": "steps"}, {"world": "courtyard", "yaw_jump_deg": 20.0}],
    ids=["room", "pillars", "courtyard"],
)
def test_on_three_worlds_of_150_frames_the_ate_is_at_most_0_03_percent(settings):
    recording = Recording.rendered(frames=150, width=512, height=256, **settings)
    result = run(recording, config=CLEAN)
    figures = errors(result, recording)
    assert figures.ate_percent <= 0.03
    assert figures.coverage == 1.0
    assert figures.rotation_median_deg < 0.03
    assert {estimate.state for estimate in after_start(result)} == {State.TRACKING}
    assert result.maps == 1
    assert result.keyframes >= 10
    per_keyframe = len(result.points.xyz) / result.keyframes
    assert 0.55 * CLEAN.map.points < per_keyframe <= CLEAN.map.points, "half of the courtyard is sky"


@pytest.mark.parametrize(("world", "seed"), [("room", 4), ("pillars", 7), ("courtyard", 11)])
def test_other_worlds_of_half_the_size_are_followed_too(world, seed):
    recording = Recording.rendered(world=world, frames=60, seed=seed)
    result = run(recording)
    assert errors(result, recording).ate_percent < 0.1
    assert {estimate.state for estimate in after_start(result)} == {State.TRACKING}


def test_moving_objects_are_survived():
    recording = Recording.rendered(frames=60, seed=2, moving_objects=3)
    assert errors(run(recording), recording).ate_percent < 0.15


@pytest.fixture(scope="module")
def walk() -> Recording:
    """One walk for all that follows: every test spoils it in its own way."""
    return Recording.rendered(frames=70, seed=0)


@pytest.fixture(scope="module")
def plain(walk: Recording) -> OdometryResult:
    return run(walk)


def test_the_undisturbed_walk_is_accurate(walk, plain):
    figures = errors(plain, walk)
    assert figures.ate_percent < 0.08
    assert figures.coverage == 1.0
    assert len(after_start(plain)) >= 64
    torch.testing.assert_close(plain.trajectory.T_world_cam[0], torch.eye(4, dtype=torch.float64), rtol=0, atol=1e-9)
    assert all(estimate.residual < 0.03 for estimate in after_start(plain) if not math.isnan(estimate.residual))


def test_the_map_lies_on_the_surfaces_of_the_world(walk, plain):
    """Every point is seen again from its nearest camera at the range that was rendered there."""
    T = errors(plain, walk).T_truth_estimate
    xyz = plain.points.xyz.double() @ T[:3, :3].mT + T[:3, 3]
    world = SyntheticSequence(SyntheticConfig(width=WIDTH, height=WIDTH // 2, frames=70, seed=0))
    index = 35
    T_cam_world = lie.se3_inverse(walk.T_world_cam[index])
    p_cam = xyz @ T_cam_world[:3, :3].mT + T_cam_world[:3, 3]
    uv, _ = walk.camera.project(p_cam)
    range_m = world.range(index)[uv[:, 1].long().clamp(max=127), uv[:, 0].long().clamp(max=255)]
    relative = (p_cam.norm(dim=-1) - range_m).abs() / range_m
    assert float(relative.median()) < 0.05, "some are hidden from there"


def test_equal_runs_give_equal_bits(walk, plain):
    again = run(walk)
    assert torch.equal(again.trajectory.T_world_cam, plain.trajectory.T_world_cam)
    assert torch.equal(again.points.xyz, plain.points.xyz)
    for name in ("index", "t_ns", "state", "reason"):
        assert [getattr(e, name) for e in again.frames] == [getattr(e, name) for e in plain.frames]
    for name in ("residual", "inliers", "a", "b"):
        first, second = ([getattr(e, name) for e in result.frames] for result in (again, plain))
        np.testing.assert_array_equal(first, second)


@pytest.mark.slow
def test_another_number_of_threads_changes_the_rounding_only(walk, plain):
    """Sums have another order: not the same bits, but the same trajectory far below its error."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        other = run(walk.pick(range(16)))
    finally:
        torch.set_num_threads(threads)
    assert evaluate(other.trajectory, plain.trajectory).ate_percent < 0.1


@pytest.mark.parametrize("columns", [64, 201])
def test_turning_the_whole_recording_turns_the_trajectory(walk, plain, columns):
    turned = run(walk.rolled([columns] * len(walk)))
    T = yaw(torch.tensor([columns]))[0].mT
    back = T @ turned.trajectory.T_world_cam @ T.mT
    figures = evaluate(Trajectory(turned.trajectory.t_ns, back), plain.trajectory)
    assert figures.ate_percent < 0.1
    R = back[:, :3, :3].mT @ plain.trajectory.T_world_cam[:, :3, :3]
    assert float(lie.so3_angle(R).rad2deg().median()) < 0.2


# Bad frames


@pytest.mark.parametrize("problem", ["black", "unreadable"])
def test_frames_that_cannot_be_used_get_a_prediction_and_the_run_goes_on(walk, problem):
    dark = range(30, 40) if problem == "black" else range(30, 31)
    result = run(walk.without_images(dark, problem))
    for index in dark:
        assert result.frames[index].state == State.WEAK
        assert result.frames[index].reason == f"bad_frame_{problem}"
    assert result.frames[dark.stop].state == State.TRACKING
    good = [k for k in range(len(walk)) if k not in dark]
    assert errors(result, walk, good).ate_percent < 0.1
    assert errors(result, walk).ate_percent < 0.8
    bridged = result.trajectory.positions[dark.start - 1 : dark.stop + 1].diff(dim=0).norm(dim=-1)
    inner = bridged[1:-1]
    assert len(inner) == 0 or float(inner.max() / inner.min()) < 1.01, "an even motion between those that were found"
    assert float(bridged.max() / bridged.min()) < 1.1
    assert State.LOST not in states(result)


def test_bad_frames_at_the_start_and_at_the_end_are_survived(walk):
    short = walk.pick(range(24))
    result = run(short.without_images(range(6), "black"))
    assert [estimate.reason for estimate in result.frames[:6]] == ["bad_frame_black"] * 6
    assert states(result)[:6] == [State.INITIALISING] * 6
    assert errors(result, short, range(6, 24)).ate_percent < 0.2
    result = run(short.without_images(range(18, 24), "unreadable"))
    assert states(result)[18:] == [State.WEAK] * 6
    result = run(short.without_images(range(24), "black"))
    assert set(states(result)) == {State.INITIALISING}


def test_a_recording_of_bad_frames_only_has_poses(walk):
    result = run(walk.pick(range(4)).without_images(range(4), "unreadable"))
    assert result.keyframes == 0
    assert len(result.points.xyz) == 0


@pytest.mark.parametrize("turn_columns", [0, 70], ids=["straight", "turned"])
@pytest.mark.parametrize("count", [1, 6])
def test_a_hand_over_the_lens_is_lost_and_what_follows_is_found(walk, count, turn_columns):
    """Frames full of contrast that show nothing of the scene, while the camera may turn by 98 deg."""
    rng = np.random.default_rng(0)
    covered = range(25, 25 + count)
    turned = walk.rolled([turn_columns if k >= 25 else 0 for k in range(len(walk))])
    hidden = turned.with_images(lambda k, image: rng.uniform(0, 255, image.shape) if k in covered else image)
    result = run(hidden)
    assert all(result.frames[k].state == State.LOST for k in covered)
    assert result.frames[covered.stop].state == State.RELOCALISED
    good = [k for k in range(len(walk)) if k not in covered]
    assert errors(result, turned, good).ate_percent < 0.1
    assert states(result)[covered.stop + 1 :] == [State.TRACKING] * (len(walk) - covered.stop - 1)


def test_a_turn_that_ends_in_the_dark_is_caught():
    """The prediction turns on through six dark frames; the last frame that was found is the one to compare with."""
    walk = Recording.rendered(world="pillars", frames=40, seed=1)
    dark = range(14, 20)
    turned = walk.rolled([3 * min(k, dark.start) for k in range(len(walk))])
    result = run(turned.without_images(dark, "black"))
    assert State.LOST not in states(result)
    good = [k for k in range(len(walk)) if k not in dark]
    assert errors(result, turned, good).ate_percent < 0.12


# Bad motion and light


def test_a_random_yaw_every_five_frames_is_followed(walk):
    rng = np.random.default_rng(0)
    jumps = np.repeat(rng.integers(0, WIDTH, 20), 5)
    jumps[:10] = 0  # the start needs its corners
    turned = walk.rolled(jumps[: len(walk)].tolist())
    result = run(turned)
    figures = errors(result, turned)
    assert figures.ate_percent < 0.1
    assert figures.rotation_median_deg < 0.1
    assert {estimate.state for estimate in after_start(result)} <= {State.TRACKING, State.WEAK}


@pytest.mark.parametrize("kind", ["dropped", "doubled", "every_fourth", "reversed"])
def test_uneven_time_is_survived(walk, kind):
    order = {
        "dropped": [k for k in range(70) if k % 7 not in (2, 3, 4)],
        "doubled": sorted([*range(70), *range(8, 70, 5)]),
        "every_fourth": list(range(0, 70, 4)),
        "reversed": list(range(69, -1, -1)),
    }[kind]
    recording = walk.pick(order)
    result = run(recording)
    assert errors(result, recording).ate_percent < 0.12
    assert State.LOST not in states(result)


def test_heavy_noise_is_survived():
    recording = Recording.rendered(world="courtyard", frames=40, seed=0, noise=0.06, width=512, height=256)
    result = run(recording)
    assert errors(result, recording).ate_percent < 0.25
    assert State.LOST not in states(result)


@pytest.mark.parametrize(("low", "high"), [(0.25, 1.0), (0.5, 2.0)])
def test_the_exposure_jumping_by_two_stops_is_survived(walk, low, high):
    spoiled = walk.with_images(lambda k, image: image * (low if (k // 8) % 2 else high))
    result = run(spoiled)
    assert errors(result, walk).ate_percent < 0.15
    assert State.LOST not in states(result)
    gains = [estimate.a for estimate in result.frames if not math.isnan(estimate.a)]
    assert max(gains) - min(gains) > math.log(3)


def test_a_standstill_before_and_within_the_walk_costs_nothing(walk):
    recording = walk.pick([*[0] * 15, *range(40), *[40] * 15, *range(40, 70)])
    result = run(recording)
    assert errors(result, recording).ate_percent < 0.1
    assert set(states(result)[:15]) == {State.INITIALISING}
    standing = result.trajectory.positions[56:68]
    step = result.trajectory.positions[40:50].diff(dim=0).norm(dim=-1).mean()
    assert float(standing.diff(dim=0).norm(dim=-1).max()) < 0.1 * float(step)


def test_a_camera_that_only_turns_has_rotations_and_starts_when_it_walks():
    turning = Recording.rendered(motion="rotation", frames=25, seed=3, width=512, height=256)
    walking = SyntheticSequence(SyntheticConfig(frames=30, seed=3, width=512, height=256))
    # The walk begins where the turning ended: same place, and its frames turned by the difference.
    start = lie.se3_inverse(walking.pose(0)) @ turning.T_world_cam[-1]
    T = walking.truth.T_world_cam @ lie.se3(start[:3, :3], torch.zeros(3, dtype=torch.float64))
    images = walking.world.render(walking.camera, T)[0].clamp(0, 1).mul(255).round().byte().permute(0, 2, 3, 1)
    frames = [Frame(k, k, np.ascontiguousarray(image.numpy())) for k, image in enumerate(images)]
    recording = turning.then(Recording.of(frames, T))
    odometry = VisualOdometry(recording.camera)
    for frame in recording.frames[:25]:
        estimate = odometry.step(frame)
        assert estimate.state == State.INITIALISING
        assert estimate.reason in ("first_frame", "low_parallax")
        assert float(estimate.T_world_cam[:3, 3].norm()) == 0
        true = turning.T_world_cam[0].inverse() @ turning.T_world_cam[frame.index]
        error = lie.so3_angle(estimate.T_world_cam[:3, :3] @ true[:3, :3].mT).rad2deg()
        assert float(error) < 0.5
    for frame in recording.frames[25:]:
        odometry.step(frame)
    result = odometry.finish()
    check_complete(recording, result)
    assert states(result)[-1] == State.TRACKING
    offset = (turning.T_world_cam[-1, :3, 3] - T[0, :3, 3]).norm()
    assert float(offset) < 0.15, "the recording jumps a little between its parts"
    assert errors(result, recording, range(26, len(recording))).ate_percent < 0.1


# Losses


@pytest.mark.slow
def test_a_jump_back_is_found_in_an_earlier_keyframe():
    walk = Recording.rendered(world="pillars", frames=105, seed=1)
    recording = walk.pick([*range(105), *range(5, 30)])
    result = run(recording)
    back = result.frames[105:]
    found = [estimate for estimate in back if estimate.state == State.RELOCALISED]
    assert [estimate.reason for estimate in found] == ["earlier_keyframe"]
    first = found[0].index
    assert first <= 105 + 3
    assert {estimate.state for estimate in result.frames[first + 1 :]} == {State.TRACKING}
    placed = [*range(105), *range(first, len(recording))]
    assert errors(result, recording, placed).ate_percent < 0.1, "both visits lie in one world"


@pytest.mark.slow
def test_another_world_in_the_middle_is_lost_and_the_first_one_found_again(walk):
    other = Recording.rendered(world="courtyard", frames=30, seed=9)
    recording = walk.pick(range(40)).then(other).then(walk.pick(range(40, 70)))
    result = run(recording)
    assert result.frames[40].state == State.LOST
    reasons = [estimate.reason for estimate in result.frames if estimate.state == State.RELOCALISED]
    assert reasons
    assert set(reasons) <= {"new_map", "earlier_keyframe", "present_keyframe"}
    assert states(result)[-10:] == [State.TRACKING] * 10
    assert all(state in PLACED for state in states(result)[72:])
    assert errors(result, recording, [*range(40), *range(72, 100)]).ate_percent < 0.1, "both visits lie in one world"


@pytest.mark.slow
def test_what_never_comes_back_is_restarted_and_joined(walk):
    other = Recording.rendered(world="courtyard", frames=45, seed=9)
    recording = walk.pick(range(30)).then(other)
    result = run(recording)
    lost = [estimate for estimate in result.frames if estimate.state == State.LOST]
    restart = OdometryConfig().restart_after
    assert [estimate.reason for estimate in lost[:restart]] == ["no_agreement"] * (restart - 1) + ["restarting"]
    new = [estimate.index for estimate in result.frames if estimate.reason == "new_map"]
    assert len(new) == 1
    assert states(result)[-1] == State.TRACKING
    # the new map is accurate in itself, and begins where the old one ended
    second = range(30 + restart, len(recording))
    assert errors(result, recording, second).ate_percent < 0.3
    joint = result.trajectory.positions[30 + restart - 1] - result.trajectory.positions[29]
    assert float(joint.norm()) < 0.2 * float(result.trajectory.positions[29].norm())
    assert len(result.points.xyz) > len(run(walk.pick(range(30))).points.xyz)


# The contract of step and finish


def test_finish_may_be_called_at_any_moment_and_the_run_goes_on(walk, plain):
    odometry = VisualOdometry(walk.camera)
    empty = odometry.finish()
    assert empty.frames == []
    assert len(empty.trajectory) == 0
    assert empty.points.xyz.shape == (0, 3)
    assert empty.keyframes == 0
    for count, frame in enumerate(walk.frames[:20], 1):
        odometry.step(frame)
        check_complete(walk.pick(range(count)), odometry.finish())
    for frame in walk.frames[20:]:
        odometry.step(frame)
    assert torch.equal(odometry.finish().trajectory.T_world_cam, plain.trajectory.T_world_cam)


def test_a_finished_result_does_not_change_with_later_frames(walk):
    odometry = VisualOdometry(walk.camera)
    for frame in walk.frames[:12]:
        odometry.step(frame)
    result = odometry.finish()
    poses, points = result.trajectory.T_world_cam.clone(), result.points.xyz.clone()
    for frame in walk.frames[12:24]:
        odometry.step(frame)
    assert torch.equal(result.trajectory.T_world_cam, poses)
    assert torch.equal(result.points.xyz, points)
    assert len(result.frames) == 12


def retained_frames() -> int:
    gc.collect()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # asking an object for its class wakes up deprecated ones
        return sum(type(each) is PyramidFrame for each in gc.get_objects())


@pytest.mark.parametrize("stop_after", [None, 4, 5], ids=["walk", "stops_at_the_start", "stops_after_it"])
def test_frames_are_not_retained(walk, stop_after):
    """The window's keyframes and the last frame; what waits, where the camera stops before its start is checked."""
    before = retained_frames()
    order = list(range(70)) if stop_after is None else [*range(stop_after), *[stop_after - 1] * 66]
    odometry = VisualOdometry(walk.camera)
    for frame in walk.pick(order).frames:
        odometry.step(frame)
    config = OdometryConfig()
    held = config.window.keyframes + 1
    assert 2 <= retained_frames() - before <= (held if stop_after is None else held + config.initialise.max_pending)
    odometry.finish()
    assert retained_frames() - before <= (held if stop_after is None else held + config.initialise.max_pending)
    del odometry
    assert retained_frames() == before


def test_every_keyframe_leaves_less_than_half_a_megabyte(walk):
    """What is held in the end, less what is held once the window is full, by the keyframes in between: all tensors."""
    odometry, held = VisualOdometry(walk.camera), []
    for frame in walk.pick([*range(70), *range(69, 0, -3)]).frames:
        odometry.step(frame)
        if frame.index in (49, 92):
            held.append((odometry.finish().keyframes, held_bytes()))
    (fewer, before), (more, after) = held
    assert fewer >= OdometryConfig().window.keyframes
    assert more >= fewer + 4
    assert (after - before) / (more - fewer) < 0.5 * 2**20


def held_bytes() -> int:
    """Return the bytes of all tensors' storages."""
    gc.collect()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        things = [each for each in gc.get_objects() if type(each) is Tensor]
        storages = {each.untyped_storage().data_ptr(): each.untyped_storage().nbytes() for each in things}
    return sum(storages.values())


def test_the_pose_of_a_past_frame_holds_no_larger_tensor_alive(walk, plain):
    odometry = VisualOdometry(walk.camera)
    online = [odometry.step(frame) for frame in walk.frames[:20]]
    for estimate in [*plain.frames, *online]:
        assert estimate.T_world_cam.untyped_storage().nbytes() == 8 * 16


def test_a_wrong_size_is_refused_in_one_sentence(walk):
    odometry = VisualOdometry(walk.camera)
    odometry.step(walk.frames[0])
    small = replace(walk.frames[1], image=np.zeros((64, 128, 3), np.uint8))
    with pytest.raises(InputError, match=r"image: expected shape \[128, 256, 3\], got \[64, 128, 3\]"):
        odometry.step(small)
    odometry.step(walk.frames[1])
    assert len(odometry.finish().frames) == 2


@pytest.mark.parametrize("field", ["t_ns", "index"])
@pytest.mark.parametrize("back", [0, 1])
def test_time_and_index_must_increase(walk, field, back):
    odometry = VisualOdometry(walk.camera)
    for frame in walk.frames[:3]:
        odometry.step(frame)
    wrong = replace(walk.frames[3], **{field: getattr(walk.frames[2], field) - back})
    with pytest.raises(InputError, match=f"{field}: expected more than"):
        odometry.step(wrong)
    unreadable = replace(wrong, image=None, problem="unreadable")
    with pytest.raises(InputError, match=field):
        odometry.step(unreadable)


def test_a_mask_of_another_size_is_refused(walk):
    with pytest.raises(InputError, match="mask"):
        VisualOdometry(walk.camera, mask=torch.ones(64, 128, dtype=torch.bool))


def test_a_mask_keeps_an_operator_out_who_turns_with_the_camera(walk):
    rng = np.random.default_rng(0)
    operator = rng.integers(0, 255, (40, WIDTH, 3))

    def covered(_: int, image: np.ndarray) -> np.ndarray:
        return np.concatenate([image[:88], operator])

    mask = torch.ones(128, WIDTH, dtype=torch.bool)
    mask[88:] = False
    recording = walk.pick(range(40)).with_images(covered)
    result = run(recording, mask=mask)
    assert errors(result, recording).ate_percent < 0.25
    assert State.LOST not in states(result)
