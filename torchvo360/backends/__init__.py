"""The hot kernel `linearize`, one signature for every backend."""

from torchvo360.backends.eager import linearize

__all__ = ["linearize"]
