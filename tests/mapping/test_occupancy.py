"""Maps of rays: against a loop, against worlds whose plan is known, and by what a robot may count on."""

import math

import numpy as np
import pytest
import torch

from torchvo360.checks import InputError, ShapeError
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.mapping import FREE, OCCUPIED, UNKNOWN, MapConfig, Rays, build_map, rays_of_depth
from torchvo360.mapping.occupancy import HIT, LEAST, MISS, MOST
from torchvo360.mapping.rays import join_rays
from torchvo360.planning import PlanConfig, clearance_of

PATH = torch.tensor([[0.0, 0.0, 1.5]], dtype=torch.float64)


def one_map(points, *, origin=(0.0, 0.0, 1.5), scan=None, path=PATH, **settings):
    points = torch.tensor(points, dtype=torch.float64)
    origins = torch.tensor(origin, dtype=torch.float64).expand_as(points)
    config = MapConfig(**{"carrier_radius": 0.0, "resolution": 0.1, **settings})
    return build_map(Rays.of(origins, points, scan), path, config)


def state_at(built, x, y):
    cell = built.occupancy.cell_of((x, y))
    return UNKNOWN if cell is None else int(built.occupancy.states[cell])


def by_loop(rays, config, built):
    """The same evidence, ray by ray in small steps and cell by cell."""
    rows, columns = built.occupancy.shape
    layers = math.ceil((config.robot_height + config.step) / config.layer)
    thickness = (config.robot_height + config.step) / layers
    evidence = np.zeros((layers, rows, columns))
    x0, y0 = built.occupancy.origin
    for scan in sorted(set(rays.scan.tolist())):
        hits, passed = set(), set()
        for origin, point, number in zip(rays.origins.tolist(), rays.points.tolist(), rays.scan.tolist(), strict=True):
            if number != scan or math.dist(origin, point) > config.max_range:
                continue
            for share in np.linspace(0, 1, 20001):
                x, y, z = (o + share * (p - o) for o, p in zip(origin, point, strict=True))
                if -config.step <= z <= config.robot_height:
                    layer = min(int((z + config.step) / thickness), layers - 1)
                    cell = layer, math.floor((y - y0) / config.resolution), math.floor((x - x0) / config.resolution)
                    passed.add(cell)
                    if share == 1 and z > config.step:
                        hits.add(cell)
        for cell in passed | hits:
            change = HIT if cell in hits else MISS
            evidence[cell] = min(max(evidence[cell] + change, LEAST), MOST)
    highest = evidence.max(0)
    return np.where(highest > 0, highest, evidence.min(0))


def test_evidence_is_that_of_a_loop_over_rays_and_cells():
    generator = torch.Generator().manual_seed(3)
    count = 40
    centres = torch.tensor([[0.03, 0.02, 1.21], [0.74, -0.33, 1.33], [1.1, 0.5, 1.6]], dtype=torch.float64)
    scan = torch.randint(3, (count,), generator=generator)
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([4.0, 4.0, 2.2]) - 0.2
    points[:, :2] -= 1.8
    rays = Rays.of(centres[scan], points, scan)
    config = MapConfig(resolution=0.25, robot_height=1.5, step=0.1, layer=0.4, max_range=2.6, carrier_radius=0.0)
    built = build_map(rays, centres, config)
    np.testing.assert_allclose(built.log_odds.numpy(), by_loop(rays, config, built), atol=1e-5)
    assert (built.log_odds > 0).sum() > 5
    assert (built.log_odds < 0).sum() > 20


def test_a_ray_frees_what_it_passes_and_fills_where_it_ends():
    built = one_map([[2.05, 0.05, 0.8]], origin=(0.05, 0.05, 0.8))
    assert all(state_at(built, x + 0.05, 0.05) == FREE for x in np.arange(0, 1.99, 0.1))
    assert state_at(built, 2.05, 0.05) == OCCUPIED
    assert state_at(built, 1.05, 0.15) == UNKNOWN


def test_floor_frees_and_neither_low_nor_high_points_are_obstacles():
    built = one_map([[2.05, 0.05, 0.05], [0.05, 2.05, 1.9], [-2.05, 0.05, -0.02]], robot_height=1.6)
    assert state_at(built, 2.05, 0.05) == FREE  # on the floor, up to a step
    assert state_at(built, -2.05, 0.05) == FREE
    assert state_at(built, 0.05, 2.05) == UNKNOWN  # a lamp above, seen over the robot's head
    assert not bool((built.occupancy.states == OCCUPIED).any())


