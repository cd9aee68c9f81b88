"""What `torchvo360-plan` does: the map, the way, and the files."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import InputError
from torchvo360.cli.plan_settings import PlanSettings, settings_of
from torchvo360.cli.surroundings import Surroundings, read_surroundings
from torchvo360.files import atomic_path, write_atomically
from torchvo360.mapping import OccupancyMap, build_map, find_floor, read_map, unit_of_map, upright_axes, write_map
from torchvo360.mapping.level import map_frame
from torchvo360.outputs import can_plot, new_folder
from torchvo360.planning import Plan, PlanConfig, clearance_of, plan_path
from torchvo360.planning.picture import draw_plan

NO_WAY = 3
"""Exit code where there is no way."""

CARRIED_AT = 1.5
"""Height of a camera, metres, by which lengths in metres become those of a run in another unit."""


@dataclass(frozen=True, eq=False)
class Ground:
    """A map to plan on."""

    occupancy: OccupancyMap
    unit: str
    metre: float
    """Of how many units a metre is believed to consist."""
    path: Float64[Tensor, "P 2"] | None = None
    """Where the camera went."""
    S_map_world: Float64[Tensor, "4 4"] | None = None
    lines: list[str] = field(default_factory=list)
    """What to say of it."""


def run(words: Sequence[str]) -> int:
    """Do what the words behind the command's name ask for, and return the exit code.

    Raises:
        InputError: The caller's mistake; then nothing is written.
    """
    settings = settings_of(words)
    ground = _ground_of_map(settings) if settings.run is None else _ground_of_run(settings)
    config = settings.plan_config(ground.metre)
    ends = []
    for name, row in (("start", 0), ("goal", -1)):
        given = settings.numbers(name, 2)
        if given is None:
            assert ground.path is not None
            given = ground.path[row].tolist()
        ends.append((given[0], given[1]))
    plan = plan_path(ground.occupancy, ends[0], ends[1], config)
    home = Path(settings.run or Path(settings.map or "").parent).expanduser()
    with new_folder(settings.out or str(home / "plan"), home) as folder:
        try:
            _write(folder, settings, config, ground, plan, ends)
        except OSError as error:
            raise InputError(f"out: expected a folder to write to, got {folder}: {error.strerror or error}.") from None
    print("\n".join([*ground.lines, *_described(ground, plan, ends), f"results: {folder}"]))
    return 0 if plan.found else NO_WAY


def _ground_of_map(settings: PlanSettings) -> Ground:
    try:
        occupancy, unit = read_map(settings.map or ""), unit_of_map(settings.map or "")
    except InputError as error:
        raise InputError(f"map: {error}") from None
    for name in ("robot_radius", "margin"):
        if unit != "m" and getattr(settings, name) is None:
            raise InputError(f"{name}: expected a length in the map's unit, which is not the metre, got none.")
    return Ground(occupancy, unit, 1.0)


def _ground_of_run(settings: PlanSettings) -> Ground:
    seen = read_surroundings(settings.run or "", settings.depth, settings.stride, settings.metric)
    up, height, notes = _floor(settings, seen)
    level = float((seen.T_world_cam[:, :3, 3] @ up).median())
    scale = 1.0
    if not seen.metric and settings.camera_height is not None:
        scale = settings.camera_height / height
    metric = seen.metric or settings.camera_height is not None
    S_map_world = map_frame(seen.T_world_cam, up, level - height, scale)
    height *= scale
    path = seen.T_world_cam[:, :3, 3] @ S_map_world[:3, :3].mT + S_map_world[:3, 3]
    metre = 1.0 if metric else height / CARRIED_AT
    built = build_map(seen.rays.moved(S_map_world), path, settings.map_config(metre, height))
    unit = "m" if metric else "units"
    notes.insert(0, f"floor: {height:.3g} {unit} below the camera")
    if not metric:
        notes.append("note: lengths are in units of the run; camera_height=METRES makes them metres.")
    return Ground(built.occupancy, unit, metre, path[:, :2], S_map_world, notes)


def _floor(settings: PlanSettings, seen: Surroundings) -> tuple[Float64[Tensor, "3"], float, list[str]]:
    """Return upwards, the cameras' height above the floor in the run's unit, and what to say of them."""
    given = settings.numbers("up", 3)
    up = seen.up if given is None else torch.tensor(given, dtype=torch.float64)
    tilt = up is None
    up = upright_axes(seen.T_world_cam, up)[2]
    height = settings.floor
    if seen.metric and settings.camera_height is not None:
        if height is not None:
            raise InputError("floor: expected no value beside camera_height for a run in metres, got both.")
        height = settings.camera_height
    floor = find_floor(seen.rays, seen.T_world_cam[:, :3, 3], up, tilt=tilt)
    if floor is not None and floor.clear:
        up = floor.up
    if height is not None:
        return up, height, []
    if floor is None:
        raise InputError("floor: expected points below the camera to find it by, or floor=HEIGHT, got neither.")
    told = "note: the floor hardly stands out below the camera, and may be elsewhere; floor=HEIGHT sets it."
    return up, floor.camera_height, [] if floor.clear else [told]


def _write(
    folder: Path,
    settings: PlanSettings,
    config: PlanConfig,
    ground: Ground,
    plan: Plan,
    ends: Sequence[tuple[float, float]],
) -> None:
    if settings.run is not None:
        write_map(folder, ground.occupancy, unit=ground.unit)
    if plan.found:
        lines = ["x,y", *(f"{round(x, 6):.9g},{round(y, 6):.9g}" for x, y in plan.xy.tolist())]
        write_atomically(folder / "path.csv", "\n".join(lines) + "\n")
    told = {"reason": str(plan.reason), "message": plan.message, "unit": ground.unit, "start": ends[0], "goal": ends[1]}
    if plan.found:
        told |= {"length": plan.length, "cost": plan.cost}
        told["clearance"] = plan.clearance if math.isfinite(plan.clearance) else None  # JSON has no infinity
    told |= {"searched": plan.searched, "seconds": plan.seconds, "nearest": plan.nearest}
    if ground.S_map_world is not None:
        told["S_map_world"] = ground.S_map_world.tolist()
    write_atomically(folder / "plan.json", json.dumps(told, indent=2, allow_nan=False) + "\n")
    if not plan.found:
        (folder / "path.csv").unlink(missing_ok=True)  # an earlier plan's
    if settings.plot == "false" or not can_plot():
        (folder / "plan.png").unlink(missing_ok=True)  # an earlier plan's
    else:
        with atomic_path(folder / "plan.png") as temporary:
            draw_plan(
                temporary,
                ground.occupancy,
                clearance_of(ground.occupancy, config),
                plan,
                ends=(ends[0], ends[1]),
                camera_path=ground.path,
                unit=ground.unit,
            )


def _described(ground: Ground, plan: Plan, ends: Sequence[tuple[float, float]]) -> list[str]:
    """Return what the user reads of the map and the way."""
    rows, columns = ground.occupancy.shape
    x0, x1, y0, y1 = ground.occupancy.extent
    unit = ground.unit
    lines = [
        f"map: {columns} x {rows} cells of {ground.occupancy.resolution:.3g} {unit}; "
        f"x (right) {x0:.4g} to {x1:.4g}, y (forward) {y0:.4g} to {y1:.4g}"
    ]
    if not plan.found:
        return [*lines, plan.message]
    near = math.isfinite(plan.clearance)
    x, y, u, v = (round(value, 6) + 0.0 for end in ends for value in end)  # neither 1e-28 nor -0
    return [
        *lines,
        f"way: {plan.length:.3g} {unit} from ({x:.4g}, {y:.4g}) to ({u:.4g}, {v:.4g}), {len(plan.xy)} corners, "
        + (f"at least {plan.clearance:.3g} {unit} from obstacles" if near else "without any obstacle on the map"),
        f"search: {plan.searched} cells in {1e3 * plan.seconds:.0f} ms",
    ]
