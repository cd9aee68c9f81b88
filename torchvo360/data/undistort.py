"""From what a lens saw to what one of our cameras would see: one map, made once, resamples every image.

The camera keeps the resolution that the lens has in the middle of its image, unless another size is asked for.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int16, Int64, UInt8, UInt16
from torch import Tensor

from torchvo360.cameras import Camera, Equirectangular, Lens, Pinhole
from torchvo360.checks import InputError, check_choice

TARGETS = ("auto", "pinhole", "panorama")

WIDE = math.radians(120)
"""Beyond this angle between opposite edges of the image a plane spends most of its pixels on its border."""

MOST_SLOPE = math.tan(WIDE / 2)
"""How far to each side a pinhole reaches on the plane z = 1, whatever the lens sees."""

MIN_AHEAD = 1e-3
"""Rays of length 1 with a smaller z are no points of that plane."""

EDGE_POINTS = 400
"""Points on each edge of the image from which the pinhole's rectangle follows."""

SPHERE_STEP_DEG = 0.5
"""Between the directions that are asked whether the lens sees them."""

SHRINK_FROM = 1.25
"""A lens with this many times the target's resolution is averaged down first: a map alone would skip pixels."""

LEAST_SIZE = 16
"""A lens whose resolution makes a smaller image than this, in pixels, has an impossible focal length or distortion."""

ROWS_AT_ONCE = 256
"""Of a map: the memory that its intermediate values take."""

SAME_PX = 1e-3
"""A map that moves no pixel farther than this is none."""