def test_a_low_robot_is_told_nothing_by_rays_above_it():
    built = one_map([[3.05, 0.05, 1.2]], robot_height=0.5)
    assert not bool((built.occupancy.states != UNKNOWN).any())
    low = one_map([[3.05, 0.05, 0.3]], robot_height=0.5)
    assert state_at(low, 1.05, 0.05) == UNKNOWN
    assert state_at(low, 2.85, 0.05) == FREE
    assert state_at(low, 3.05, 0.05) == OCCUPIED


def test_a_railing_stays_although_the_wall_behind_is_seen_over_it():
    wall = [[4.05, 0.05, 1.4]] * 30
    scan = torch.arange(31)
    built = one_map([[2.05, 0.05, 0.4], *wall], scan=scan)
    assert state_at(built, 2.05, 0.05) == OCCUPIED
    assert state_at(built, 4.05, 0.05) == OCCUPIED


def test_a_cell_counts_once_a_scan_and_a_hit_is_not_freed_by_its_own_scan():
    crowd = [[2.05, 0.05, 0.8]] * 50 + [[3.05, 0.05, 0.8]] * 50
    once = one_map(crowd, origin=(0.05, 0.05, 0.8))
    assert float(once.log_odds.max()) == pytest.approx(HIT)
    assert float(once.log_odds.min()) == pytest.approx(MISS)
    assert state_at(once, 2.05, 0.05) == OCCUPIED


def test_evidence_can_change_its_mind_and_is_bounded():
    passes, hits = [[3.05, 0.05, 0.8]] * 40, [[2.05, 0.05, 0.8]] * 2
    gone = one_map(hits + passes, origin=(0.05, 0.05, 0.8), scan=torch.arange(42))
    assert state_at(gone, 2.05, 0.05) == FREE
    assert float(gone.log_odds.min()) >= LEAST - 1e-6
    back = one_map(passes + [[2.05, 0.05, 0.8]] * 5, origin=(0.05, 0.05, 0.8), scan=torch.arange(45))
    assert state_at(back, 2.05, 0.05) == OCCUPIED
    assert float(back.log_odds.max()) <= MOST + 1e-6


def test_where_the_carrier_walked_is_free():
    path = torch.tensor([[0.0, 0.0, 1.5], [3.0, 0.0, 1.5]], dtype=torch.float64)
    stray = [[1.5, 0.0, 0.7]]
    assert state_at(one_map(stray, path=path), 1.5, 0.0) == OCCUPIED
    walked = one_map(stray, path=path, carrier_radius=0.2)
    assert state_at(walked, 1.5, 0.0) == FREE
    assert state_at(walked, 2.9, 0.15) == FREE
    assert state_at(walked, 2.9, 0.35) == UNKNOWN


def test_a_quarter_turn_of_everything_turns_the_map():
    generator = torch.Generator().manual_seed(5)
    points = torch.rand(200, 3, generator=generator, dtype=torch.float64) * torch.tensor([6.0, 4.0, 1.4])
    points[:, :2] -= torch.tensor([3.0, 2.0])
    R = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    config = MapConfig(resolution=0.2, carrier_radius=0.0)
    origin = torch.tensor([[0.013, 0.021, 1.5]], dtype=torch.float64)
    first = build_map(Rays.of(origin.expand_as(points), points), origin, config)
    turned = build_map(Rays.of((origin @ R.T).expand_as(points), points @ R.T), origin @ R.T, config)
    torch.testing.assert_close(turned.occupancy.states, torch.rot90(first.occupancy.states, 1, (1, 0)))


def test_height_is_that_of_the_highest_point_in_reach():
    built = one_map([[2.05, 0.05, 0.4], [2.06, 0.05, 0.9], [2.06, 0.05, 2.9]])
    assert float(built.height[built.occupancy.cell_of((2.05, 0.05))]) == pytest.approx(0.9)


