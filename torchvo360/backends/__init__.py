"""The hot kernel: `linearize`, one signature for every backend, and `OpenLinearization` for what differentiates it."""

from torchvo360.backends.derivative import OpenLinearization
from torchvo360.backends.select import are_plain, backend, linearize, use_numba

__all__ = ["OpenLinearization", "are_plain", "backend", "linearize", "use_numba"]
