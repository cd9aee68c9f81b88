"""Settings of the windowed photometric bundle adjustment."""

from dataclasses import dataclass, field

from torchvo360.checks import InputError, check_finite_number
from torchvo360.residuals.weights import LossConfig

MIN_KEYFRAMES = 4
"""While there have never been as many keyframes, intrinsics are held: from two or three views of little motion they run
away by a tenth (measured)."""


@dataclass(kw_only=True)
class WindowConfig:
    """Settings of the window's energy and of its optimisation. Intensities are of [0, 1]."""

    keyframes: int = 7
    """Most keyframes in the window."""
    steps: int = 6
    """Most Gauss-Newton steps after each keyframe, refused ones included."""
    tolerance: float = 1e-4
    """Relative fall of the energy below which the optimisation ends."""
    loss: LossConfig = field(default_factory=lambda: LossConfig(scale=9 / 255))
    gradient_scale: float = 50 / 255
    """Pattern pixels weigh c^2 / (c^2 + |gradient|^2) with this c, intensity per pixel: strong edges alias most."""
    pattern: str = "dso"
    """dso: eight pixels; single: the centre alone."""
    first_estimates: bool = True
    """Jacobians of keyframes that the prior holds stay at their first estimate (FEJ), which keeps what the gauge leaves
    free unobserved. On the sequences measured it makes no difference (docs/accuracy.md)."""
    affine: bool = True
    """Estimate gain and offset of every keyframe."""
    solid_angle: bool = False
    """Weigh points by the solid angle of their pixel as well: equal-area points have it already."""
    outlier_quantile: float = 0.7
    """A keyframe's outlier threshold is `outlier_factor` times this quantile of the mean energies of its edges."""
    outlier_factor: float = 2.0
    min_threshold: float = 60 / 255**2
    """Least outlier threshold."""
    stereo_coupling: float = 1.0
    """Weight lambda of the static stereo residuals (mathematics.md, section 6)."""
    calibrate: bool = False
    """Estimate the intrinsics fx, fy, cx, cy with the poses; of a panorama fy and cy, the others being held. The given
    ones may be off by a few percent. It takes about twice the time, and not a rig."""

    def __post_init__(self) -> None:
        if self.keyframes < 2:
            raise InputError(f"keyframes: expected at least 2, got {self.keyframes}.")
        if self.steps < 1:
            raise InputError(f"steps: expected at least 1, got {self.steps}.")
        if self.pattern not in ("dso", "single"):
            raise InputError(f"pattern: expected dso or single, got {self.pattern}.")
        if self.calibrate and self.keyframes < MIN_KEYFRAMES:
            raise InputError(f"keyframes: expected at least {MIN_KEYFRAMES} with calibrate, got {self.keyframes}.")
        check_finite_number("outlier_quantile", self.outlier_quantile, above=0, at_most=1)
        for name in ("tolerance", "gradient_scale", "outlier_factor", "min_threshold"):
            check_finite_number(name, getattr(self, name), above=0)
        check_finite_number("stereo_coupling", self.stereo_coupling, above=-1e-9)