@dataclass(frozen=True, eq=False)
class Undistortion:
    """Resamples the images of one lens into those of a camera; the map is made by `undistort`."""

    lens: Lens
    camera: Camera
    mask: Bool[Tensor, "H W"] | None
    """The pixels that the lens sees; None where it sees them all."""
    shrunk: Lens
    """The lens after averaging down, from which the map starts; the lens itself where there is none."""
    fixed: tuple[Int16[np.ndarray, "H W 2"], UInt16[np.ndarray, "H W"]] | None
    """The map to pixels of the shrunk image, in OpenCV's fixed point; None where it moves nothing."""
    nearest: Int64[np.ndarray, "H W"] | None
    """Which of the lens's own pixels, counted row by row, is the nearest; None where the map moves nothing."""

    @property
    def source_size(self) -> tuple[int, int]:
        """Width and height of the images that come in."""
        return self.lens.width, self.lens.height

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """Return the camera's image; beyond the lens's own image its edge is continued.

        Raises:
            InputError: The image is not of the lens's size.
        """
        self._check_size(image)
        if self.shrunk is not self.lens:
            image = cv2.resize(image, (self.shrunk.width, self.shrunk.height), interpolation=cv2.INTER_AREA)
        if self.fixed is None:
            return image
        # a black surround would be an edge that goes along with the camera
        return cv2.remap(image, *self.fixed, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def depth(self, depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "H W"]:
        """Return the camera's ranges (z) by nearest neighbours, 0 where the lens sees nothing: no two are ever mixed.

        Raises:
            InputError: The image is not of the lens's size, or the camera is a panorama, which measures distances.
        """
        self._check_size(depth)
        if not isinstance(self.camera, Pinhole):
            raise InputError(f"depth: expected a pinhole camera for a sensor's z, got {self.camera}.")
        if self.nearest is None:
            return depth
        moved = np.take(depth, self.nearest)
        if self.mask is not None:
            moved[~self.mask.numpy()] = 0
        return moved

    def _check_size(self, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        if (width, height) != (self.lens.width, self.lens.height):
            raise InputError(
                f"image: expected the lens's {self.lens.width} x {self.lens.height} pixels, got {width} x {height}."
            )


def undistort(lens: Lens, *, target: str = "auto", size: tuple[int, int] | None = None) -> Undistortion:
    """Choose the camera for a lens, and make the map into it.

    Args:
        lens: What took the images.
        target: `pinhole`, whose pixels all lie inside the lens's image as far as its field of view goes, like OpenCV's
            alpha = 0, and at most 120 degrees across; `panorama`, equirectangular, of the whole sphere where the lens
            sees straight up or down and else of the part that it sees; `auto`, a panorama for a fisheye that sees more
            than 120 degrees between opposite edges of its image.
        size: Width and height of the camera's image; None for the lens's resolution in the middle of its image. A
            pinhole's rectangle is cut to this shape; a panorama keeps what it shows.

    Returns:
        The map; an undistorted lens in its own size gives one that changes nothing.

    Raises:
        InputError: The target or the size is none, or the lens sees too little to fill an image.
    """
    camera = undistorted_camera(lens, target=target, size=size)
    if camera == lens.pinhole and lens.model == "none":
        return Undistortion(lens, camera, None, lens, None, None)
    rays = camera.ray_grid(dtype=torch.float64)
    some = [lens.project(rows) for rows in rays.split(ROWS_AT_ONCE)]
    uv, seen = (torch.cat(parts) for parts in zip(*some, strict=True))
    if not bool(seen.any()):
        raise InputError("camera: expected a lens that sees some of what its image is resampled to, got none of it.")
    shrunk = _shrunk(lens, camera)
    by = torch.tensor([shrunk.width / lens.width, shrunk.height / lens.height], dtype=torch.float64)
    return Undistortion(
        lens=lens,
        camera=camera,
        mask=None if bool(seen.all()) else seen,
        shrunk=shrunk,
        fixed=_fixed(uv * by, shrunk),
        nearest=_nearest(uv, lens),
    )


def undistorted_camera(lens: Lens, *, target: str = "auto", size: tuple[int, int] | None = None) -> Camera:
    """Return the camera that `undistort` would choose, without the work of its map.

    Raises:
        InputError: As `undistort` does.
    """
    check_choice("target", target, TARGETS)
    if size is not None and (len(size) != 2 or min(size) < 1):
        raise InputError(f"size: expected a width and a height, got {' x '.join(map(str, size))}.")
    if target == "auto":
        target = "panorama" if lens.model == "equidistant" and _angle_across(lens) > WIDE else "pinhole"
    if target == "pinhole" and lens.model == "none" and size in (None, (lens.width, lens.height)):
        return lens.pinhole
    camera = _panorama(lens, size) if target == "panorama" else _pinhole(lens, size)
    if size is None and min(camera.width, camera.height) < LEAST_SIZE:
        raise InputError(
            f"camera: expected a lens that fills at least {LEAST_SIZE} x {LEAST_SIZE} pixels of a {target}, "
            f"got {camera.width} x {camera.height}."
        )
    return camera


def _angle_across(lens: Lens) -> float:
    """Return the larger angle between opposite edges of the image, through the principal point; 2 pi for no end."""
    edges = [[0.0, lens.cy], [lens.width, lens.cy], [lens.cx, 0.0], [lens.cx, lens.height]]
    ray, valid = lens.ray(torch.tensor(edges, dtype=torch.float64))
    theta = torch.where(valid, torch.atan2(torch.linalg.vector_norm(ray[:, :2], dim=-1), ray[:, 2]), math.pi)
    return float(torch.maximum(theta[0] + theta[1], theta[2] + theta[3]))


def _pinhole(lens: Lens, size: tuple[int, int] | None) -> Pinhole:
    """Return the pinhole with the lens's focal lengths, or of the size, in the largest upright rectangle it sees."""
    low, high = _inner_rectangle(lens)
    focal = torch.tensor([lens.fx, lens.fy], dtype=torch.float64)
    first, last = low * focal, high * focal  # pixels from the principal point; they change places where f is negative
    first, last = torch.minimum(first, last), torch.maximum(first, last)
    reach = last - first
    width, height = size or (max(1, math.floor(length + SAME_PX)) for length in reach.tolist())
    scale = 1.0 if size is None else max(width / float(reach[0]), height / float(reach[1]))
    spare = reach * scale - torch.tensor([width, height], dtype=torch.float64)
    cx, cy = (-first * scale - spare / 2).tolist()
    return Pinhole(width, height, lens.fx * scale, lens.fy * scale, cx, cy)


def _inner_rectangle(lens: Lens) -> tuple[Float64[Tensor, "2"], Float64[Tensor, "2"]]:
    """Return the least and the largest x and y on the plane z = 1 between which the lens sees everything.

    Source: OpenCV's getOptimalNewCameraMatrix with alpha = 0: the innermost points of the image's edges.
    """
    along = torch.linspace(0, 1, EDGE_POINTS, dtype=torch.float64)
    fold = math.tan(min(lens.limit, WIDE / 2)) if lens.model == "equidistant" else lens.limit
    most = min(fold, MOST_SLOPE)
    low, high = [-most, -most], [most, most]
    for axis, (focal, size, other) in enumerate(
        ((lens.fx, lens.width, lens.height), (lens.fy, lens.height, lens.width))
    ):
        for place in (0.0, size):
            edge = torch.stack([torch.full_like(along, place), along * other], -1)
            ray, valid = lens.ray(edge if axis == 0 else edge.flip(-1))
            ahead = valid & (ray[:, 2] > MIN_AHEAD)
            if not bool(ahead.any()):
                continue
            slope = ray[ahead, axis] / ray[ahead, 2]
            if (place == 0) == (focal > 0):
                low[axis] = max(low[axis], float(slope.max()))
            else:
                high[axis] = min(high[axis], float(slope.min()))
    if not all(first < last for first, last in zip(low, high, strict=True)):
        raise InputError("camera: expected a lens that sees some of what lies within 60 degrees of its axis, got none.")
    return torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)


def _panorama(lens: Lens, size: tuple[int, int] | None) -> Equirectangular:
    """Return the panorama of what the lens sees: the whole sphere with a pole in view, else the part it sees."""
    sphere = Equirectangular(round(360 / SPHERE_STEP_DEG), round(180 / SPHERE_STEP_DEG))
    _, seen = lens.project(sphere.ray_grid(dtype=torch.float64))
    across, down = abs(lens.fx), abs(lens.fy)  # pixels a radian, in the middle
    rows, columns = (seen.any(axis).nonzero()[:, 0] for axis in (1, 0))
    if not len(rows):
        raise InputError("camera: expected a lens that sees something in front of it, got one that does not.")
    whole = int(rows[0]) == 0 or int(rows[-1]) == sphere.height - 1
    if whole:
        height = 2 * round(math.pi * max(across, down) / 2) if size is None else size[1]
        width = 2 * height if size is None else size[0]
        if width != 2 * height:
            raise InputError(
                f"size: expected a width of twice the height for a whole panorama, got {width} x {height}."
            )
        return Equirectangular(width, height)
    step = math.radians(SPHERE_STEP_DEG)
    left, right = int(columns[0]) * step - math.pi, (int(columns[-1]) + 1) * step - math.pi
    top, bottom = int(rows[0]) * step - math.pi / 2, (int(rows[-1]) + 1) * step - math.pi / 2  # downwards
    width, height = size or (round((right - left) * across), round((bottom - top) * down))
    fx, fy = width / (right - left), height / (bottom - top)
    return Equirectangular(width, height, fx, -fy, -left * fx, -top * fy)


def _shrunk(lens: Lens, camera: Camera) -> Lens:
    """Return the lens averaged down to about the camera's resolution; itself where it has no more."""
    fx, fy, _, _ = camera.intrinsics
    ratio = min(abs(lens.fx / fx), abs(lens.fy / fy))
    if ratio < SHRINK_FROM:
        return lens
    return lens.resized(max(1, round(lens.width / ratio)), max(1, round(lens.height / ratio)))


def _fixed(
    uv: Float64[Tensor, "H W 2"], lens: Lens
) -> tuple[Int16[np.ndarray, "H W 2"], UInt16[np.ndarray, "H W"]] | None:
    if _moves_nothing(uv, lens):
        return None
    opencv = (uv - 0.5).clamp(-1.0, float(max(lens.width, lens.height))).float()  # pixel centres at integers
    u, v = (np.ascontiguousarray(values.numpy()) for values in opencv.unbind(-1))
    integers, fractions = cv2.convertMaps(u, v, cv2.CV_16SC2)
    return integers.astype(np.int16, copy=False), fractions.astype(np.uint16, copy=False)


def _nearest(uv: Float64[Tensor, "H W 2"], lens: Lens) -> Int64[np.ndarray, "H W"] | None:
    if _moves_nothing(uv, lens):
        return None
    column = uv[..., 0].floor().clamp(0, lens.width - 1)
    row = uv[..., 1].floor().clamp(0, lens.height - 1)
    return (row * lens.width + column).long().numpy()


def _moves_nothing(uv: Float64[Tensor, "H W 2"], lens: Lens) -> bool:
    if uv.shape[:2] != (lens.height, lens.width):
        return False
    return float((uv - lens.pinhole.pixel_grid(dtype=torch.float64)).abs().max()) < SAME_PX
