"""Recovery: from any turn since the last frame, and in earlier keyframes from any orientation."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Equirectangular
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.depth import InverseRange
from torchvo360.vo import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe, make_keyframe
from torchvo360.vo.recover import TRIED_PER_FRAME, Recovery

CAMERA = Equirectangular(256, 128)
CONFIG = OdometryConfig()
NO_CHANGE = torch.zeros(2, dtype=torch.float64)


class Place:
    """Frames of one world, turned at will, and keyframes with true inverse ranges."""

    def __init__(self, world: str = "room", seed: int = 3, *, mask: Tensor | None = None) -> None:
        self.sequence = SyntheticSequence(SyntheticConfig(world=world, width=256, height=128, frames=60, seed=seed))
        self.builder = FrameBuilder(CAMERA, 3, CONFIG.blur_px, mask, CONFIG.saturation)

    def pose(self, index: int, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor:
        R = lie.so3_exp(torch.tensor(turn, dtype=torch.float64))
        return self.sequence.pose(index) @ lie.se3(R, torch.zeros(3, dtype=torch.float64))

    def frame(self, index: int, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PyramidFrame:
        image, _ = self.sequence.world.render(CAMERA, self.pose(index, turn))
        colour = np.ascontiguousarray(image.clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).numpy())
        return self.builder.build(colour, index, index)

    def key(self, index: int) -> Keyframe:
        key = make_keyframe(self.frame(index), self.pose(index), self.builder, CONFIG.map)
        rho = 1 / self.sequence.range(index).flatten()[key.pixel]
        key.points = InverseRange(rho, (0.02 * rho) ** 2, torch.ones_like(rho))
        return key

    def recovery(self) -> Recovery:
        return Recovery(self.builder, CONFIG.track, CONFIG.map.max_relative_variance)


@pytest.fixture(scope="module")
def place() -> Place:
    return Place()


def check_pose(T_cam_key: Tensor, expected: Tensor) -> None:
    E = T_cam_key @ lie.se3_inverse(expected)
    assert float(lie.so3_angle(E[:3, :3]).rad2deg()) < 0.2
    assert float(E[:3, 3].norm()) < 0.01


TURNS = [(0.0, 0.4, 0.0), (0.0, math.pi, 0.0), (1.2, 0.3, -0.5), (-2.0, 1.0, 1.0)]


@pytest.mark.parametrize("turn", TURNS)
def test_a_turn_of_any_size_since_the_last_frame_is_found(place, turn):
    key, last, frame = place.key(0), place.frame(3), place.frame(4, turn)
    T_last_key = lie.se3_inverse(place.pose(3)) @ place.pose(0)
    found = place.recovery().search(key, frame, last, T_last_key, NO_CHANGE, None)
    assert found is not None
    assert found.inliers > CONFIG.weak_inliers
    check_pose(found.T_cam_key, lie.se3_inverse(place.pose(4, turn)) @ place.pose(0))


def test_without_a_last_frame_or_a_better_track_the_old_one_stays(place):
    key, frame = place.key(0), place.frame(2)
    recovery = place.recovery()
    eye = torch.eye(4, dtype=torch.float64)
    found = recovery.search(key, frame, place.frame(1), eye, NO_CHANGE, None)
    assert found is not None
    perfect = found._replace(inliers=1.0)
    assert recovery.search(key, frame, None, eye, NO_CHANGE, perfect) is perfect
    assert recovery.search(key, frame, place.frame(1), eye, NO_CHANGE, perfect) is perfect


@pytest.mark.parametrize("turn", TURNS)
def test_a_frame_is_found_in_an_earlier_keyframe_from_any_orientation(place, turn):
    recovery = place.recovery()
    for index in (0, 25, 50):
        recovery.remember(place.key(index))
    answer = None
    for _ in range(2):
        answer = answer or recovery.relocalise(place.frame(2, turn), CONFIG.weak_inliers)
    assert answer is not None
    key, found = answer
    torch.testing.assert_close(key.T_world_key, place.pose(0))
    check_pose(found.T_cam_key, lie.se3_inverse(place.pose(2, turn)) @ place.pose(0))


def test_another_world_is_not_found(place):
    recovery = place.recovery()
    for index in (0, 30):
        recovery.remember(place.key(index))
    other = Place("courtyard", 8)
    for index in (0, 20, 40):
        assert recovery.relocalise(other.frame(index), CONFIG.weak_inliers) is None


def counting(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Count the global searches."""
    from torchvo360.vo import recover

    calls: list[None] = []
    original = recover.search_rotation

    def counted(*args, **kwargs):
        calls.append(None)
        return original(*args, **kwargs)

    monkeypatch.setattr(recover, "search_rotation", counted)
    return lambda: len(calls)


