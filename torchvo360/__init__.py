"""Dense direct alignment and visual odometry for 360-degree cameras, in plain PyTorch."""

from torchvo360 import lie
from torchvo360.cameras import Equirectangular, Pinhole

__all__ = ["Equirectangular", "Pinhole", "lie"]
