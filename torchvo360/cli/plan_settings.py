"""The settings of `torchvo360-plan`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchvo360.checks import InputError, check_choice, check_finite_number
from torchvo360.cli import overrides as ours
from torchvo360.mapping import MapConfig
from torchvo360.outputs import can_plot
from torchvo360.planning import PlanConfig

OF_RUNS = ("up", "floor", "camera_height", "metric", "robot_height", "step", "resolution", "max_range", "carried")
OF_RUNS += ("depth", "stride")
"""Settings of how a map is made."""


@dataclass(kw_only=True)
class PlanSettings:
    """Settings of one plan; lengths that are null have defaults in metres, see conf/plan/help.txt."""

    run: str | None = None
    """Folder of a run."""
    map: str | None = None
    """A map's yaml file, in place of a run."""
    start: str | None = None
    """x,y; null for the first camera's place."""
    goal: str | None = None
    """x,y; null for the last camera's place."""
    robot_radius: float | None = None
    """Of the robot as a disc."""
    margin: float | None = None
    """Distance to obstacles that it would rather keep beyond its radius."""
    clearance_weight: float = PlanConfig.clearance_weight
    """How many times dearer a way beside an obstacle is."""
    unknown: str = PlanConfig.unknown
    """Whether cells that were not seen are free or blocked."""
    unknown_weight: float = PlanConfig.unknown_weight
    """How many times dearer they are."""
    smooth: bool = True
    """Straighten the way."""
    backend: str = PlanConfig.backend
    """auto, numba or python."""
    up: str | None = None
    """x,y,z: upwards in the run's axes."""
    floor: float | None = None
    """The cameras' height above the floor, in the run's unit."""
    camera_height: float | None = None
    """The same in metres."""
    metric: bool | None = None
    """Whether the run's unit is the metre."""
    robot_height: float | None = None
    """What is higher is no obstacle."""
    step: float | None = None
    """What is lower is no obstacle."""
    resolution: float | None = None
    """Size of a cell."""
    max_range: float | None = None
    """How far points are believed."""
    carried: bool = True
    """Whoever carried the camera walked on free floor."""
    depth: str = "points"
    """points, sensor or learned."""
    stride: int | None = None
    """Use every n-th row and column of dense ranges; null leaves about a hundred rows."""
    out: str | None = None
    """Folder of the results."""
    plot: str = "auto"
    """Draw plan.png."""

    def __post_init__(self) -> None:
        if (self.run is None) == (self.map is None):
            raise InputError("run: expected the folder of a run, or map=FILE, got neither or both.")
        check_choice("depth", self.depth, ("points", "sensor", "learned"))
        check_choice("plot", self.plot, ("auto", "true", "false"))
        if self.plot == "true" and not can_plot():
            raise InputError("plot: expected matplotlib, which pip install 'torchvo360[viz]' brings, or plot=false.")
        for name in ("floor", "camera_height"):
            if (value := getattr(self, name)) is not None:
                check_finite_number(name, value, above=0.0)
        if self.stride is not None and self.stride < 1:
            raise InputError(f"stride: expected at least 1, got {self.stride}.")
        for name, count in (("start", 2), ("goal", 2), ("up", 3)):
            _ = self.numbers(name, count)
        if self.map is not None:
            usual = {field.name: field.default for field in fields(PlanSettings)}
            for name in OF_RUNS:
                if getattr(self, name) != usual[name]:
                    raise InputError(f"{name}: expected no value for a map that is there, got {getattr(self, name)}.")
            for name in ("start", "goal"):
                if getattr(self, name) is None:
                    raise InputError(f"{name}: expected {name}=x,y on a map that is there, got none.")

    def numbers(self, name: str, count: int) -> tuple[float, ...] | None:
        """Return a setting such as 1.5,2 as numbers.

        Raises:
            InputError: It is none, or has another count.
        """
        text = getattr(self, name)
        if text is None:
            return None
        try:
            numbers = tuple(float(word) for word in text.strip("[]() ").split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != count or not all(map(math.isfinite, numbers)):
            raise InputError(f"{name}: expected {count} numbers such as {','.join('120'[:count])}, got {text}.")
        return numbers

    def plan_config(self, metre: float) -> PlanConfig:
        """Return the robot's settings, with defaults for a metre of this many units."""
        given = {name: getattr(self, name) for name in ("robot_radius", "margin")}
        lengths = {name: getattr(PlanConfig, name) * metre if value is None else value for name, value in given.items()}
        return PlanConfig(
            clearance_weight=self.clearance_weight,
            unknown=self.unknown,
            unknown_weight=self.unknown_weight,
            smooth=self.smooth,
            backend=self.backend,
            **lengths,
        )

    def map_config(self, metre: float, camera_height: float) -> MapConfig:
        """Return the map's settings, with defaults for a metre of this many units."""
        names = ("resolution", "step", "max_range")
        given = {name: getattr(self, name) for name in names}
        lengths = {name: getattr(MapConfig, name) * metre if value is None else value for name, value in given.items()}
        return MapConfig(
            robot_height=camera_height if self.robot_height is None else self.robot_height,
            layer=MapConfig.layer * metre,
            carrier_radius=MapConfig.carrier_radius * metre * self.carried,
            **lengths,
        )


def settings_of(words: Sequence[str]) -> PlanSettings:
    """Return the settings that words `key=value` make.

    Raises:
        InputError: One is not key=value, its key is unknown, or its value does not fit.
    """
    config = OmegaConf.structured(PlanSettings)
    for word in words:
        key, equal, value = word.partition("=")
        if key not in config or not equal:
            ours.check_keys([word], PlanSettings, [], example="run=runs/walk", printed_by="torchvo360-plan --help")
        try:
            config[key] = None if value == "null" else value
        except OmegaConfBaseException as error:
            expected = next((told for part, told in ours.TYPE_ERRORS if part in str(error)), "another value")
            raise InputError(f"{key}: expected {expected}, got {value}.") from None
    return ours.resolved(config)
