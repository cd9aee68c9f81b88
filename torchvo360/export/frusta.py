"""Cameras as pyramids along their way, coloured by time, for any program that shows 3-D models: glTF or PLY.

A camera is drawn as the pyramid of a view ahead, its tip at the camera's centre, with a spike on its upper edge. glTF
(.glb) holds lines, with the camera's way between the tips; PLY holds triangles, which all programs show. PLY keeps the
run's world, x right, y down, z forward; glTF, whose y points up, turns it by half a turn about x.

Source: the Khronos glTF 2.0 specification, sections 3.6 (buffers, accessors), 3.7 (meshes) and 4.4 (GLB).
"""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8
from torch import Tensor

from torchvo360.checks import InputError, check_choice, check_finite_number, check_pose, check_shape
from torchvo360.files import atomic_path

CORNERS = (
    (0.0, 0.0, 0.0),
    (-0.8, -0.6, 1.0),
    (0.8, -0.6, 1.0),
    (0.8, 0.6, 1.0),
    (-0.8, 0.6, 1.0),
    (0.0, -1.0, 1.0),
)
"""Tip, upper left, upper right, lower right, lower left, and the spike: the camera's axes, at a depth of 1."""

EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (1, 5), (5, 2))

TRIANGLES = ((0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (1, 5, 2))

SHARE = 0.03
"""Depth of a pyramid, as a share of the way's extent."""

ALONE = 0.1
"""Depth of a pyramid where the camera stays in one place, in the world's unit."""

SUFFIXES = (".glb", ".ply")

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
UNSIGNED_BYTE, UNSIGNED_INT, FLOAT = 5121, 5125, 5126
LINES = 1
"""Numbers of the glTF specification."""

HALF_TURN_ABOUT_X = (1, 0, 0, 0)
"""The quaternion x, y, z, w from y down, z forward to y up, z back."""

HEADER = """ply
format binary_little_endian 1.0
element vertex {vertices}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face {faces}
property list uchar int vertex_indices
end_header
"""


def write_frusta(path: str | Path, T_world_cam: Float64[Tensor, "N 4 4"], *, size: float | None = None) -> None:
    """Write one pyramid a pose.

    Args:
        path: The file, .glb or .ply; it appears only when it is complete.
        T_world_cam: Poses in the order of time.
        size: Depth of a pyramid in the world's unit; None takes 3 % of the way's extent.

    Raises:
        InputError: There is no pose, one is no rigid motion, or the suffix or the size is another one.
        OSError: The file cannot be written.
    """
    check_shape("T_world_cam", T_world_cam, "N 4 4")
    check_pose("T_world_cam", T_world_cam)
    suffix = Path(path).suffix.lower()
    check_choice("out", suffix, SUFFIXES)
    if not len(T_world_cam):
        raise InputError("T_world_cam: expected at least one pose, got none.")
    if size is None:
        centres = T_world_cam[:, :3, 3]
        size = SHARE * float((centres.amax(0) - centres.amin(0)).norm()) or ALONE
    check_finite_number("size", size, above=0.0)
    corners = size * torch.tensor(CORNERS, dtype=torch.float64)
    xyz = corners @ T_world_cam[:, :3, :3].mT + T_world_cam[:, None, :3, 3]
    vertices = xyz.flatten(0, 1).float().numpy()
    colours = np.repeat(colours_of_time(len(T_world_cam)), len(CORNERS), 0)
    first = len(CORNERS) * np.arange(len(T_world_cam))
    with atomic_path(path) as temporary:
        if suffix == ".ply":
            faces = (np.array(TRIANGLES) + first[:, None, None]).reshape(-1, 3)
            temporary.write_bytes(_ply(vertices, colours, faces))
        else:
            pyramids = (np.array(EDGES) + first[:, None, None]).reshape(-1, 2)
            way = np.stack([first[:-1], first[1:]], -1)
            temporary.write_bytes(_glb(vertices, colours, np.concatenate([pyramids, way])))


def colours_of_time(count: int) -> UInt8[np.ndarray, "N 3"]:
    """Return red, green, blue from the first to the last: OpenCV's turbo, from blue over green to red."""
    share = np.linspace(0, 255, count).round().astype(np.uint8)
    return cv2.applyColorMap(share[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]


def _ply(
    vertices: Float32[np.ndarray, "V 3"], colours: UInt8[np.ndarray, "V 3"], faces: Int64[np.ndarray, "F 3"]
) -> bytes:
    points = np.empty(len(vertices), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    points["xyz"], points["rgb"] = vertices, colours
    lists = np.empty(len(faces), [("count", "u1"), ("index", "<i4", 3)])
    lists["count"], lists["index"] = 3, faces
    header = HEADER.format(vertices=len(vertices), faces=len(faces)).encode("ascii")
    return header + points.tobytes() + lists.tobytes()


def _glb(
    vertices: Float32[np.ndarray, "V 3"], colours: UInt8[np.ndarray, "V 3"], lines: Int64[np.ndarray, "L 2"]
) -> bytes:
    """Return a binary glTF: a header, a chunk of JSON and a chunk with positions, colours and indices."""
    opaque = np.concatenate([colours, np.full((len(colours), 1), 255, np.uint8)], -1)  # 4 bytes: aligned as asked for
    parts = [vertices.astype("<f4").tobytes(), opaque.tobytes(), lines.astype("<u4").tobytes()]
    begins = np.cumsum([0, *map(len, parts)]).tolist()
    targets = (ARRAY_BUFFER, ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER)
    content = {
        "asset": {"version": "2.0", "generator": "torchvo360"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "cameras", "rotation": HALF_TURN_ABOUT_X}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "mode": LINES}]}],
        "buffers": [{"byteLength": begins[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": begin, "byteLength": len(part), "target": target}
            for begin, part, target in zip(begins, parts, targets, strict=False)
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": FLOAT,
                "count": len(vertices),
                "type": "VEC3",
                "min": vertices.min(0).tolist(),
                "max": vertices.max(0).tolist(),
            },
            {
                "bufferView": 1,
                "componentType": UNSIGNED_BYTE,
                "normalized": True,
                "count": len(opaque),
                "type": "VEC4",
            },
            {"bufferView": 2, "componentType": UNSIGNED_INT, "count": lines.size, "type": "SCALAR"},
        ],
    }
    text = json.dumps(content, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(parts)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
