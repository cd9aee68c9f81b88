"""Loops: a place seen again is found from any heading and in any unit, and closes the trajectory."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.depth import InverseRange
from torchvo360.evaluation import evaluate
from torchvo360.vo import OdometryConfig, State, VisualOdometry
from torchvo360.vo.frame import FrameBuilder
from torchvo360.vo.keyframes.keyframe import Keyframe, MapConfig, make_keyframe
from torchvo360.vo.loops import LoopCloser, LoopConfig

CAMERA = Equirectangular(256, 128)
CONFIG = OdometryConfig(blur_px=0.5)


class Place:
    """Keyframes anywhere in one world, in maps of any unit."""

    def __init__(self, world: str, seed: int) -> None:
        self.sequence = SyntheticSequence(SyntheticConfig(world=world, width=256, height=128, frames=90, seed=seed))
        self.builder = FrameBuilder(CAMERA, 3, CONFIG.blur_px, None, CONFIG.saturation)

    def pose(self, at: int, *, yaw: float = 0.0, aside_m: float = 0.0) -> Tensor:
        turn = lie.so3_exp(torch.tensor([0.0, yaw, 0.0], dtype=torch.float64))
        return self.sequence.pose(at) @ lie.se3(turn, torch.tensor([aside_m, 0.0, 0.0], dtype=torch.float64))

    def key(self, index: int, T_world_cam: Tensor, *, unit_m: float = 1.0) -> Keyframe:
        image, reach = self.sequence.world.render(CAMERA, T_world_cam)
        colour = np.ascontiguousarray(image.clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).numpy())
        key = make_keyframe(self.builder.build(colour, index, index), T_world_cam, self.builder, CONFIG.map)
        noise = torch.randn(len(key.pixel), generator=torch.Generator().manual_seed(index))
        rho = unit_m / reach.flatten()[key.pixel] * (1 + 0.03 * noise)
        key.points = InverseRange(rho, (0.03 * rho).square(), torch.ones_like(rho))
        return key

    def closer(self, **settings) -> LoopCloser:
        return LoopCloser(self.builder, LoopConfig(**settings))


@pytest.fixture(scope="module")
def room() -> Place:
    return Place("room", 1)


@pytest.fixture(scope="module")
def first(room) -> Keyframe:
    return room.key(0, room.pose(0))


@pytest.mark.parametrize(("yaw", "unit_m"), [(0.0, 1.0), (2.6, 1.0), (math.pi, 2.5), (-1.0, 0.3)])
def test_a_place_seen_again_gives_the_similarity_between_the_two_maps(room, first, yaw, unit_m):
    closer = room.closer(min_gap=1)
    T_again = room.pose(0, yaw=yaw, aside_m=0.08)
    assert closer.add(first) == []
    assert closer.add(room.key(1, room.pose(45))) == []
    edges = closer.add(room.key(7, T_again, unit_m=unit_m))
    assert [(edge.i, edge.j) for edge in edges] == [(0, 7)]
    assert closer.edges == edges
    T_j_i = lie.se3_inverse(T_again) @ room.pose(0)
    S = edges[0].S_j_i
    scale = float(torch.linalg.det(S[:3, :3]).pow(1 / 3))
    assert scale * unit_m == pytest.approx(1.0, abs=0.01), "X_j = S_j_i X_i, each in its own unit"
    assert float(lie.so3_angle(S[:3, :3] / scale @ T_j_i[:3, :3].mT).rad2deg()) < 0.2
    assert float((S[:3, 3] * unit_m - T_j_i[:3, 3]).norm()) < 0.01
    assert bool((torch.linalg.eigvalsh(edges[0].information) > 0).all())


def test_a_place_is_known_again_after_the_intrinsics_have_been_estimated_anew(first):
    """Keyframes of before were built with other cameras; their points keep their pixels."""
    place = Place("room", 1)
    closer = place.closer(min_gap=1)
    closer.add(first)
    closer.add(place.key(1, place.pose(45)))
    fx, fy, cx, cy = CAMERA.intrinsics
    place.builder.recalibrate(torch.tensor([fx, 1.005 * fy, cx, cy + 0.2], dtype=torch.float64))
    edges = closer.add(place.key(7, place.pose(0, yaw=1.0)))
    assert [(edge.i, edge.j) for edge in edges] == [(0, 7)]
    S = edges[0].S_j_i
    assert float(torch.linalg.det(S[:3, :3]).pow(1 / 3)) == pytest.approx(1.0, abs=0.02)


def test_the_last_few_before_a_keyframe_are_not_compared_with_it(room):
    closer = room.closer(min_gap=3)
    for index in range(5):
        edges = closer.add(room.key(index, room.pose(0, aside_m=0.02 * index)))
        assert [edge.i for edge in edges] == ([0] if index == 4 else [])


@pytest.mark.parametrize(("world", "seed"), [("courtyard", 8), ("room", 6), ("pillars", 1)])
def test_another_world_closes_no_loop(room, first, world, seed):
    closer, other = room.closer(min_gap=1, tried=5), Place(world, seed)
    for key in (first, room.key(1, room.pose(30)), room.key(2, room.pose(60)), room.key(3, room.pose(80))):
        closer.add(key)
    known = len(closer.edges)
    for at in (0, 25, 50, 75):
        assert closer.search([other.key(10 + at, other.pose(at))]) == []
    assert len(closer.edges) == known


def test_a_search_remembers_nothing_and_knows_how_many_keyframes_lie_between(room, first):
    closer = room.closer(min_gap=2)
    closer.add(first)
    again = [room.key(index, room.pose(0, aside_m=0.03 * index)) for index in (1, 2, 3)]
    edges = closer.search(again)
    assert {edge.j for edge in edges} == {3}, "the first two follow the remembered one too closely"
    assert [edge[:2] for edge in edges] == [edge[:2] for edge in closer.search(again)]
    assert closer.edges == []
    assert closer.search([first]) == [], "a keyframe that is remembered is not looked for again"


def test_what_is_forgotten_closes_no_loop_and_its_loops_are_gone(room, first):
    closer = room.closer(min_gap=1)
    closer.add(first)
    closer.add(room.key(1, room.pose(45)))
    assert len(closer.add(room.key(2, room.pose(0, yaw=1.0)))) == 1
    closer.forget({2})
    assert closer.edges == []
    assert len(closer.add(room.key(2, room.pose(0, yaw=1.0)))) == 1, "a new map may use the number again"
    closer.forget({0, 2, 99})
    assert closer.add(room.key(3, room.pose(0, yaw=2.0))) == []


def test_a_keyframe_is_added_once_and_none_where_loops_are_off(room, first):
    closer = room.closer(min_gap=1)
    closer.add(first)
    closer.add(room.key(1, room.pose(45)))
    again = room.key(2, room.pose(0, yaw=1.0))
    assert len(closer.add(again)) == 1
    assert closer.add(again) == []
    off = room.closer(min_gap=1, enabled=False)
    assert off.add(first) == off.add(room.key(1, room.pose(45))) == off.add(again) == off.search([again]) == []


@pytest.mark.parametrize("name", ["min_gap", "tried"])
def test_unusable_settings_are_refused_by_name(name):
    with pytest.raises(InputError, match=name):
        LoopConfig(**{name: 0})


@pytest.mark.slow
def test_a_walk_around_the_room_is_closed_though_it_ends_looking_elsewhere():
    """8 m in 90 frames; the last frames look 150 deg further left than the first."""
    settings = SyntheticConfig(width=256, height=128, frames=90, seed=1, motion="turned_loop")
    sequence = SyntheticSequence(settings)
    odometry = VisualOdometry(sequence.camera, replace(CONFIG, map=MapConfig(points=400)))
    for frame in sequence:
        odometry.step(frame)
    result = odometry.finish()
    assert result.loops
    assert all(edge.i < 15 and edge.j > 65 for edge in result.loops)
    assert State.LOST not in {estimate.state for estimate in result.frames}
    before, after = (evaluate(t, sequence.truth).ate_percent for t in (result.before_loops, result.trajectory))
    assert after < 0.03
    assert after < 0.8 * before
    T_first_last = result.trajectory.T_world_cam[-1]
    true = lie.se3_inverse(sequence.pose(0)) @ sequence.pose(89)
    scale = evaluate(result.trajectory, sequence.truth).scale
    assert float((T_first_last[:3, 3] * scale - true[:3, 3]).norm()) < 0.002 * 8
    for edge in result.loops:
        T_j_i = lie.se3_inverse(sequence.pose(edge.j)) @ sequence.pose(edge.i)
        S = edge.S_j_i
        size = torch.linalg.det(S[:3, :3]).pow(1 / 3)
        assert float(lie.so3_angle(S[:3, :3] / size @ T_j_i[:3, :3].mT).rad2deg()) < 0.3


def test_loops_may_be_switched_off():
    sequence = SyntheticSequence(SyntheticConfig(width=256, height=128, frames=30, seed=1))
    config = OdometryConfig(loop=LoopConfig(enabled=False))
    odometry = VisualOdometry(sequence.camera, config)
    for frame in sequence:
        odometry.step(frame)
    result = odometry.finish()
    assert result.loops == []
    assert torch.equal(result.before_loops.T_world_cam, result.trajectory.T_world_cam)
