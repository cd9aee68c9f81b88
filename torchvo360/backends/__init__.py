"""The hot kernel: `linearize`, one signature for every backend, and `OpenLinearization` for what differentiates it."""

from torchvo360.backends.comparison import Comparison
from torchvo360.backends.derivative import OpenLinearization
from torchvo360.backends.select import backend, compare, linearize, use_numba

__all__ = ["Comparison", "OpenLinearization", "backend", "compare", "linearize", "use_numba"]
