"""Settings of the alignment layer."""

import math
from dataclasses import dataclass, field

from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_choice, check_finite_number
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import LMConfig

BACKWARD = ("implicit", "unroll", "truncated", "none")
HESSIANS = ("gauss_newton", "exact")


@dataclass(kw_only=True)
class AlignConfig:
    """Settings of `align`."""

    levels: int = 0
    """Pyramid levels; 0 takes as many as `coarsest_width` asks for."""
    coarsest_width: int = 64
    """Least width of a panorama's coarsest level: rotation-only alignment at 64 x 32 pixels converges from 40 deg, at
    128 x 64 from 15 (measured). Other cameras go on to pixels of the same angle, while the level is 16 pixels wide."""
    finest: int = 0
    """Level at which to stop: 0 is the image's own resolution; stopping at half of it is three times less accurate."""
    blur_px: float = 0.5
    """Smoothing of both images before all else; with the exact derivative it gains about a quarter in accuracy."""
    affine: bool = True
    """Whether brightness gain and offset are estimated."""
    saturation: float | None = 252 / 255
    """Single-channel values at or above this are clipped and not used; None for features, which have no white."""
    min_agreement: float = 0.5
    """A solve that converged with less agreement than this ended in a false minimum: DIVERGED."""
    min_pixels: int = 64
    """Fewer usable pixels at a level are too few."""
    noise: float = 4 / 255
    """Standard deviation of an intensity, against which the variance of inverse ranges is weighed."""
    loss: LossConfig = field(default_factory=LossConfig)
    solver: LMConfig = field(default_factory=LMConfig)
    steps_by_level: list[int] = field(default_factory=lambda: [15, 20, 30, 50, 50])
    """Most steps at each level, the finest first; the last entry serves all coarser ones."""
    backward: str = "implicit"
    """Gradients of the solution. implicit: by the implicit function theorem, at a cost and memory that do not depend on
    the steps; what did not converge has none. unroll: through all steps of all levels, to the start too; what did not
    converge has them as well. truncated: through the last `backward_steps` on the finest level. none: constants."""
    backward_steps: int = 3
    """Accepted steps that `truncated` goes through."""
    hessian: str = "gauss_newton"
    """Of the implicit gradient. gauss_newton: J^T W J, exact where residuals vanish; exact: the cost's Hessian, at the
    price of eight more backward passes."""

    def __post_init__(self) -> None:
        if self.levels < 0 or self.finest < 0 or (self.levels and self.finest >= self.levels):
            raise InputError(f"levels, finest: expected 0 <= finest < levels, got {self.levels} and {self.finest}.")
        if not self.steps_by_level or min(self.steps_by_level) < 1:
            raise InputError(f"steps_by_level: expected positive numbers of steps, got {self.steps_by_level}.")
        check_finite_number("blur_px", self.blur_px, above=-1e-9)
        check_finite_number("noise", self.noise, above=0)
        check_finite_number("min_agreement", self.min_agreement, above=-1e-9, at_most=1)
        if self.saturation is not None:
            check_finite_number("saturation", self.saturation)
        if self.coarsest_width < 1 or self.min_pixels < 1:
            sizes = f"{self.coarsest_width} and {self.min_pixels}"
            raise InputError(f"coarsest_width, min_pixels: expected at least 1, got {sizes}.")
        check_choice("backward", self.backward, BACKWARD)
        check_choice("hessian", self.hessian, HESSIANS)
        if self.backward_steps < 1:
            raise InputError(f"backward_steps: expected at least 1, got {self.backward_steps}.")

    def level_count(self, camera: Camera) -> int:
        """Return the number of pyramid levels for a camera.

        Raises:
            InputError: The finest level is not one of them.
        """
        around = min(math.tau / camera.pixel_angle / self.coarsest_width, camera.width / 16)
        count = self.levels or 1 + math.floor(math.log2(max(1.0, around * (1 + 1e-9))))
        if self.finest >= count:
            raise InputError(f"finest: expected a level below {count}, the number of levels, got {self.finest}.")
        return count

    def most_steps(self, level: int) -> int:
        """Return the most steps of a level, 0 being the finest."""
        return self.steps_by_level[min(level, len(self.steps_by_level) - 1)]
