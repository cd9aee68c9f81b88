"""A run's input with its poses, as data for programs that learn a scene: COLMAP's layout, or nerfstudio's."""

from collections.abc import Callable, Iterator, Sized
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_choice
from torchvo360.data import ImageSequence
from torchvo360.data.frame import Frame
from torchvo360.export.colmap import PosedImage, write_colmap
from torchvo360.export.cubemap import Views
from torchvo360.export.nerfstudio import Shot, camera_keys, write_nerfstudio
from torchvo360.export.recorded import Recorded
from torchvo360.export.sharpness import blurred, sharpness
from torchvo360.export.tracks import Patches
from torchvo360.lie import se3_inverse

IMAGES, MASKS, SPARSE = "images", "masks", "sparse/0"

KINDS = {"jpg": [cv2.IMWRITE_JPEG_QUALITY, 95], "png": []}
"""Kinds of image files, and how OpenCV is to write them."""

LEAST_SHOWN = 0.02
"""Share of a face's pixels that the mask must leave: others are left out."""

Progress = Callable[[int], object]
"""Is told how many frames more were read."""


@dataclass(frozen=True, eq=False)
class Material:
    """What an export is made of."""

    sequence: ImageSequence
    mask: Bool[Tensor, "H W"] | None
    """The pixels to use; None for all."""
    recorded: Recorded
    frames: list[int]
    """Indices of the frames to export."""
    kind: str = "jpg"
    """Of image files."""

    def __post_init__(self) -> None:
        check_choice("image", self.kind, list(KINDS))

    @property
    def camera(self) -> Camera:
        """The camera of the images."""
        return self.recorded.camera_of(self.sequence.camera)

    def read(self, indices: set[int], progress: Progress) -> Iterator[tuple[Frame, UInt8[np.ndarray, "H W 3"]]]:
        """Yield the usable frames among some, and read no further than the last.

        Raises:
            InputError: The input ends before.
        """
        last, reached = max(indices), -1
        for frame in self.sequence:
            reached = frame.index
            progress(1)
            if reached in indices and frame.image is not None and not frame.problem:
                yield frame, frame.image
            if reached >= last:
                return
        raise InputError(f"input: expected frames up to {last} as in the run, got {reached} for the last one.")

    def left_out(self, sharpness_of: dict[int, float]) -> tuple[set[int], list[str]]:
        """Return the blurred ones among the frames that were read, and sentences on those that are left out."""
        unusable, unsharp = len(set(self.frames) - sharpness_of.keys()), blurred(sharpness_of)
        notes = []
        for count, reason in ((unusable, "their images cannot be used"), (len(unsharp), "they are blurred")):
            if count:
                notes.append(f"{count} of {len(self.frames)} frames are left out: {reason}.")
        return unsharp, notes


def export_nerfstudio(folder: Path, material: Material, progress: Progress) -> list[str]:
    """Write the images as they are, masks, transforms.json and the points into a new folder, and return notes.

    Raises:
        InputError: The input is another one by now, or none of its frames can be used.
        OSError: A file cannot be written.
    """
    camera, pose_of = material.camera, material.recorded.pose_of()
    camera_keys(camera)
    (folder / IMAGES).mkdir()
    mask_path = None
    if material.mask is not None:
        (folder / MASKS).mkdir()
        mask_path = f"{MASKS}/mask.png"
        _write_mask(folder / mask_path, material.mask.numpy())
    shots: dict[int, Shot] = {}
    sharpness_of = {}
    for frame, image in material.read(set(material.frames), progress):
        path = f"{IMAGES}/{_name(frame.index)}.{material.kind}"
        _write_image(folder / path, image)
        shots[frame.index] = Shot(path, pose_of[frame.index], mask_path)
        sharpness_of[frame.index] = sharpness(image)
    _check_some(shots)
    unsharp, notes = material.left_out(sharpness_of)
    for index in unsharp:
        (folder / shots.pop(index).path).unlink()
    known = material.recorded
    write_nerfstudio(folder, camera, list(shots.values()), known.xyz, known.rgb, known.host, gravity=known.gravity)
    return notes


