"""Settings of a plan."""

import math
from dataclasses import dataclass

from torchvo360.checks import InputError, check_choice, check_finite_number

BACKENDS = ("auto", "numba", "python")


@dataclass(kw_only=True)
class PlanConfig:
    """How a robot finds its way, in the map's unit."""

    robot_radius: float = 0.25
    """The robot as a disc: no obstacle comes nearer to its middle than this."""
    margin: float = 0.5
    """Beyond its radius the robot keeps this far from obstacles where that costs little."""
    clearance_weight: float = 3.0
    """How many times its length a way beside an obstacle costs more, falling to 0 over the margin; 0 for the shortest
    way."""
    unknown: str = "free"
    """Whether cells that were not seen are free or blocked."""
    unknown_weight: float = 1.0
    """How many times its length a way over such cells costs more."""
    smooth: bool = True
    """Straighten the way where that is no dearer and keeps clear."""
    backend: str = "auto"
    """numba, python, or auto: numba for large maps where it is installed. Both find the same way."""

    def __post_init__(self) -> None:
        for name in ("robot_radius", "margin", "clearance_weight", "unknown_weight"):
            value = getattr(self, name)
            check_finite_number(name, value, at_most=1e6)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"{name}: expected a finite number of at least 0, got {value!r}.")
        check_choice("unknown", self.unknown, ("free", "blocked"))
        check_choice("backend", self.backend, BACKENDS)
