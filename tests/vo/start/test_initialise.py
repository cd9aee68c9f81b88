"""The start: it waits with the right reason, begins with the right direction, and a wrong one is corrected."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.checks import InputError
from torchvo360.data.frame import Frame
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.evaluation import evaluate
from torchvo360.motion.essential import TwoView, inverse_ranges
from torchvo360.vo import OdometryConfig, State, VisualOdometry
from torchvo360.vo.frame import FrameBuilder
from torchvo360.vo.start import initialise
from torchvo360.vo.start.initialise import InitialiseConfig, Initialiser, Start
from torchvo360.vo.start.refine import JointState
from torchvo360.window import Window


class Recording:
    """A rendered sequence."""

    def __init__(self, **settings) -> None:
        self.sequence = SyntheticSequence(SyntheticConfig(**{"width": 256, "height": 128, **settings}))
        self.frames = list(self.sequence)

    def T_cam_first(self, index: int) -> Tensor:
        return lie.se3_inverse(self.sequence.pose(index)) @ self.sequence.pose(0)


@pytest.fixture(scope="module")
def walk() -> Recording:
    return Recording(frames=40, seed=1)


@pytest.fixture(scope="module")
def sharp() -> Recording:
    return Recording(frames=30, seed=1, width=512, height=256)


def initialiser(recording: Recording, seed: int = 0, **settings) -> Initialiser:
    config = OdometryConfig()
    builder = FrameBuilder(recording.sequence.camera, 3, config.blur_px, None, config.saturation)
    return Initialiser(
        builder, InitialiseConfig(**settings), config.map, config.track, config.epipolar, config.filter,
        torch.Generator().manual_seed(seed),
    )  # fmt: skip


def feed(starter: Initialiser, frames: list[Frame]) -> tuple[list[str], Start | None]:
    """Give frames until there is a start; return the reasons on the way."""
    reasons = []
    for frame in frames:
        assert frame.image is not None
        ready = starter.builder.build(frame.image, frame.index, frame.t_ns)
        if starter.pending:
            start = starter.add(ready)
            reasons.append(starter.reason)
            if start is not None:
                return reasons, start
        else:
            starter.begin(ready)
            reasons.append(starter.reason)
    return reasons, None


def direction_deg(a: Tensor, b: Tensor) -> float:
    return math.degrees(math.acos(float((a @ b / a.norm() / b.norm()).clamp(-1, 1))))


@pytest.mark.parametrize(("world", "seed"), [("room", 1), ("pillars", 0), ("courtyard", 2)])
def test_a_walk_starts_within_a_degree_of_its_true_direction(world, seed):
    recording = Recording(world=world, frames=14, seed=seed, width=512, height=256)
    reasons, start = feed(initialiser(recording), recording.frames)
    assert start is not None
    assert reasons[0] == "first_frame"
    assert set(reasons[1:-1]) <= {"low_parallax"}
    assert reasons[-1] == "ok"
    newest = max(start.T_cam_key)
    T, true = start.T_cam_key[newest], recording.T_cam_first(newest)
    assert direction_deg(T[:3, 3], true[:3, 3]) < 1.0
    assert float(lie.so3_angle(T[:3, :3] @ true[:3, :3].mT).rad2deg()) < 0.1
    # one scale explains pose and inverse ranges
    trusted = start.key.trusted(0.05)
    assert int(trusted.sum()) > 1000
    true_rho = 1 / recording.sequence.range(0).flatten()[start.key.pixel][trusted]
    near = true_rho > 0.02
    scale = float(T[:3, 3].norm() / true[:3, 3].norm())
    relative = (start.key.points.rho[trusted] * scale / true_rho)[near]
    assert float(relative.median()) == pytest.approx(1.0, abs=0.03)
    assert float(((relative - 1).abs() < 0.15).float().mean()) > 0.85
    assert float(start.key.points.rho[trusted].median()) == pytest.approx(1.0, rel=0.3), "the unit"


def test_a_pure_rotation_waits_for_parallax_and_knows_its_rotations():
    recording = Recording(motion="rotation", frames=30, seed=0, width=512, height=256)
    starter = initialiser(recording)
    reasons, start = feed(starter, recording.frames)
    assert start is None
    assert set(reasons[1:]) == {"low_parallax"}
    for index in (5, 15, 29):
        error = lie.so3_angle(starter.rotations[index] @ recording.T_cam_first(index)[:3, :3].mT)
        assert float(error.rad2deg()) < 0.5


def test_a_camera_that_stands_still_waits_also_under_noise():
    recording = Recording(motion="still", frames=12, seed=0, noise=0.02)
    reasons, start = feed(initialiser(recording), recording.frames)
    assert start is None
    assert set(reasons[1:]) == {"low_parallax"}


def test_without_texture_there_are_few_tracks(walk):
    blank = [replace(frame, image=np.full((128, 256, 3), 90, np.uint8)) for frame in walk.frames[:5]]
    starter = initialiser(walk)
    reasons, start = feed(starter, blank)
    assert start is None
    assert set(reasons[1:]) == {"few_tracks"}
    assert starter.pending[0].index == 4, "it begins anew with every frame"


def test_unrelated_frames_never_start(walk):
    rng = np.random.default_rng(0)
    noise = [replace(frame, image=rng.integers(0, 255, (128, 256, 3), np.uint8)) for frame in walk.frames[:6]]
    reasons, start = feed(initialiser(walk), noise)
    assert start is None
    assert set(reasons[1:]) <= {"few_tracks", "few_inliers", "low_cheirality"}


def test_the_reference_changes_when_its_corners_are_gone(walk):
    other = Recording(world="courtyard", frames=3, seed=5)
    starter = initialiser(walk)
    frames = [*walk.frames[:2], *(replace(frame, index=frame.index + 2) for frame in other.frames)]
    reasons, _ = feed(starter, frames)
    assert "few_tracks" in reasons
    assert starter.pending[0].index >= 2


def test_waiting_keeps_a_bounded_number_of_frames_and_every_rotation():
    recording = Recording(motion="still", frames=1, seed=0)
    still = [replace(recording.frames[0], index=i, t_ns=i) for i in range(70)]
    starter = initialiser(recording, max_pending=10)
    feed(starter, still)
    assert len(starter.pending) <= 11
    assert starter.pending[0].index == 0
    assert starter.pending[-1].index == 69
    assert sorted(starter.rotations) == list(range(70))


def test_a_check_that_waits_keeps_a_bounded_number_of_frames(walk):
    """A camera that stops right after its start may stand for hours before the check has its parallax."""
    starter = initialiser(walk, max_pending=10)
    reasons, start = feed(starter, walk.frames)
    assert start is not None
    last = walk.frames[len(reasons) - 1]
    assert last.image is not None
    T = start.T_cam_key[last.index]
    for index in range(last.index + 1, last.index + 60):
        over, new = starter.check(starter.builder.build(last.image, index, index), T)
        assert not over
        assert new is None
    assert len(starter.pending) <= 11


def test_a_right_start_is_confirmed_once(sharp):
    starter = initialiser(sharp)
    reasons, start = feed(starter, sharp.frames)
    assert start is not None
    answers = []
    for frame in sharp.frames[len(reasons) :]:
        assert frame.image is not None
        ready = starter.builder.build(frame.image, frame.index, frame.t_ns)
        answers.append(starter.check(ready, sharp.T_cam_first(frame.index)))
        if answers[-1][0]:
            break
    assert answers[-1][0]
    assert all(new is None for _, new in answers)


def test_a_start_that_disagrees_with_the_corners_is_replaced(sharp):
    starter = initialiser(sharp)
    reasons, start = feed(starter, sharp.frames)
    assert start is not None
    wrong = lie.so3_exp(torch.tensor([0.0, math.radians(20), 0.0], dtype=torch.float64))
    for frame in sharp.frames[len(reasons) :]:
        assert frame.image is not None
        T = sharp.T_cam_first(frame.index)
        T[:3, 3] = wrong @ T[:3, 3]
        over, new = starter.check(starter.builder.build(frame.image, frame.index, frame.t_ns), T)
        if over:
            break
    else:
        pytest.fail("the check never ended")
    assert new is not None
    newest = max(new.T_cam_key)
    assert direction_deg(new.T_cam_key[newest][:3, 3], sharp.T_cam_first(newest)[:3, 3]) < 1.5


def spoil_the_first_start(monkeypatch: pytest.MonkeyPatch, error_deg: float) -> list[None]:
    """Give the first essential matrix a wrong direction, and let the refinement that would mend it take no step.

    The list returned has an item for every start.
    """
    starts: list[None] = []
    original_start, original_refine = Initialiser._start, initialise.refine_jointly

    def spoiled(self: Initialiser, view: TwoView) -> Start | None:
        starts.append(None)
        if len(starts) == 1:
            t = lie.so3_exp(torch.tensor([0.0, math.radians(error_deg), 0.0]).double()) @ view.t_tgt_ref
            rho = inverse_ranges(view.R_tgt_ref, t, self.tracks.origins, self.tracks.now)
            view = view._replace(t_tgt_ref=t, rho=rho)
        return original_start(self, view)

    def idle(*args, **kwargs) -> JointState:
        return original_refine(*args, **kwargs, max_steps=0 if len(starts) == 1 else 15)

    monkeypatch.setattr(Initialiser, "_start", spoiled)
    monkeypatch.setattr(initialise, "refine_jointly", idle)
    return starts


@pytest.mark.parametrize("error_deg", [15, 40])
def test_the_window_mends_a_wrong_start_at_once(sharp, monkeypatch, error_deg):
    starts = spoil_the_first_start(monkeypatch, error_deg)
    odometry = VisualOdometry(sharp.sequence.camera)
    online = [odometry.step(frame) for frame in sharp.frames]
    begun = next(estimate for estimate in online if estimate.state == State.TRACKING)
    true = sharp.T_cam_first(begun.index).inverse()[:3, 3]
    assert direction_deg(begun.T_world_cam[:3, 3], true) < 1
    assert {estimate.reason for estimate in online[begun.index :]} == {"ok"}, "confirmed: nothing is left to correct"
    assert len(starts) == 1
    assert evaluate(odometry.finish().trajectory, sharp.sequence.truth).ate_percent < 0.06


@pytest.mark.parametrize("error_deg", [15, 40])
def test_the_odometry_corrects_a_wrong_start_and_rewrites_the_poses_before(sharp, monkeypatch, error_deg):
    """Here the first map's window takes no step either."""
    starts = spoil_the_first_start(monkeypatch, error_deg)
    original = Window.optimise
    monkeypatch.setattr(Window, "optimise", lambda self, steps=None: original(self, 0 if len(starts) == 1 else steps))
    odometry = VisualOdometry(sharp.sequence.camera)
    online = [odometry.step(frame) for frame in sharp.frames]
    corrected = [place for place, estimate in enumerate(online) if estimate.reason == "start_corrected"]
    assert len(corrected) == 1
    assert len(starts) == 2
    assert online[corrected[0]].state == State.TRACKING
    result = odometry.finish()
    assert evaluate(result.trajectory, sharp.sequence.truth).ate_percent < 0.06
    assert result.maps == 1, "the wrong one is taken back"
    before = corrected[0] - 1
    true = sharp.T_cam_first(before).inverse()[:3, 3]
    assert direction_deg(online[before].T_world_cam[:3, 3], true) > 8
    assert direction_deg(result.frames[before].T_world_cam[:3, 3], true) < 1


