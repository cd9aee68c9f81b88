"""Readers and worlds: everything that yields frames, poses and masks."""

from torchvo360.data.frame import Frame, ImageSequence
from torchvo360.data.trajectory import Trajectory

__all__ = ["Frame", "ImageSequence", "Trajectory"]
