"""nerfstudio's transforms.json: panoramas or pinhole images with poses, and the map's points as PLY.

Camera axes are OpenGL's, x right, y up, z back, and the world's z points up: `transform_matrix` is

    T_saved_cam = T_saved_world @ T_world_cam @ diag(1, -1, -1, 1)

with T_saved_world = `applied_transform`. Of a panorama, `fl_x` = `fl_y` = w / 2 = h; a pixel's ray is then, with
a = pi (u - cx) / fl_x and b = pi (0.5 + (v - cy) / fl_y),  (sin a sin b, cos b, -cos a sin b).  Points are saved in the
same world as the poses.

Source: https://docs.nerf.studio/quickstart/data_conventions.html and the class Cameras in nerfstudio's reference.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Float64, Int32, UInt8
from torch import Tensor

from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.checks import InputError, check_pose
from torchvo360.export.ply import write_ply
from torchvo360.lie import se3, so3_exp

POINTS = "points.ply"

TRANSFORMS = "transforms.json"

OPENGL = (1.0, -1.0, -1.0, 1.0)
"""From OpenGL's camera axes to x right, y down, z forward."""

Z_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""A world with x right, y down, z forward in one with z up: the rows of the rotation."""


@dataclass(frozen=True, eq=False)
class Shot:
    """An image file and its pose."""

    path: str
    """Relative to transforms.json."""
    T_world_cam: Float64[Tensor, "4 4"]
    mask: str | None = None
    """The file of its mask, white where the image is to be used."""


def upright(gravity: Sequence[float] | None) -> Float64[Tensor, "4 4"]:
    """Return T_saved_world: the world turned so that z points up.

    Args:
        gravity: Points down in the world's axes; None takes y for down.

    Raises:
        InputError: It is zero or not finite.
    """
    R_saved_down = torch.tensor(Z_UP, dtype=torch.float64)
    zero = torch.zeros(3, dtype=torch.float64)
    if gravity is None:
        return se3(R_saved_down, zero)
    g = torch.tensor(gravity, dtype=torch.float64)
    if not (bool(torch.isfinite(g).all()) and float(g.norm()) > 0):
        raise InputError(f"gravity: expected a direction, got {list(gravity)}.")
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    axis = torch.linalg.cross(g / g.norm(), down)
    sine, cosine = float(axis.norm()), float(g[1] / g.norm())
    if sine < 1e-12:  # along y: no turn, or half of one about any level axis
        w = zero if cosine > 0 else torch.tensor([0.0, 0.0, math.pi], dtype=torch.float64)
    else:
        w = axis * (math.atan2(sine, cosine) / sine)
    return se3(R_saved_down @ so3_exp(w), zero)


def camera_keys(camera: Camera) -> dict[str, Any]:
    """Return the intrinsics under nerfstudio's names.

    Raises:
        InputError: The camera is a panorama that is not the full sphere, or another kind.
    """
    size = {"w": camera.width, "h": camera.height}
    if isinstance(camera, Pinhole):
        names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
        return {"camera_model": "OPENCV", **size, **dict(zip(names, (*camera.intrinsics, 0, 0, 0, 0), strict=True))}
    if not isinstance(camera, Equirectangular) or not _is_full(camera):
        raise InputError("camera: expected a full panorama or a pinhole for nerfstudio; format=colmap takes others.")
    width, height = camera.width, camera.height
    focal = {"fl_x": width / 2, "fl_y": float(height), "cx": width / 2, "cy": height / 2}
    return {"camera_model": "EQUIRECTANGULAR", **size, **focal}


def write_nerfstudio(
    folder: Path,
    camera: Camera,
    shots: Sequence[Shot],
    xyz: Float[Tensor, "N 3"],
    rgb: UInt8[Tensor, "N 3"],
    frame: Int32[Tensor, "N"],
    *,
    gravity: Sequence[float] | None = None,
) -> None:
    """Write transforms.json, and the points beside it.

    Args:
        folder: It must be there.
        camera: Of all images: a full panorama or a pinhole.
        shots: The images, at least one; either all with a mask or none.
        xyz: Points in the world.
        rgb: Their colours.
        frame: The frame that each belongs to.
        gravity: Points down in the world's axes; None takes y for down.

    Raises:
        InputError: There is no image, a pose is none, or the camera is one that nerfstudio has not.
        OSError: A file cannot be written.
    """
    if not shots:
        raise InputError("shots: expected at least one image, got none.")
    T_world_cam = torch.stack([shot.T_world_cam for shot in shots])
    check_pose("T_world_cam", T_world_cam)
    T_saved_world = upright(gravity)
    T_saved_cam = T_saved_world @ T_world_cam @ torch.diag(torch.tensor(OPENGL, dtype=torch.float64))
    frames = []
    for shot, matrix in zip(shots, T_saved_cam.tolist(), strict=True):
        mask = {} if shot.mask is None else {"mask_path": shot.mask}
        frames.append({"file_path": shot.path, **mask, "transform_matrix": matrix})
    content = {
        **camera_keys(camera),
        "applied_transform": T_saved_world[:3].tolist(),
        "ply_file_path": POINTS,
        "frames": frames,
    }
    write_ply(folder / POINTS, xyz.double() @ T_saved_world[:3, :3].mT, rgb, frame)
    (folder / TRANSFORMS).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _is_full(camera: Equirectangular) -> bool:
    return camera.intrinsics == Equirectangular(camera.width, camera.height).intrinsics
