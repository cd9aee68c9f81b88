"""What many errors come to in a few numbers."""

from dataclasses import dataclass

from jaxtyping import Float64
from torch import Tensor


@dataclass(frozen=True)
class Statistics:
    """Figures of a set of errors, in the unit of the errors."""

    rmse: float
    mean: float
    median: float
    """Of an even number, the mean of the two in the middle."""
    max: float
    count: int

    @classmethod
    def of(cls, error: Float64[Tensor, "N"]) -> "Statistics | None":
        """Return the figures of errors, which are not negative; None where there are none."""
        if not len(error):
            return None
        return cls(
            rmse=float(error.square().mean().sqrt()),
            mean=float(error.mean()),
            median=float(error.quantile(0.5)),
            max=float(error.max()),
            count=len(error),
        )