@pytest.mark.parametrize("world", ["pillars", "room"])
def test_a_map_of_exact_ranges_is_the_floor_plan(world):
    """Every obstacle cell lies at a surface, every pillar that is seen stands, and nobody walks through anything."""
    sequence = SyntheticSequence(SyntheticConfig(world=world, width=192, height=96, frames=200))
    looks = range(0, 200, 20)
    parts = [rays_of_depth(sequence.camera, sequence.range(k), sequence.pose(k)) for k in looks]
    path = sequence.truth.positions
    config = MapConfig(resolution=0.1, robot_height=1.5)
    built = build_map(join_rays(parts), path, config)
    map = built.occupancy
    row, column = (map.states == OCCUPIED).nonzero(as_tuple=True)
    assert len(row) > 150
    heights = torch.linspace(0.12, 1.48, 18, dtype=torch.float64)
    assert float(_plan_clearance(sequence.world, map.centres(row, column), heights).max()) < 0.1  # half a diagonal
    row, column = (map.states == FREE).nonzero(as_tuple=True)
    inside = _plan_clearance(sequence.world, map.centres(row, column), heights) < -0.1
    assert float(inside.double().mean()) < 0.03  # between the few rays that met the top of a low box,
    fits = torch.from_numpy(clearance_of(map, PlanConfig(robot_radius=0.25)).weight).isfinite()[row, column]
    assert float((inside & fits).double().mean()) < 0.001  # where a robot does not fit
    cells = [map.cell_of((x, y)) for x, y, _ in path.tolist()]
    assert all(cell is not None and map.states[cell] == FREE for cell in cells)
    solids = sequence.world.solids
    tall = [k for k in range(1, len(solids.centre)) if solids.half[k, 2] > 0.75 and solids.half[k, :2].min() > 0.12]
    sides = torch.tensor([map.states[_box(map, solids.centre[k], solids.half[k])].max() for k in tall])
    assert len(tall) >= 4
    assert float((sides == OCCUPIED).double().mean()) > 0.9


def _plan_clearance(world, xy, heights):
    """Distance to the nearest solid seen from above: the least over a robot's heights."""
    points = torch.cat([torch.cat([xy, torch.full_like(xy[:, :1], float(z))], -1) for z in heights])
    return world.clearance(points).view(len(heights), -1).amin(0)


def _box(map, centre, half):
    low = map.to_cells((centre[:2] - half[:2].max() - 0.1).double()).floor().long().clamp_min(0)
    high = map.to_cells((centre[:2] + half[:2].max() + 0.1).double()).ceil().long().clamp_min(1)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def test_rays_of_a_depth_image_lead_to_its_points():
    sequence = SyntheticSequence(SyntheticConfig(world="courtyard", width=64, height=32, frames=2))
    reach, T = sequence.range(1), sequence.pose(1)
    rays = rays_of_depth(sequence.camera, reach, T, stride=2)
    assert 0 < len(rays) < 512  # the sky has none
    torch.testing.assert_close(rays.origins[0], T[:3, 3])
    assert float(sequence.world.clearance(rays.points, 1 / 30).abs().max()) < 1e-3
    mask = torch.zeros(32, 64, dtype=torch.bool)
    assert len(rays_of_depth(sequence.camera, reach, T, mask=mask)) == 0


def test_rays_that_are_not_finite_are_left_out():
    points = torch.tensor([[1.0, 0, 1], [math.nan, 0, 1], [math.inf, 0, 1]])
    assert len(Rays.of(torch.zeros(3, 3), points)) == 1


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"resolution": 0.0}, "resolution"),
        ({"resolution": math.nan}, "resolution"),
        ({"step": -0.1}, "step"),
        ({"step": 2.0}, "step"),
        ({"carrier_radius": math.inf}, "carrier_radius"),
        ({"layer": 0.0}, "layer"),
        ({"resolution": 3.0, "max_range": 2.0}, "max_range"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, told):
    with pytest.raises(InputError, match=f"^{told}: expected"):
        MapConfig(**settings)


def test_a_map_without_a_path_or_with_too_many_cells_is_refused():
    rays = Rays.of(torch.zeros(2, 3), torch.tensor([[1.0, 0, 0.5], [5.0, 0, 0.5]]))
    with pytest.raises(InputError, match=r"^path: expected"):
        build_map(rays, PATH[:0])
    with pytest.raises(ShapeError, match="path"):
        build_map(rays, PATH[0])
    with pytest.raises(InputError, match=r"^resolution: expected at least"):
        build_map(rays, PATH, MapConfig(resolution=1e-5))
    with pytest.raises(InputError, match=r"^robot_height: expected at most .* layers of 1e-05 on "):
        build_map(rays, PATH, MapConfig(resolution=0.01, layer=1e-5))


def test_depth_of_another_size_or_stride_is_refused():
    sequence = SyntheticSequence(SyntheticConfig(width=32, height=16, frames=1))
    with pytest.raises(ShapeError, match="depth"):
        rays_of_depth(sequence.camera, torch.ones(8, 8), torch.eye(4))
    with pytest.raises(InputError, match=r"^stride: expected"):
        rays_of_depth(sequence.camera, torch.ones(16, 32), torch.eye(4), stride=0)
    with pytest.raises(InputError, match="source"):
        join_rays([])
