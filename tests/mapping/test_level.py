"""Upright axes and the floor: where they are, in every unit and attitude, and when it is not known."""

import math

import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.lie import se3, so3_exp
from torchvo360.mapping import Rays, find_floor, rays_of_depth, upright_axes
from torchvo360.mapping.level import map_frame
from torchvo360.mapping.rays import join_rays

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
LEVEL = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)
"""R_world_cam of a camera that looks along x, in a world whose z is up."""


def seen_world(world="pillars", frames=120, every=15):
    sequence = SyntheticSequence(SyntheticConfig(world=world, width=96, height=48, frames=frames))
    looks = range(0, frames, every)
    parts = [rays_of_depth(sequence.camera, sequence.range(k), sequence.pose(k)) for k in looks]
    return join_rays(parts), sequence.truth.T_world_cam


@pytest.fixture(scope="module")
def room():
    return seen_world("room")


@pytest.mark.parametrize("world", ["pillars", "room", "courtyard"])
def test_the_floor_of_a_world_is_found_within_two_centimetres_and_half_a_degree(world, room):
    rays, T_world_cam = room if world == "room" else seen_world(world)
    path = T_world_cam[:, :3, 3]
    rough = so3_exp(torch.tensor([0.1, -0.07, 0.0], dtype=torch.float64)) @ UP
    floor = find_floor(rays, path, rough)
    assert floor is not None
    assert floor.clear
    assert math.degrees(math.acos(min(1.0, float(floor.up @ UP)))) < 0.5
    assert abs(floor.height) < 0.02
    assert floor.camera_height == pytest.approx(float(path[:, 2].median()), abs=0.02)


def test_the_cameras_hold_themselves_upright_on_average():
    _, T_world_cam = seen_world("room", frames=300, every=299)
    up = upright_axes(T_world_cam)[2]
    assert math.degrees(math.acos(float(up @ UP))) < 4


def test_turned_scaled_and_moved_everything_is_found_as_before(room):
    rays, T_world_cam = room
    R = so3_exp(torch.tensor([0.7, -1.9, 0.4], dtype=torch.float64))
    S = se3(0.31 * R, torch.tensor([4.0, -2.0, 9.0], dtype=torch.float64))
    path = T_world_cam[:, :3, 3]
    before = find_floor(rays, path, UP)
    after = find_floor(rays.moved(S), path @ S[:3, :3].T + S[:3, 3], R @ UP)
    assert before is not None
    assert after is not None
    assert after.clear == before.clear
    assert after.camera_height == pytest.approx(0.31 * before.camera_height, rel=0.01)
    assert float(after.up @ (R @ before.up)) > math.cos(math.radians(0.3))


def test_a_strip_of_floor_does_not_tell_how_it_leans():
    generator = torch.Generator().manual_seed(0)
    path = torch.stack([torch.linspace(0, 8, 50), torch.zeros(50), torch.full((50,), 1.5)], -1).double()
    points = torch.randn(400, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.0, 0.03, 0.03])
    points[:, 0] = 8 * torch.rand(400, generator=generator, dtype=torch.float64)
    floor = find_floor(Rays.of(path[:1].expand_as(points), points), path, UP)
    assert floor is not None
    assert floor.clear
    assert math.degrees(math.acos(min(1.0, float(floor.up @ UP)))) < 0.5
    assert floor.camera_height == pytest.approx(1.5, abs=0.01)


def test_few_points_do_not_tell_the_upward_direction():
    generator = torch.Generator().manual_seed(0)
    path = torch.stack([torch.linspace(0, 8, 50), torch.zeros(50), torch.full((50,), 1.5)], -1).double()
    points = torch.rand(60, 3, generator=generator, dtype=torch.float64) * torch.tensor([8.0, 2.0, 0.2])
    floor = find_floor(Rays.of(path[:1].expand_as(points), points), path, UP)
    assert floor is not None
    assert floor.clear
    torch.testing.assert_close(floor.up, UP)


def test_known_gravity_is_not_tilted(room):
    rays, T_world_cam = room
    rough = so3_exp(torch.tensor([0.02, 0.0, 0.0], dtype=torch.float64)) @ UP
    floor = find_floor(rays, T_world_cam[:, :3, 3], rough, tilt=False)
    assert floor is not None
    torch.testing.assert_close(floor.up, rough / rough.norm())


def test_a_floor_that_does_not_stand_out_is_not_called_clear():
    generator = torch.Generator().manual_seed(0)
    path = torch.stack([torch.linspace(0, 5, 50), torch.zeros(50), torch.ones(50)], -1).double()
    points = torch.rand(400, 3, generator=generator, dtype=torch.float64) * torch.tensor([5.0, 1.0, 0.9])
    floor = find_floor(Rays.of(path[:1].expand_as(points), points), path, UP)
    assert floor is not None
    assert not floor.clear
    torch.testing.assert_close(floor.up, UP)
    assert 0 < floor.camera_height < 1.2


def test_nothing_below_the_path_means_no_floor():
    path = torch.zeros(3, 3, dtype=torch.float64)
    above = torch.rand(100, 3, dtype=torch.float64) + torch.tensor([0.0, 0.0, 0.1])
    assert find_floor(Rays.of(torch.zeros(100, 3), above), path, UP) is None
    assert find_floor(Rays.of(torch.zeros(0, 3), torch.zeros(0, 3)), path, UP) is None


@pytest.mark.parametrize("pitch", [0.0, 0.3, -0.3, math.pi / 2, -math.pi / 2])
def test_the_map_begins_below_the_first_camera_and_looks_where_it_looks(pitch):
    R = LEVEL @ so3_exp(torch.tensor([pitch, 0.0, 0.0], dtype=torch.float64))
    T = se3(R, torch.tensor([3.0, 4.0, 1.6], dtype=torch.float64))[None]
    S = map_frame(T, UP, 0.1, scale=2.0)
    at = (S @ T[0])[:3, 3]
    torch.testing.assert_close(at, torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64))
    assert torch.linalg.det(S[:3, :3]).item() == pytest.approx(8)
    ahead = S[:3, :3] @ torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    if abs(pitch) < 1:  # along x, horizontally
        torch.testing.assert_close(ahead, torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(S[:3, :3] @ UP, 2 * UP)


@pytest.mark.parametrize("up", [[0.0, 0.0, 0.0], [math.nan, 0.0, 1.0], [math.inf, 0.0, 1.0]])
def test_upwards_without_a_direction_is_refused(up):
    with pytest.raises(InputError, match=r"^up: expected a direction"):
        upright_axes(torch.eye(4, dtype=torch.float64)[None], torch.tensor(up, dtype=torch.float64))


def test_no_pose_is_refused():
    with pytest.raises(InputError, match=r"^T_world_cam: expected at least one"):
        upright_axes(torch.zeros(0, 4, 4, dtype=torch.float64))
