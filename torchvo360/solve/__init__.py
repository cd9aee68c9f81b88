"""Least squares: it knows no image and no camera."""

from torchvo360.solve.config import LMConfig
from torchvo360.solve.implicit import Stationarity, attach_implicit, attach_newton_step
from torchvo360.solve.linear import PIVOT_TOLERANCE, inverse_ldl, solve_ldl
from torchvo360.solve.lm import Solution, minimize
from torchvo360.solve.status import Status
from torchvo360.solve.step import COST_ROUNDING, GOING_ON, Problem, State, choose
from torchvo360.solve.trace import Trace, last_moves, replay

__all__ = [
    "COST_ROUNDING",
    "GOING_ON",
    "PIVOT_TOLERANCE",
    "LMConfig",
    "Problem",
    "Solution",
    "State",
    "Stationarity",
    "Status",
    "Trace",
    "attach_implicit",
    "attach_newton_step",
    "choose",
    "inverse_ldl",
    "last_moves",
    "minimize",
    "replay",
    "solve_ldl",
]
