"""The hot kernel: `linearize`, one signature for every backend, and `OpenLinearization` for what differentiates it."""

from torchvo360.backends.derivative import OpenLinearization
from torchvo360.backends.select import backend, linearize, use_numba

__all__ = ["OpenLinearization", "backend", "linearize", "use_numba"]
