"""COLMAP's sparse model, as text and binary: a camera, images with poses, points with colours and tracks.

Poses are T_cam_world, quaternions w first; pixel centres are at +0.5, axes x right, y down, z forward: all as here, so
that nothing is converted. The files `rigs` and `frames` of newer versions are left out, as the format allows: trainers
of Gaussian splats read the three files below, and COLMAP itself makes a rig of each camera.

Source: https://colmap.github.io/format.html.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, UInt8
from torch import Tensor

from torchvo360.cameras import Pinhole
from torchvo360.checks import InputError, check_pose, check_shape
from torchvo360.lie import quaternion_from_matrix

CAMERA_ID = 1

PINHOLE = 1
"""COLMAP's number of its model with fx, fy, cx, cy."""

POINT_2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])

POINT_3D = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")], align=False
)

TRACK = np.dtype([("image", "<i4"), ("index", "<i4")])


@dataclass(frozen=True, eq=False)
class PosedImage:
    """A pinhole image and what it sees."""

    name: str
    """Of its file, relative to the folder of images."""
    T_cam_world: Float64[Tensor, "4 4"]
    uv: Float64[Tensor, "n 2"]
    """Pixels of the points that it sees."""
    point: Int64[Tensor, "n"]
    """Which points these are."""


@dataclass(frozen=True, eq=False)
class _Tracks:
    """All observations, those of one point together."""

    length: Int64[np.ndarray, "N"]
    entry: np.ndarray
    """Of TRACK."""
    error: Float64[np.ndarray, "N"]
    """Mean distance in pixels of a point's observations from where it projects; 0 without any."""


def write_colmap(
    folder: Path,
    camera: Pinhole,
    images: Sequence[PosedImage],
    xyz: Float[Tensor, "N 3"],
    rgb: UInt8[Tensor, "N 3"],
) -> None:
    """Write cameras, images and points3D, each as .txt and .bin.

    Args:
        folder: Where, usually sparse/0 beside the folder of images; it must be there.
        camera: Of all images.
        images: At least one.
        xyz: Points in the world.
        rgb: Their colours.

    Raises:
        InputError: There is no image, a pose is none, or an image sees a point that is not there.
        OSError: A file cannot be written.
    """
    check_shape("xyz", xyz, "N 3")
    check_shape("rgb", rgb, f"{len(xyz)} 3")
    if not images:
        raise InputError("images: expected at least one, got none.")
    for image in images:
        check_pose("T_cam_world", image.T_cam_world)
        if len(image.point) and not 0 <= int(image.point.min()) <= int(image.point.max()) < len(xyz):
            raise InputError(f"point: expected 0 to {len(xyz) - 1}, got others in {image.name}.")
    tracks = _tracks(camera, images, xyz)
    _write_cameras(folder, camera)
    _write_images(folder, images)
    _write_points(folder, xyz.double().numpy(), rgb.numpy(), tracks)


def _tracks(camera: Pinhole, images: Sequence[PosedImage], xyz: Float[Tensor, "N 3"]) -> _Tracks:
    point = np.concatenate([image.point.numpy() for image in images])
    entry = np.empty(len(point), TRACK)
    entry["image"] = np.repeat(np.arange(1, len(images) + 1), [len(image.point) for image in images])
    entry["index"] = np.concatenate([np.arange(len(image.point)) for image in images])
    off = []
    for image in images:
        p_cam = xyz[image.point].double() @ image.T_cam_world[:3, :3].mT + image.T_cam_world[:3, 3]
        off.append(torch.linalg.vector_norm(camera.pixel(p_cam) - image.uv, dim=-1).numpy())
    length = np.bincount(point, minlength=len(xyz))
    error = np.bincount(point, np.concatenate(off), minlength=len(xyz)) / np.maximum(length, 1)
    return _Tracks(length, entry[np.argsort(point, kind="stable")], error)


def _write_cameras(folder: Path, camera: Pinhole) -> None:
    k = camera.intrinsics
    (folder / "cameras.bin").write_bytes(
        struct.pack("<QiiQQ4d", 1, CAMERA_ID, PINHOLE, camera.width, camera.height, *k)
    )
    numbers = " ".join(f"{value:.17g}" for value in k)
    (folder / "cameras.txt").write_text(
        f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n{CAMERA_ID} PINHOLE {camera.width} {camera.height} {numbers}\n",
        encoding="ascii",
    )


def _write_images(folder: Path, images: Sequence[PosedImage]) -> None:
    T = torch.stack([image.T_cam_world for image in images])
    pose = torch.cat([quaternion_from_matrix(T[:, :3, :3])[:, [3, 0, 1, 2]], T[:, :3, 3]], -1).tolist()
    with (folder / "images.bin").open("wb") as binary, (folder / "images.txt").open("w", encoding="utf-8") as text:
        binary.write(struct.pack("<Q", len(images)))
        text.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n")
        for number, (image, numbers) in enumerate(zip(images, pose, strict=True), 1):
            points = np.empty(len(image.point), POINT_2D)
            points["xy"], points["point"] = image.uv.numpy(), image.point.numpy() + 1
            binary.write(struct.pack("<i7di", number, *numbers, CAMERA_ID) + image.name.encode() + b"\0")
            binary.write(struct.pack("<Q", len(points)) + points.tobytes())
            text.write(f"{number} {' '.join(f'{value:.17g}' for value in numbers)} {CAMERA_ID} {image.name}\n")
            seen = zip(image.uv.tolist(), points["point"].tolist(), strict=True)
            text.write(" ".join(f"{x:.9g} {y:.9g} {point}" for (x, y), point in seen) + "\n")


def _write_points(
    folder: Path, xyz: Float64[np.ndarray, "N 3"], rgb: UInt8[np.ndarray, "N 3"], tracks: _Tracks
) -> None:
    """Write the points; in the binary file each record is as long as its track."""
    points = np.empty(len(xyz), POINT_3D)
    points["id"], points["xyz"], points["rgb"] = np.arange(1, len(xyz) + 1), xyz, rgb
    points["error"], points["length"] = tracks.error, tracks.length
    end = np.cumsum(tracks.length)
    begin = np.arange(len(xyz)) * POINT_3D.itemsize + (end - tracks.length) * TRACK.itemsize
    is_head = np.zeros(len(xyz) * POINT_3D.itemsize + len(tracks.entry) * TRACK.itemsize, bool)
    is_head[(begin[:, None] + np.arange(POINT_3D.itemsize)).ravel()] = True
    body = np.empty(len(is_head), np.uint8)
    body[is_head] = np.frombuffer(points.tobytes(), np.uint8)
    body[~is_head] = np.frombuffer(tracks.entry.tobytes(), np.uint8)
    with (folder / "points3D.bin").open("wb") as binary:
        binary.write(struct.pack("<Q", len(points)))
        body.tofile(binary)
    entries = [f"{image} {index}" for image, index in tracks.entry.tolist()]
    with (folder / "points3D.txt").open("w", encoding="ascii") as text:
        text.write("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n")
        columns = (points[name].tolist() for name in ("id", "error", "length"))
        for number, error, length, last, (x, y, z), (r, g, b) in zip(
            *columns, end.tolist(), xyz.tolist(), rgb.tolist(), strict=True
        ):
            track = " ".join(entries[last - length : last])
            text.write(f"{number} {x:.9g} {y:.9g} {z:.9g} {r} {g} {b} {error:.6g} {track}\n")
