"""Central cameras: pixel to ray and back, the range they measure, Jacobians and solid angle."""

from torchvo360.cameras.base import Camera, Intrinsics, check_image_size
from torchvo360.cameras.equirectangular import Equirectangular
from torchvo360.cameras.pinhole import Pinhole

__all__ = ["Camera", "Equirectangular", "Intrinsics", "Pinhole", "check_image_size"]
