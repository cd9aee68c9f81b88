"""Least squares: it knows no image and no camera."""

from torchvo360.solve.linear import inverse_ldl, solve_ldl
from torchvo360.solve.lm import LMConfig, Solution, minimize
from torchvo360.solve.status import Status

__all__ = ["LMConfig", "Solution", "Status", "inverse_ldl", "minimize", "solve_ldl"]
