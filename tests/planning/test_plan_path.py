"""Ways on a map: clear of obstacles, straight where they may be, and reasons where there is none."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvo360.checks import InputError
from torchvo360.mapping import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from torchvo360.planning import PlanConfig, Reason, clearance_of, plan_path
from torchvo360.planning.smooth import straightened

BARE = PlanConfig(robot_radius=0.0, margin=0.0, backend="python")


def hall(rows=40, columns=60, resolution=0.1, state=FREE):
    return torch.full((rows, columns), state, dtype=torch.int8), resolution


def mapped(states, resolution=0.1, origin=(0.0, 0.0)):
    return OccupancyMap(states, resolution, origin)


def with_wall():
    """A wall across a hall with a gap of 1.2 m at its upper end."""
    states, resolution = hall()
    states[:28, 30] = OCCUPIED
    return mapped(states, resolution)


def samples(xy, spacing=0.005):
    parts = [
        torch.lerp(a, b, torch.linspace(0, 1, 2 + int(float((b - a).norm()) / spacing), dtype=torch.float64)[:, None])
        for a, b in itertools.pairwise(xy)
    ]
    return torch.cat(parts)


def distance_to_obstacles(map, xy):
    """To the edges of all occupied cells, one by one."""
    row, column = (map.states == OCCUPIED).nonzero(as_tuple=True)
    apart = (xy[:, None] - map.centres(row, column)).abs() - map.resolution / 2
    return torch.linalg.vector_norm(apart.clamp_min(0), dim=-1).amin(-1)


def test_an_empty_hall_is_crossed_in_a_straight_line():
    plan = plan_path(mapped(hall()[0]), (0.33, 0.41), (5.2, 3.1), BARE)
    assert plan.reason == Reason.FOUND
    assert plan.found
    assert plan.xy.tolist() == [[0.33, 0.41], [5.2, 3.1]]
    assert plan.length == pytest.approx(math.hypot(4.87, 2.69))


def test_a_robot_larger_than_a_map_without_obstacles_may_stand_anywhere_on_it():
    cell = mapped(hall(1, 1)[0])
    plan = plan_path(cell, (0.03, 0.03), (0.07, 0.03), PlanConfig(robot_radius=5.0))
    assert plan.found
    assert plan.clearance == math.inf
    blocked = PlanConfig(robot_radius=5.0, unknown="blocked")  # what lies outside is not known
    assert plan_path(cell, (0.03, 0.03), (0.07, 0.03), blocked).reason == Reason.TIGHT


@pytest.mark.parametrize("margin", [1e-320, 1e-40, 1e6])
def test_a_margin_of_any_size_leaves_weights_that_are_numbers(margin):
    weight = clearance_of(with_wall(), PlanConfig(robot_radius=0.25, margin=margin)).weight
    assert (weight >= 1).all()


@pytest.mark.parametrize("smooth", [True, False])
def test_a_robot_keeps_its_radius_from_every_obstacle(smooth):
    map = with_wall()
    plan = plan_path(map, (1.0, 1.0), (5.0, 1.0), PlanConfig(robot_radius=0.35, margin=0.3, smooth=smooth))
    assert plan.found
    least = float(distance_to_obstacles(map, samples(plan.xy)).min())
    assert least >= 0.35 - map.resolution / 2  # the robot's middle may be anywhere in a cell whose middle is clear
    assert plan.clearance == pytest.approx(least, abs=map.resolution)
    assert plan.clearance >= 0.35


def test_clearance_leads_through_the_middle_of_a_corridor():
    states, resolution = hall(21, 80)
    states[0] = states[-1] = OCCUPIED
    states[:8, 30:50] = OCCUPIED  # a narrow part of it
    map = mapped(states, resolution)
    near = plan_path(map, (0.5, 1.05), (7.5, 1.05), PlanConfig(robot_radius=0.2, margin=0.0))
    far = plan_path(map, (0.5, 1.05), (7.5, 1.05), PlanConfig(robot_radius=0.2, margin=0.6, clearance_weight=5.0))
    assert far.clearance > near.clearance + 0.1
    assert far.length >= near.length - 1e-9
    way = samples(far.xy)
    beside = way[(way[:, 0] > 3.5) & (way[:, 0] < 4.5), 1]
    assert float(beside.min()) > 1.2  # the narrow part is 0.8 to 2.0 wide, its middle 1.4


@given(st.integers(0, 2**32 - 1), st.floats(0, 0.45), st.sampled_from([0.0, 4.0]))
@settings(max_examples=60, deadline=None)
def test_smoothing_crosses_no_inflated_obstacle_and_is_no_dearer(seed, radius, weight):
    generator = np.random.default_rng(seed)
    states = torch.from_numpy(np.where(generator.random((30, 30)) < 0.12, OCCUPIED, FREE).astype(np.int8))
    states[:6, :6] = states[-6:, -6:] = FREE
    map = mapped(states)
    config = PlanConfig(robot_radius=radius, clearance_weight=weight, backend="python")
    rough = plan_path(map, (0.05, 0.05), (2.95, 2.95), PlanConfig(**{**vars(config), "smooth": False}))
    smooth = plan_path(map, (0.05, 0.05), (2.95, 2.95), config)
    assert smooth.found == rough.found
    if not smooth.found:
        return
    clearance = clearance_of(map, config)
    column, row = map.to_cells(samples(smooth.xy)).floor().long().clamp(0, 29).unbind(-1)
    assert np.isfinite(clearance.weight[row, column]).all()
    assert len(smooth.xy) <= len(rough.xy)
    if weight == 0:
        assert smooth.length <= rough.length + 1e-6
    torch.testing.assert_close(smooth.xy[[0, -1]], rough.xy[[0, -1]])


def test_a_line_through_the_corner_of_two_obstacles_is_not_clear():
    weight = torch.ones(4, 4)
    weight[1, 2] = weight[2, 1] = torch.inf
    way = torch.tensor([[0.5, 0.5], [0.5, 3.5], [3.5, 3.5]], dtype=torch.float64)
    assert straightened(way, weight).tolist() == way.tolist()


def test_the_cost_is_the_same_in_a_map_that_is_moved_and_scaled():
    map = with_wall()
    config = PlanConfig(robot_radius=0.3, margin=0.4)
    plan = plan_path(map, (1.0, 1.0), (5.0, 1.0), config)
    twice = OccupancyMap(map.states, 0.2, (10.0, -4.0))
    other = plan_path(twice, (12.0, -2.0), (20.0, -2.0), PlanConfig(robot_radius=0.6, margin=0.8))
    assert other.cost == pytest.approx(2 * plan.cost)
    torch.testing.assert_close(other.xy, 2 * plan.xy + torch.tensor([10.0, -4.0], dtype=torch.float64))


def test_start_and_goal_may_be_one_place_or_one_cell():
    map = mapped(hall()[0])
    assert plan_path(map, (1.0, 1.0), (1.0, 1.0), BARE).length == 0
    assert plan_path(map, (1.02, 1.0), (1.07, 1.0), BARE).length == pytest.approx(0.05)


def test_unknown_cells_are_free_but_dear_or_blocked():
    states, resolution = hall()
    states[:, 25:35] = UNKNOWN
    states[30:, 25:35] = FREE
    map = mapped(states, resolution)
    config = {"robot_radius": 0.1, "margin": 0.0, "backend": "python"}
    through = plan_path(map, (1.0, 1.0), (5.0, 1.0), PlanConfig(**config, unknown_weight=0.0))
    assert through.length == pytest.approx(4.0)
    around = plan_path(map, (1.0, 1.0), (5.0, 1.0), PlanConfig(**config, unknown_weight=20.0))
    assert around.length > 5
    never = plan_path(map, (1.0, 1.0), (5.0, 1.0), PlanConfig(**config, unknown="blocked"))
    assert float(never.xy[:, 1].max()) > 3.1
    states[30:, 25:35] = UNKNOWN
    assert plan_path(mapped(states), (1.0, 1.0), (5.0, 1.0), PlanConfig(**config, unknown="blocked")).reason == (
        Reason.UNREACHABLE
    )


@pytest.mark.parametrize(
    ("start", "goal", "unknown", "reason", "told"),
    [
        ((-1.0, 1.0), (5.0, 1.0), "free", Reason.OUTSIDE, "the start (-1, 1) lies outside the map (x 0 to 6"),
        ((1.0, 1.0), (5.0, 9.0), "free", Reason.OUTSIDE, "the goal (5, 9) lies outside"),
        ((3.05, 1.0), (5.0, 1.0), "free", Reason.OBSTACLE, "the start (3.05, 1) lies in an obstacle"),
        ((1.0, 1.0), (2.85, 1.0), "free", Reason.TIGHT, "which is less than the robot's radius of 0.3"),
        ((1.0, 1.0), (5.95, 3.95), "blocked", Reason.UNSEEN, "lies where nothing was seen"),
        ((1.0, 1.0), (0.05, 1.0), "blocked", Reason.TIGHT, "from an obstacle"),
    ],
)
def test_no_way_is_an_answer_with_its_reason(start, goal, unknown, reason, told):
    map = with_wall()
    map.states[-3:, -3:] = UNKNOWN
    plan = plan_path(map, start, goal, PlanConfig(robot_radius=0.3, unknown=unknown, backend="python"))
    assert plan.reason == reason
    assert not plan.found
    assert plan.message.startswith("no way: ")
    assert told in plan.message
    assert len(plan.xy) == 0
    assert math.isinf(plan.length)


def test_an_unreachable_goal_says_how_far_the_search_got():
    states, resolution = hall()
    states[:, 30] = OCCUPIED
    plan = plan_path(mapped(states, resolution), (1.0, 1.0), (5.0, 1.0), BARE)
    assert plan.reason == Reason.UNREACHABLE
    assert plan.searched == 40 * 30
    assert plan.nearest == pytest.approx((2.95, 1.05))
    assert "the nearest one is at (2.95, 1.05), 2.05 from it" in plan.message


def test_distances_are_to_the_obstacles_edges():
    states, resolution = hall()
    states[10, 20] = OCCUPIED
    clearance = clearance_of(mapped(states, resolution), PlanConfig(robot_radius=0.3, margin=0.5))
    assert clearance.distance[10, 25] == pytest.approx(0.45)
    assert clearance.distance[10, 20] == 0
    assert np.isinf(clearance.weight[10, 22])
    assert clearance.weight[10, 30] == 1
    ordered = clearance.weight[10, 24:32]
    assert (np.diff(ordered) <= 0).all()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_place_that_is_no_number_is_refused(value):
    with pytest.raises(InputError, match=r"^goal: expected"):
        plan_path(mapped(hall()[0]), (0.0, 0.0), (value, 0.0))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("robot_radius", -1.0),
        ("margin", math.nan),
        ("clearance_weight", math.inf),
        ("unknown", "maybe"),
        ("backend", "x"),
    ],
)
def test_settings_of_no_robot_are_refused(name, value):
    with pytest.raises(InputError, match=f"^{name}: expected"):
        PlanConfig(**{name: value})
