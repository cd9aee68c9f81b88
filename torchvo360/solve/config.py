"""Settings of the solver."""

from dataclasses import dataclass

from torchvo360.checks import InputError, check_choice, check_finite_number


@dataclass(kw_only=True)
class LMConfig:
    """Settings of one Levenberg-Marquardt solve."""

    max_steps: int = 30
    damping: str = "gain_ratio"
    """gain_ratio: Nielsen's rule, by how well the model predicted the cost; lsd: LSD-SLAM's (mathematics.md, 7)."""
    initial_damping: float = 1e-3
    """Lambda at the start, relative to the diagonal of H; the lsd schedule starts from 0."""
    max_damping: float = 1e5
    """A step refused at this damping ends the solve: no step in any direction lowers the cost."""
    step_tolerance: float = 0.01
    """A shorter step is taken and ends the solve; in the unit of `step_scale`, for alignment in pixels."""
    cost_tolerance: float = 1e-5
    """A step that lowers the cost by a smaller share has converged, as has a refused one that promised less."""
    fixed_steps: bool = False
    """Always work through `max_steps` steps for all elements, with masks in place of branches: the same answers, for
    `torch.compile` and `torch.func.vmap`, which know no branches."""

    def __post_init__(self) -> None:
        if self.max_steps < 1:
            raise InputError(f"max_steps: expected at least 1, got {self.max_steps}.")
        check_choice("damping", self.damping, ("gain_ratio", "lsd"))
        check_finite_number("initial_damping", self.initial_damping, above=0)
        check_finite_number("max_damping", self.max_damping, above=0)
        check_finite_number("step_tolerance", self.step_tolerance, above=0)
        check_finite_number("cost_tolerance", self.cost_tolerance, above=0)
