"""Point clouds as binary PLY."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchvo360.checks import InputError, check_floating, check_shape
from torchvo360.files import atomic_path

VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])

HEADER = """ply
format binary_little_endian 1.0
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""


def write_ply(path: str | Path, xyz: Float[Tensor, "N 3"], rgb: UInt8[Tensor, "N 3"]) -> None:
    """Write coloured points, as float32.

    Args:
        path: The file; it appears only when it is complete.
        xyz: Points in the world, metres.
        rgb: Their colours, 0 to 255.

    Raises:
        InputError: Shapes or types are others, or a coordinate is not finite.
        OSError: The file cannot be written.
    """
    check_shape("xyz", xyz, "N 3")
    check_shape("rgb", rgb, f"{xyz.shape[0]} 3")
    check_floating("xyz", xyz)
    if rgb.dtype != torch.uint8:
        raise InputError(f"rgb: expected uint8, got {rgb.dtype}.")
    if not bool(torch.isfinite(xyz).all()):
        raise InputError("xyz: expected finite coordinates, got others.")
    vertices = np.empty(xyz.shape[0], VERTEX)
    vertices["xyz"] = xyz.detach().cpu().numpy()
    vertices["rgb"] = rgb.cpu().numpy()
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(HEADER.format(count=len(vertices)).encode("ascii"))
        vertices.tofile(file)