def export_colmap(folder: Path, material: Material, views: Views, progress: Progress) -> list[str]:
    """Write pinhole images, masks and the sparse model into a new folder, and return notes.

    The input is read twice: for the points' looks in their keyframes, and for the images. In its own keyframe a point's
    observation is its pixel; elsewhere it is measured. All points are written, those that one image alone sees without
    a track.

    Args:
        folder: It must be there and empty.
        material: The run and its input.
        views: The pinhole images that are made of each frame.
        progress: Is told of every frame, of both readings.

    Raises:
        InputError: The input is another one by now, none of its frames can be used, or the mask hides all faces.
        OSError: A file cannot be written.
    """
    known, camera, pose_of = material.recorded, material.camera, material.recorded.pose_of()
    patches = _looks(material, pose_of, progress)
    shown = views.cut_mask(material.mask)
    is_cut = [bool(mask.mean() >= LEAST_SHOWN) for mask in shown]
    if not any(is_cut):
        raise InputError("faces: expected some of which the mask leaves more than 2 %, got none.")
    for name in (IMAGES, SPARSE, *([MASKS] if material.mask is not None else [])):
        (folder / name).mkdir(parents=True)
    images_of: dict[int, list[PosedImage]] = {}
    sharpness_of = {}
    for frame, image in material.read(set(material.frames), progress):
        T_cam_world = se3_inverse(pose_of[frame.index])
        seen, found = patches.seen(image, camera, pose_of[frame.index], material.mask)
        own = known.host == frame.index
        p_cam = known.xyz.double() @ T_cam_world[:3, :3].mT + T_cam_world[:3, 3]
        rays = torch.where(own[:, None], p_cam, camera.ray(found))
        seen |= own
        sharpness_of[frame.index] = sharpness(image)
        images_of[frame.index] = []
        for view, picture, mask, kept in zip(views.views, views.cut(image), shown, is_cut, strict=True):
            if not kept:
                continue
            name = f"{_name(frame.index)}{'_' * bool(view.name)}{view.name}.{material.kind}"
            _write_image(folder / IMAGES / name, picture)
            if material.mask is not None:
                _write_mask(folder / MASKS / f"{name}.png", mask)
            uv, inside = view.camera.project(rays @ view.T_view_cam[:3, :3].mT)
            point = (seen & inside).nonzero()[:, 0]
            images_of[frame.index].append(PosedImage(name, view.T_view_cam @ T_cam_world, uv[point], point))
    _check_some(images_of)
    unsharp, notes = material.left_out(sharpness_of)
    for image in (image for index in unsharp for image in images_of.pop(index)):
        (folder / IMAGES / image.name).unlink()
        (folder / MASKS / f"{image.name}.png").unlink(missing_ok=True)
    images = _seen_twice(list(chain(*images_of.values())), len(known.xyz))
    write_colmap(folder / SPARSE, views.views[0].camera, images, known.xyz, known.rgb)
    hidden = [view.name for view, kept in zip(views.views, is_cut, strict=True) if not kept]
    if hidden:
        notes.append(f"left out, as the mask leaves nothing of them: faces {', '.join(hidden)}.")
    return notes


def _looks(material: Material, pose_of: dict[int, Float64[Tensor, "4 4"]], progress: Progress) -> Patches:
    """Return the points' looks in their keyframes."""
    known = material.recorded
    patches = Patches.empty(len(known.xyz))
    hosts = set(known.host.tolist()) & pose_of.keys()
    if hosts:
        for frame, image in material.read(hosts, progress):
            which = known.host == frame.index
            patches.fill(which, known.xyz[which], image, material.camera, pose_of[frame.index])
    return patches


def _seen_twice(images: list[PosedImage], points: int) -> list[PosedImage]:
    """Leave out the observations of points that only one image sees: COLMAP's bundle adjustment refuses such tracks."""
    count = torch.bincount(torch.cat([image.point for image in images]), minlength=points)
    is_kept = [count[image.point] > 1 for image in images]
    return [
        replace(image, uv=image.uv[kept], point=image.point[kept]) for image, kept in zip(images, is_kept, strict=True)
    ]


def _check_some(images: Sized) -> None:
    if not images:
        raise InputError("frames: expected some whose images can be used, got none.")


def _name(index: int) -> str:
    return f"frame_{index:06d}"


def _write_image(path: Path, image: UInt8[np.ndarray, "H W 3"]) -> None:
    _encode(path, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


def _write_mask(path: Path, mask: Bool[np.ndarray, "H W"]) -> None:
    """Write white where the image is to be used."""
    _encode(path, mask.astype(np.uint8) * 255)


def _encode(path: Path, image: UInt8[np.ndarray, "*shape"]) -> None:
    """Write an image file; `cv2.imwrite` would not say why it cannot, such as for a full disk."""
    done, data = cv2.imencode(path.suffix, image, KINDS[path.suffix[1:]])
    assert done
    path.write_bytes(data.tobytes())
