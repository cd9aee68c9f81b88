"""The hot kernel: `linearize`, one signature for every backend, and `gradient` for what differentiates it."""

from torchvo360.backends.eager import gradient, linearize

__all__ = ["gradient", "linearize"]
