"""Central cameras: pixel to ray and back, the range they measure, Jacobians and solid angle."""

from torchvo360.cameras.base import Camera, Intrinsics, check_image_size
from torchvo360.cameras.equirectangular import Equirectangular
from torchvo360.cameras.lens import Lens
from torchvo360.cameras.pinhole import Pinhole
from torchvo360.cameras.rig import Rig

__all__ = ["Camera", "Equirectangular", "Intrinsics", "Lens", "Pinhole", "Rig", "check_image_size"]
