"""The hot kernel: `linearize`, one signature for every backend, and `OpenLinearization` for what differentiates it."""

from torchvo360.backends.comparison import Comparison
from torchvo360.backends.derivative import OpenLinearization
from torchvo360.backends.select import BACKENDS, are_plain, backend, compare, linearize, use_numba

__all__ = [
    "BACKENDS",
    "Comparison",
    "OpenLinearization",
    "are_plain",
    "backend",
    "compare",
    "linearize",
    "use_numba",
]
