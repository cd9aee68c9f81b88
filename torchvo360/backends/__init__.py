"""The hot kernel: `linearize`, one signature for every backend, and `OpenLinearization` for what differentiates it."""

from torchvo360.backends.derivative import OpenLinearization
from torchvo360.backends.eager import linearize

__all__ = ["OpenLinearization", "linearize"]