def test_a_start_in_another_unit_is_the_same_start(walk):
    _, start = feed(initialiser(walk), walk.frames)
    assert start is not None
    rho, variance, _ = start.key.points
    newest = max(start.T_cam_key)
    product = start.T_cam_key[newest][:3, 3].norm() * rho.double()
    scaled = start.rescaled(2.5)
    torch.testing.assert_close(scaled.T_cam_key[newest][:3, 3].norm() * scaled.key.points.rho.double(), product)
    torch.testing.assert_close(scaled.key.points.variance / scaled.key.points.rho**2, variance / rho**2)
    torch.testing.assert_close(scaled.T_cam_key[newest][:3, :3], start.T_cam_key[newest][:3, :3])


def test_equal_seeds_start_alike(walk):
    starts = [feed(initialiser(walk, seed=3), walk.frames)[1] for _ in range(2)]
    assert starts[0] is not None
    assert starts[1] is not None
    newest = max(starts[0].T_cam_key)
    assert torch.equal(starts[0].T_cam_key[newest], starts[1].T_cam_key[newest])
    assert torch.equal(starts[0].key.points.rho, starts[1].key.points.rho)


@pytest.mark.parametrize(
    ("name", "value"),
    [("min_tracks", 4), ("max_pending", 2), ("targets", 0), ("parallax_deg", 0.0), ("min_inliers", 1.5)],
)
def test_unusable_settings_are_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        InitialiseConfig(**{name: value})
