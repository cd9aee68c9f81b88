"""The hot kernel: `linearize`, one signature for every backend, and `OpenLinearization` for what differentiates it."""

from torchvo360.backends.derivative import OpenLinearization
from torchvo360.backends.select import BACKENDS, backend, linearize, use_numba

__all__ = ["BACKENDS", "OpenLinearization", "backend", "linearize", "use_numba"]
