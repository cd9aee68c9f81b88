"""The normal equations that a linearisation hands to a solver."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor


class NormalEquations(NamedTuple):
    """A weighted least-squares problem at one point: `H delta = -g`."""

    H: Float[Tensor, "B 8 8"]
    """J^T W J without damping, float64."""
    g: Float[Tensor, "B 8"]
    """J^T W r, float64."""
    cost: Float[Tensor, "B"]
    """Sum of the robust costs, each times its sample's weight, float64."""
    weight: Float[Tensor, "B"]
    """Sum of the samples' weights before the robust loss, float64: cost / weight compares between steps."""
    square: Float[Tensor, "B"]
    """r^T W r, float64."""
