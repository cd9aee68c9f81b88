"""How a map begins: what waited is placed on it, a map after a loss keeps the unit, and a young one is watched over."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from torchvo360 import lie
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.learn.plugin import RangeEstimate
from torchvo360.vo import LEARNED, OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.start.begin import Begun, Starter
from torchvo360.vo.start.learned import LearnedRanges
from torchvo360.vo.start.pending import between

CONFIG = OdometryConfig(blur_px=0.5)
EYE = torch.eye(4, dtype=torch.float64)


class Walk:
    """Frames whose poses are known."""

    def __init__(self, *, motion: str = "walk", frames: int = 24, seed: int = 1) -> None:
        settings = SyntheticConfig(width=256, height=128, frames=frames, seed=seed, motion=motion)
        self.sequence = SyntheticSequence(settings)
        self.builder = FrameBuilder(self.sequence.camera, 3, CONFIG.blur_px, None, CONFIG.saturation)
        self.frames = [self.frame(index) for index in range(len(self.sequence))]

    def frame(self, index: int, image: np.ndarray | None = None) -> PyramidFrame:
        image = self.sequence.frame(index).image if image is None else image
        assert image is not None
        return self.builder.build(image, index, index)

    def T_key_cam(self, index: int, key: int = 0) -> Tensor:
        return lie.se3_inverse(self.sequence.pose(key)) @ self.sequence.pose(index)

    def starter(self, depth: nn.Module | None = None, seed: int = 0) -> Starter:
        learned = None
        if depth is not None:
            learned = LearnedRanges(depth, self.builder, CONFIG.map, CONFIG.track.min_points)
        return Starter(self.builder, CONFIG, torch.Generator().manual_seed(seed), learned, None)


class Ranges(nn.Module):
    """The true ranges of one frame whatever is shown, known to a tenth."""

    def __init__(self, walk: Walk, index: int, claims: float = 0.1) -> None:
        super().__init__()
        self._rho, self._claims = 1 / walk.sequence.range(index), claims

    def forward(self, image: Tensor) -> RangeEstimate:
        rho = self._rho[None].clone()
        return RangeEstimate(rho, (self._claims * rho).square())


def begin(starter: Starter, frames: list[PyramidFrame]) -> Begun:
    for frame in frames:
        begun = starter.add(frame)
        if begun is not None:
            return begun
    pytest.fail(f"no start: {starter.reason}")


def direction_deg(a: Tensor, b: Tensor) -> float:
    return math.degrees(math.acos(float((a @ b / a.norm() / b.norm()).clamp(-1, 1))))


@pytest.fixture(scope="module")
def walk() -> Walk:
    return Walk()


def test_a_map_begins_with_its_first_and_its_newest_frame_and_every_one_that_waited_between(walk):
    begun = begin(walk.starter(), walk.frames)
    poses = begun.mapper.poses()
    newest = begun.newest.index
    assert begun.reason == "ok"
    assert begun.key == 0
    assert sorted(poses)[0] == 0
    assert sorted(poses)[-1] == newest
    assert 2 <= len(poses) <= 3, "one more between them, where there is one"
    assert sorted(begun.T_key_cam) == list(range(newest))
    assert torch.equal(begun.T_key_cam[0], EYE)
    torch.testing.assert_close(begun.newest.T_world_key, poses[newest])
    assert begun.found is not None
    assert begun.found.inliers > 0.95
    unit = float(poses[newest][:3, 3].norm() / walk.T_key_cam(newest)[:3, 3].norm())
    for index, T in begun.T_key_cam.items():
        true = walk.T_key_cam(index)
        assert float((T[:3, 3] / unit - true[:3, 3]).norm()) < 0.004
        assert float(lie.so3_angle(T[:3, :3].mT @ true[:3, :3]).rad2deg()) < 0.2
    step = lie.se3_inverse(walk.sequence.pose(newest)) @ walk.sequence.pose(newest - 1)
    assert float((begun.motion[:3, 3] / unit - step[:3, 3]).norm()) < 0.005


def test_unusable_frames_while_it_waits_leave_gaps_that_are_filled_evenly(walk):
    frames = [frame for frame in walk.frames if frame.index not in (1, 2)]
    begun = begin(walk.starter(), frames)
    assert begun.newest.index >= 3
    placed = {**begun.T_key_cam, begun.newest.index: begun.newest.T_world_key}
    centres = torch.stack([placed[index][:3, 3] for index in (0, 1, 2, 3)])
    assert float(centres[3].norm()) > 0.01
    steps = centres.diff(dim=0)
    torch.testing.assert_close(steps[1], steps[0])
    torch.testing.assert_close(steps[2], steps[0])


def test_between_known_frames_positions_are_interpolated_and_rotations_are_the_corners():
    known = {0: EYE, 4: lie.se3_exp(torch.tensor([-0.4, 0.0, 0.8, 0.0, 0.1, 0.0], dtype=torch.float64))}
    R_cam_key = lie.so3_exp(torch.tensor([0.02, 0.03, 0.0], dtype=torch.float64))
    out = between([0, 1, 3, 4, 6], known, {1: R_cam_key})
    last = lie.se3_inverse(known[4])
    torch.testing.assert_close(out[0], EYE)
    torch.testing.assert_close(out[4], last)
    torch.testing.assert_close(out[1][:3, 3], 0.25 * last[:3, 3])
    torch.testing.assert_close(out[1][:3, :3], R_cam_key.mT)
    # A frame that never waited has no rotation of its own; beyond the last that is known the camera stands.
    torch.testing.assert_close(out[3], lie.se3(last[:3, :3], 0.75 * last[:3, 3]))
    torch.testing.assert_close(out[6][:3, 3], last[:3, 3])


@pytest.mark.parametrize("unit", [1.0, 0.25])
def test_a_map_after_a_loss_has_the_unit_and_the_place_it_is_given(walk, unit):
    T_world_ref = lie.se3_exp(torch.tensor([3.0, -1.0, 2.0, 0.2, 1.0, 0.1], dtype=torch.float64))
    starter = walk.starter()
    starter.restart(T_world_ref, unit)
    assert starter.reason == "first_frame"
    begun = begin(starter, walk.frames)
    first = begun.mapper.reference(0)
    torch.testing.assert_close(first.T_world_key, T_world_ref, rtol=0, atol=1e-6)
    assert float(first.points.rho.median()) == pytest.approx(unit, rel=0.3)
    moved = lie.se3_inverse(T_world_ref) @ begun.newest.T_world_key
    assert direction_deg(moved[:3, 3], walk.T_key_cam(begun.newest.index)[:3, 3]) < 1.5


def test_while_it_waits_a_frame_is_where_the_last_was_and_turned():
    turning = Walk(motion="rotation", frames=12, seed=3)
    starter = turning.starter()
    T_world_ref = lie.se3_exp(torch.tensor([1.0, 0.0, 0.0, 0.0, 0.5, 0.0], dtype=torch.float64))
    starter.restart(T_world_ref, 1.0)
    for frame in turning.frames:
        assert starter.add(frame) is None
        T = starter.pose(frame)
        torch.testing.assert_close(T[:3, 3], T_world_ref[:3, 3])
        true = T_world_ref[:3, :3] @ turning.T_key_cam(frame.index)[:3, :3]
        assert float(lie.so3_angle(T[:3, :3].mT @ true).rad2deg()) < 0.7


def test_when_the_corners_run_out_the_rotation_reached_so_far_goes_on():
    """Noise in the middle: the reference changes, and the poses go on from the turn before it."""
    turning = Walk(motion="rotation", frames=16, seed=3)
    noise = np.random.default_rng(0).integers(0, 255, (128, 256, 3), np.uint8)
    starter = turning.starter()
    for index in range(8):
        assert starter.add(turning.frames[index]) is None
    reached = starter.pose(turning.frames[7])
    assert float(lie.so3_angle(reached[:3, :3] @ turning.T_key_cam(7)[:3, :3].mT).rad2deg()) < 0.7
    spoiled = turning.frame(8, noise)
    assert starter.add(spoiled) is None
    assert starter.reason == "few_tracks"
    torch.testing.assert_close(starter.pose(spoiled), reached, rtol=0, atol=1e-9)


def test_a_right_start_is_confirmed_and_then_left_alone(walk):
    starter = walk.starter()
    begun = begin(starter, walk.frames)
    unit = float(begun.newest.T_world_key[:3, 3].norm() / walk.T_key_cam(begun.newest.index)[:3, 3].norm())
    for index in range(begun.newest.index + 1, 24):
        T = walk.T_key_cam(index)
        T[:3, 3] *= unit
        assert starter.watch(walk.frames[index], T) is None
    assert starter._corners.pending == [], "no frame waits any longer"
    wrong = lie.se3_inverse(walk.T_key_cam(23))
    assert starter.watch(walk.frames[23], wrong) is None


def test_a_start_that_the_corners_contradict_is_replaced_once_and_that_one_is_not_asked_again(walk):
    starter = walk.starter()
    begun = begin(starter, walk.frames)
    answers = []
    for index in range(begun.newest.index + 1, 24):
        sideways = EYE.clone()
        sideways[1, 3] = 0.1 * index
        sideways[:3, :3] = walk.T_key_cam(index)[:3, :3]
        answers.append(starter.watch(walk.frames[index], sideways))
    replaced = [answer for answer in answers if answer is not None]
    assert [answer.reason for answer in replaced] == ["start_corrected"]
    newest = replaced[0].newest.index
    moved = replaced[0].newest.T_world_key[:3, 3]
    assert direction_deg(moved, walk.T_key_cam(newest)[:3, 3]) < 1.5
    assert sorted(replaced[0].T_key_cam) == list(range(newest))


def test_a_network_begins_at_once_and_the_corners_settle_it_in_its_metre(walk):
    starter = walk.starter(Ranges(walk, 0))
    begun = starter.add(walk.frames[0])
    assert begun is not None
    assert begun.reason == LEARNED
    assert begun.T_key_cam == {}
    assert starter.settling
    settled = None
    for index in range(1, 24):
        settled = starter.watch(walk.frames[index], walk.T_key_cam(index))
        if settled is not None:
            break
    assert settled is not None
    assert settled.reason == "start_settled"
    assert not starter.settling
    moved = settled.newest.T_world_key[:3, 3]
    true = walk.T_key_cam(settled.newest.index)[:3, 3]
    assert direction_deg(moved, true) < 1.5
    assert float(moved.norm() / true.norm()) == pytest.approx(1.0, abs=0.03)


def test_a_network_that_is_sure_of_nothing_waits_for_the_corners(walk):
    starter, without = walk.starter(Ranges(walk, 0, claims=0.5)), walk.starter()
    begun, plain = begin(starter, walk.frames), begin(without, walk.frames)
    assert begun.reason == "ok"
    assert torch.equal(begun.newest.T_world_key, plain.newest.T_world_key)
    assert not starter.settling


def test_equal_seeds_begin_alike(walk):
    first, second = (begin(walk.starter(seed=5), walk.frames) for _ in range(2))
    assert torch.equal(first.newest.T_world_key, second.newest.T_world_key)
    assert torch.equal(first.newest.points.rho, second.newest.points.rho)
