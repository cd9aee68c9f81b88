"""Pinhole images cut out of a camera's: the faces of a cube about a panorama, or a pinhole's own image.

Most programs that learn a scene from images know pinholes only. A panorama becomes four faces around the horizon, or
six with the zenith and the nadir, all from the camera's centre: `T_view_cam` is a rotation by right angles, exact in
floating point. By default a face has as many pixels a radian in its middle as the panorama has on the horizon, and
more towards its edges, so that nothing is lost.
"""

import math
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8
from torch import Tensor

from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.checks import InputError, check_finite_number
from torchvo360.image.padding import pad_image

ROWS = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
"""Each face's axes x, y, z in the camera's: the rows of R_face_cam."""

MARGIN = 2
"""Neighbours beyond the edge that cubic interpolation needs."""

MAX_FOV_DEG = 120.0

MAX_SIZE = 8192
"""Pixels: the look-up table of one face then takes half a gigabyte."""


@dataclass(frozen=True, eq=False)
class View:
    """One pinhole image of several that are cut out of a camera's."""

    name: str
    """Of the face; empty for a pinhole's own image."""
    camera: Pinhole
    T_view_cam: Float64[Tensor, "4 4"]


@dataclass(frozen=True, eq=False)
class Views:
    """How a camera's images become pinhole images; the maps are made once."""

    source: Camera
    views: tuple[View, ...]
    maps: tuple[Float32[np.ndarray, "h w 2"], ...] = ()
    """Where each face's pixels lie in the padded image, at `finer` times its resolution; none for a pinhole."""
    covered: tuple[Bool[np.ndarray, "H W"], ...] = ()
    """Which pixels of each face the camera sees."""
    finer: int = 1
    """Samples along each side of a pixel: more than one where the faces are coarser than the panorama."""

    @classmethod
    def of(cls, camera: Camera, *, faces: int = 6, fov_deg: float = 90.0, size: int | None = None) -> Self:
        """Plan the pinhole images of a camera.

        Args:
            camera: A panorama; or a pinhole, whose images stay as they are whatever the other arguments say.
            faces: 6, or 4 for those around the horizon.
            fov_deg: Angle across a face, degrees, 90 to 120: above 90 neighbours overlap.
            size: Width and height of a face, pixels, 8 to 8192; None keeps the panorama's resolution.

        Raises:
            InputError: An argument is not one of these, or the camera neither of those.
        """
        if isinstance(camera, Pinhole):
            return cls(camera, (View("", camera, torch.eye(4, dtype=torch.float64)),))
        if not isinstance(camera, Equirectangular):
            raise InputError(f"camera: expected a panorama or a pinhole, got {type(camera).__name__}.")
        check_faces(faces, fov_deg, size)
        across = 2 * math.tan(math.radians(fov_deg) / 2)
        kept = 2 * math.ceil(across / camera.pixel_angle / 2)
        if size is None:
            size = kept
        pinhole = Pinhole(size, size, size / across, size / across, size / 2, size / 2)
        views = []
        for name in list(ROWS)[:faces]:
            T_view_cam = torch.eye(4, dtype=torch.float64)
            T_view_cam[:3, :3] = torch.tensor(ROWS[name], dtype=torch.float64)
            views.append(View(name, pinhole, T_view_cam))
        finer = math.ceil(kept / size)
        fine = pinhole.resized(finer * size, finer * size)
        maps, covered = zip(*(_look_up(view.T_view_cam, fine, camera) for view in views), strict=True)
        inside = tuple(_shrunk(seen.astype(np.uint8) * 255, finer) == 255 for seen in covered)
        return cls(camera, tuple(views), maps, inside, finer)

    def cut(self, image: UInt8[np.ndarray, "H W 3"]) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Return the pinhole images of an image; black where the camera sees nothing."""
        if not self.maps:
            return [image]
        padded = _padded(image, self.source)
        faces = [self._remapped(padded, at, cv2.INTER_CUBIC) for at in self.maps]
        return [
            np.where(seen[..., None], face, 0).astype(np.uint8) for face, seen in zip(faces, self.covered, strict=True)
        ]

    def cut_mask(self, mask: Bool[Tensor, "H W"] | None) -> list[Bool[np.ndarray, "h w"]]:
        """Return which pixels of the pinhole images show nothing but pixels of a mask; None stands for all pixels."""
        if not self.maps:
            size = self.source.height, self.source.width
            return [np.ones(size, bool) if mask is None else mask.numpy()]
        if mask is None:
            return list(self.covered)
        padded = _padded(np.repeat(mask.numpy()[..., None].astype(np.uint8) * 255, 3, -1), self.source)
        faces = [self._remapped(padded, at, cv2.INTER_LINEAR)[..., 0] == 255 for at in self.maps]
        return [face & seen for face, seen in zip(faces, self.covered, strict=True)]

    def _remapped(self, padded: UInt8[np.ndarray, "H W 3"], at: Float32[np.ndarray, "h w 2"], how: int) -> np.ndarray:
        return _shrunk(cv2.remap(padded, at[..., 0], at[..., 1], how, borderMode=cv2.BORDER_REPLICATE), self.finer)


def check_faces(faces: int, fov_deg: float, size: int | None) -> None:
    """Refuse what `Views.of` cannot make faces of.

    Raises:
        InputError: An argument is out of range.
    """
    if faces not in (4, 6):
        raise InputError(f"faces: expected 4 or 6, got {faces!r}.")
    check_finite_number("fov", fov_deg, above=90.0 - 1e-9, at_most=MAX_FOV_DEG)
    if size is not None and not (type(size) is int and 8 <= size <= MAX_SIZE):
        raise InputError(f"size: expected an integer from 8 to {MAX_SIZE}, got {size!r}.")


def _look_up(
    T_view_cam: Float64[Tensor, "4 4"], fine: Pinhole, camera: Equirectangular
) -> tuple[Float32[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]:
    """Return where a face's pixels lie in the padded panorama, centres at integers, and which it covers."""
    uv, seen = camera.project(fine.ray_grid(dtype=torch.float64) @ T_view_cam[:3, :3])
    if camera.wraps:
        seen = torch.ones_like(seen)  # the vertical axis has no longitude, but a pixel
    return (uv - 0.5 + MARGIN).float().numpy(), seen.numpy()


def _padded(image: UInt8[np.ndarray, "H W 3"], camera: Camera) -> UInt8[np.ndarray, "Hp Wp 3"]:
    channels = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
    return np.ascontiguousarray(pad_image(channels, camera, MARGIN).numpy().transpose(1, 2, 0))


def _shrunk(image: np.ndarray, times: int) -> np.ndarray:
    height, width = image.shape[:2]
    if times == 1:
        return image
    return cv2.resize(image, (width // times, height // times), interpolation=cv2.INTER_AREA)
