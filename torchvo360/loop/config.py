"""Settings of loop verification."""

from dataclasses import dataclass, field

from torchvo360.alignment import AlignConfig
from torchvo360.checks import InputError, check_finite_number
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import LMConfig


@dataclass(kw_only=True)
class VerifyConfig:
    """Settings of loop verification."""

    points_by_level: list[int] = field(default_factory=lambda: [1500, 1500, 800])
    """Most points at each level, the finest first; the last entry serves all coarser ones."""
    range_points: int = 600
    """Points whose ranges are compared, in either direction; a quarter of them on the coarsest level."""
    max_steps: int = 12
    """Most steps on each level."""
    rotations: int = 2
    """Distinct rotations of the global search that are followed."""
    noise: float = 4 / 255
    """Standard deviation of an intensity."""
    huber: float = 7.4 / 255
    """Residual at which the cost turns linear."""
    cutoff: float = 34 / 255
    """Residuals beyond this weigh nothing, but on the coarsest level all count."""
    solver: LMConfig = field(default_factory=lambda: LMConfig(cost_tolerance=1e-3, step_tolerance=0.05))
    min_points: int = 200
    """Frames with fewer points are not compared."""
    min_agreement: float = 0.3
    """Least share of the gradient that agrees beyond chance, in the worse direction."""
    min_range_agreement: float = 0.57
    """Least share of the points that have a neighbour in the other frame whose range agrees, in the worse direction.
    True pairs reach 0.57 to 0.9. In a corridor of equal bays a camera one bay further sees the same images (agreement
    0.8) and at most 0.55 of the same ranges (measured on a real walk): what tells bays apart is the odometry alone."""
    max_baseline: float = 1.0
    """Largest distance between the cameras, in median ranges of the points."""
    max_turn_deg: float = 0.3
    """Most that one direction by itself may turn from the joint solution."""
    max_shift: float = 0.02
    """Most that it may move from it, in median ranges of the points."""

    def __post_init__(self) -> None:
        if not self.points_by_level or min(self.points_by_level) < 1:
            raise InputError(f"points_by_level: expected positive numbers, got {self.points_by_level}.")
        for name, least in (("range_points", 16), ("max_steps", 1), ("rotations", 1), ("min_points", 16)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: expected at least {least}, got {getattr(self, name)}.")
        for name in ("noise", "huber", "cutoff", "max_baseline", "max_turn_deg", "max_shift"):
            check_finite_number(name, getattr(self, name), above=0)
        for name in ("min_agreement", "min_range_agreement"):
            check_finite_number(name, getattr(self, name), above=-1e-9, at_most=1)

    def most_points(self, level: int) -> int:
        """Return the most points of a level, 0 being the finest."""
        return self.points_by_level[min(level, len(self.points_by_level) - 1)]

    def align_config(self, *, coarsest: bool) -> AlignConfig:
        """Return the settings of one level's photometric residuals."""
        loss = LossConfig(scale=self.huber, cutoff=None if coarsest else self.cutoff)
        return AlignConfig(loss=loss, noise=self.noise, solver=self.solver, min_pixels=self.min_points // 4)