def test_the_most_like_keyframe_is_tried_first_however_long_ago_it_was(place, monkeypatch):
    count = counting(monkeypatch)
    recovery = place.recovery()
    target, elsewhere = place.key(0), Place("courtyard", 8).key(0)
    recovery.remember(target)
    for _ in range(2 * TRIED_PER_FRAME):
        recovery.remember(elsewhere)
    answer = recovery.relocalise(place.frame(1, TURNS[0]), CONFIG.weak_inliers)
    assert answer is not None
    assert answer[0].T_world_key is target.T_world_key
    assert count() == 1


def test_a_lost_frame_costs_a_few_searches_and_the_next_goes_on_where_it_ended(place, monkeypatch):
    """Keyframes that look like the frame but whose points do not fit come first; the right one last."""
    count = counting(monkeypatch)
    recovery = place.recovery()
    frame, target = place.frame(1, TURNS[0]), place.key(0)
    recovery.remember(target)
    mistaken = replace(Place("courtyard", 8).key(0), frame=frame)
    for _ in range(2 * TRIED_PER_FRAME):
        recovery.remember(mistaken)
    assert len(recovery) == 2 * TRIED_PER_FRAME + 1
    assert recovery.relocalise(frame, CONFIG.weak_inliers) is None
    assert count() == TRIED_PER_FRAME
    assert recovery.relocalise(frame, CONFIG.weak_inliers) is None
    answer = recovery.relocalise(frame, CONFIG.weak_inliers)
    assert answer is not None
    assert answer[0].T_world_key is target.T_world_key
    assert count() == 2 * TRIED_PER_FRAME + 1
    assert recovery.relocalise(frame, CONFIG.weak_inliers) is None, "it begins again after an answer"
    assert recovery.relocalise(frame, CONFIG.weak_inliers, afresh=True) is None
    assert recovery.relocalise(frame, CONFIG.weak_inliers) is None
    assert recovery.relocalise(frame, CONFIG.weak_inliers) is not None


def test_nothing_remembered_is_nothing_found_and_forgetting_keeps_the_first(place):
    recovery = place.recovery()
    frame = place.frame(0)
    assert recovery.relocalise(frame, CONFIG.weak_inliers) is None
    for index in (0, 30, 59):
        recovery.remember(place.key(index))
    recovery.forget(1)
    assert len(recovery) == 1
    answer = recovery.relocalise(frame, CONFIG.weak_inliers)
    assert answer is not None
    torch.testing.assert_close(answer[0].T_world_key, place.pose(0))
    recovery.forget(0)
    assert recovery.relocalise(frame, CONFIG.weak_inliers) is None


def test_what_is_remembered_holds_no_frame(place):
    recovery = place.recovery()
    key = place.key(0)
    recovery.remember(key)
    kept = recovery._remembered[0]
    assert not hasattr(kept.key, "frame")
    size = sum(part.numel() * part.element_size() for part in (*kept.key.points, *kept.key.values, kept.key.ray))
    assert size + kept.small.padded.numel() * 4 < 0.5e6


def test_masked_pixels_do_not_mislead_the_search():
    """An operator who turns with the camera: the same pixels in every frame."""
    mask = torch.ones(128, 256, dtype=torch.bool)
    mask[80:] = False
    place = Place(mask=mask)
    operator = np.random.default_rng(0).integers(0, 255, (48, 256, 3), np.uint8)

    def seen(index: int, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PyramidFrame:
        colour = place.frame(index, turn).colour.copy()
        colour[80:] = operator
        return place.builder.build(colour, index, index)

    turn = (0.0, 1.5, 0.0)
    key = make_keyframe(seen(0), place.pose(0), place.builder, CONFIG.map)
    rho = 1 / place.sequence.range(0).flatten()[key.pixel]
    key.points = InverseRange(rho, (0.02 * rho) ** 2, torch.ones_like(rho))
    recovery = place.recovery()
    recovery.remember(replace(key))
    answer = recovery.relocalise(seen(2, turn), CONFIG.weak_inliers)
    assert answer is not None
    check_pose(answer[1].T_cam_key, lie.se3_inverse(place.pose(2, turn)) @ place.pose(0))
