"""From a map, a start and a goal to a way, or to the reason why there is none."""

import time
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import check_finite_number
from torchvo360.mapping import OCCUPIED, UNKNOWN, OccupancyMap
from torchvo360.mapping.traverse import cells_crossed
from torchvo360.planning.config import PlanConfig
from torchvo360.planning.costs import Clearance, clearance_of
from torchvo360.planning.search import find_path
from torchvo360.planning.smooth import straightened


class Reason(StrEnum):
    """How a plan ended."""

    FOUND = "found"
    OUTSIDE = "outside"
    """Start or goal lies outside the map."""
    OBSTACLE = "obstacle"
    """Start or goal lies in an obstacle."""
    TIGHT = "tight"
    """Start or goal is too near to an obstacle for the robot."""
    UNSEEN = "unseen"
    """Start or goal lies where nothing was seen, and that is blocked."""
    UNREACHABLE = "unreachable"
    """Both are free, and no way leads from one to the other."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A way, or why there is none."""

    reason: Reason
    message: str
    """One sentence for the user; empty where there is a way."""
    xy: Float64[Tensor, "N 2"]
    """Corners of the way from the start to the goal, in the map's frame and unit; empty where there is none."""
    length: float
    """Of the way, in the map's unit; inf where there is none, as for the cost."""
    cost: float
    """What A* minimised: length times weight, in the map's unit, along the cells of the grid."""
    clearance: float
    """Least distance from the way to an obstacle's edge, in the map's unit; inf on a map without obstacles, 0 without a
    way."""
    searched: int
    """Cells that the search looked at."""
    seconds: float
    """Time of the search, costs and smoothing included."""
    nearest: tuple[float, float] | None
    """How far an unreachable goal's search got: x and y of the searched cell nearest to it."""

    @property
    def found(self) -> bool:
        """Whether there is a way."""
        return self.reason == Reason.FOUND


def plan_path(
    occupancy: OccupancyMap,
    start: tuple[float, float],
    goal: tuple[float, float],
    config: PlanConfig | None = None,
    *,
    clearance: Clearance | None = None,
) -> Plan:
    """Return the cheapest way of a disc-shaped robot between two places.

    Args:
        occupancy: The map.
        start: x and y in its frame and unit.
        goal: x and y likewise.
        config: The robot, and what it prefers.
        clearance: `clearance_of` the map with these settings, where it is known already.

    Raises:
        InputError: A coordinate is not finite, or a setting is unusable. That there is no way is an answer, not an
            error.
    """
    began = time.perf_counter()
    config = PlanConfig() if config is None else config
    for name, place in (("start", start), ("goal", goal)):
        for value in place:
            check_finite_number(name, value)
    clearance = clearance_of(occupancy, config) if clearance is None else clearance
    for name, place in (("start", start), ("goal", goal)):
        if (problem := _problem(name, place, occupancy, clearance, config)) is not None:
            return _none(*problem, began=began)
    cells = occupancy.cell_of(start), occupancy.cell_of(goal)
    assert cells[0] is not None
    assert cells[1] is not None
    search = find_path(clearance.weight, cells[0], cells[1], backend=config.backend)
    if search.cells is None:
        nearest = _place(occupancy, *search.nearest)
        away = float(np.hypot(nearest[0] - goal[0], nearest[1] - goal[1]))
        message = (
            f"no way: the goal {_at(goal)} cannot be reached; of {search.searched} cells searched the nearest one is "
            f"at {_at(nearest)}, {away:.3g} from it."
        )
        return _none(Reason.UNREACHABLE, message, began=began, searched=search.searched, nearest=nearest)
    ends = occupancy.to_cells(torch.tensor([start, goal], dtype=torch.float64))
    middles = torch.from_numpy(search.cells).flip(-1).double() + 0.5
    way = torch.cat([ends[:1], middles[1:-1], ends[1:]])
    if config.smooth:
        way = straightened(way, torch.from_numpy(clearance.weight))
    crossed = cells_crossed(way[:-1], way[1:], occupancy.shape)[1].numpy()
    length = float(torch.linalg.vector_norm(way.diff(dim=0), dim=-1).sum()) * occupancy.resolution
    return Plan(
        Reason.FOUND,
        "",
        occupancy.to_places(way),
        length,
        search.cost * occupancy.resolution,
        float(clearance.distance.reshape(-1)[crossed].min()),
        search.searched,
        time.perf_counter() - began,
        None,
    )


def _problem(
    name: str, place: tuple[float, float], occupancy: OccupancyMap, clearance: Clearance, config: PlanConfig
) -> tuple[Reason, str] | None:
    """Return why a robot cannot stand at a place."""
    cell = occupancy.cell_of(place)
    if cell is None:
        x0, x1, y0, y1 = occupancy.extent
        extent = f"x {x0:.4g} to {x1:.4g}, y {y0:.4g} to {y1:.4g}"
        return Reason.OUTSIDE, f"no way: the {name} {_at(place)} lies outside the map ({extent})."
    if not np.isinf(clearance.weight[cell]):
        return None
    state, distance = int(occupancy.states[cell]), float(clearance.distance[cell])
    if state == OCCUPIED:
        return Reason.OBSTACLE, f"no way: the {name} {_at(place)} lies in an obstacle."
    if state == UNKNOWN and config.unknown == "blocked":
        return Reason.UNSEEN, f"no way: the {name} {_at(place)} lies where nothing was seen, and unknown=blocked."
    return Reason.TIGHT, (
        f"no way: the {name} {_at(place)} is {distance:.3g} from an obstacle, which is less than the robot's radius "
        f"of {config.robot_radius:.3g}."
    )


def _none(
    reason: Reason, message: str, *, began: float, searched: int = 0, nearest: tuple[float, float] | None = None
) -> Plan:
    seconds, xy = time.perf_counter() - began, torch.zeros(0, 2, dtype=torch.float64)
    return Plan(reason, message, xy, float("inf"), float("inf"), 0.0, searched, seconds, nearest)


def _place(occupancy: OccupancyMap, row: int, column: int) -> tuple[float, float]:
    x, y = occupancy.centres(torch.tensor([row]), torch.tensor([column]))[0].tolist()
    return x, y


def _at(place: tuple[float, float]) -> str:
    x, y = (round(value, 6) + 0.0 for value in place)  # neither 1e-28 nor -0
    return f"({x:.4g}, {y:.4g})"
