"""The hot kernel by `torch.compile`, for those who ask for it: half a minute of compiling, then one pass in C++."""

from torchvo360.backends.compiled.linearize import NO_COMPILER, has_compiler, linearize, serves

__all__ = ["NO_COMPILER", "has_compiler", "linearize", "serves"]
