"""Point clouds as binary PLY."""

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor

from torchvo360.checks import InputError, check_floating, check_shape
from torchvo360.files import atomic_path

VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3), ("frame", "<i4")])

HEADER = """ply
format binary_little_endian 1.0
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
property int frame
end_header
"""


def write_ply(
    path: str | Path, xyz: Float[Tensor, "N 3"], rgb: UInt8[Tensor, "N 3"], frame: Int32[Tensor, "N"]
) -> None:
    """Write coloured points, as float32.

    Args:
        path: The file; it appears only when it is complete.
        xyz: Points in the world, metres.
        rgb: Their colours, 0 to 255.
        frame: Index of the frame that each was seen in first.

    Raises:
        InputError: Shapes or types are others, or a coordinate is not finite.
        OSError: The file cannot be written.
    """
    check_shape("xyz", xyz, "N 3")
    check_shape("rgb", rgb, f"{xyz.shape[0]} 3")
    check_shape("frame", frame, f"{xyz.shape[0]}")
    check_floating("xyz", xyz)
    if rgb.dtype != torch.uint8:
        raise InputError(f"rgb: expected uint8, got {rgb.dtype}.")
    if not bool(torch.isfinite(xyz).all()):
        raise InputError("xyz: expected finite coordinates, got others.")
    vertices = np.empty(xyz.shape[0], VERTEX)
    vertices["xyz"] = xyz.detach().cpu().numpy()
    vertices["rgb"] = rgb.cpu().numpy()
    vertices["frame"] = frame.cpu().numpy()
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(HEADER.format(count=len(vertices)).encode("ascii"))
        vertices.tofile(file)


def read_ply(path: str | Path) -> tuple[Float[Tensor, "N 3"], UInt8[Tensor, "N 3"], Int32[Tensor, "N"]]:
    """Read what `write_ply` wrote: points, colours and frames.

    Raises:
        InputError: The file is missing, cut off, damaged, or another program's.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: expected a point cloud, got none: {error.strerror}.") from None
    head, found, body = data.partition(b"end_header\n")
    match = re.search(rb"element vertex ([0-9]{1,9})\n", head)
    count = int(match[1]) if match else 0
    if not found or HEADER.format(count=count).encode("ascii") != head + found:
        raise InputError(f"{path}: expected a point cloud as torchvo360 writes it, got another file.")
    if len(body) != count * VERTEX.itemsize:
        raise InputError(f"{path}: expected {count} points, got {len(body) // VERTEX.itemsize}: the file is cut off.")
    vertices = np.frombuffer(body, VERTEX)
    if not np.isfinite(vertices["xyz"]).all():
        raise InputError(f"{path}: expected finite coordinates, got others: the file is damaged.")
    return tuple(torch.from_numpy(vertices[name].copy(order="C")) for name in ("xyz", "rgb", "frame"))  # pyright: ignore[reportReturnType]
