"""The hot kernel as one compiled pass: `linearize` for float32 on the CPU without gradients; needs the extra `fast`."""

from torchvo360.backends.numba.linearize import linearize, serves

__all__ = ["linearize", "serves"]
