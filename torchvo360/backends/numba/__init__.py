"""Hot passes compiled by numba, for float32 on the CPU without gradients; they need the extra `fast`."""

from torchvo360.backends.numba.comparison import brightness_moments, compare, explained_energy
from torchvo360.backends.numba.correlation import correlate_rotations
from torchvo360.backends.numba.kernel import is_compiled, kernel
from torchvo360.backends.numba.linearize import linearize, serves
from torchvo360.backends.numba.similarity import OneWay, RangeArrays, range_arrays, solve_similarities
from torchvo360.backends.numba.solve import Outcomes, Rules, Solved, solve_pairs

__all__ = [
    "OneWay",
    "Outcomes",
    "RangeArrays",
    "Rules",
    "Solved",
    "brightness_moments",
    "compare",
    "correlate_rotations",
    "explained_energy",
    "is_compiled",
    "kernel",
    "linearize",
    "range_arrays",
    "serves",
    "solve_pairs",
    "solve_similarities",
]
