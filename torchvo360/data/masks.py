"""Which pixels may be used: mask images and named sectors of the sphere.

Longitude and latitude are the camera's own, in degrees: longitude 0 in the middle of the image and positive to the
right, latitude 0 on the horizon and positive upwards.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from torchvo360.cameras import Camera, Equirectangular
from torchvo360.checks import InputError

LEAST_SHARE = 0.01
"""Share of the image's solid angle that a mask must leave: 1 % of the sphere is a cone of 23 degrees across."""

SECTORS = {"below": 1, "above": 1, "box": 4}
"""Names of the sectors and how many angles they take."""

EXPECTED = "expected an image file or below:LAT, above:LAT or box:LON0:LAT0:LON1:LAT1 in degrees"


def parse_mask(spec: str | Sequence[str], camera: Camera) -> Bool[Tensor, "H W"]:
    """Return which pixels may be used.

    Args:
        spec: One item or several, all of which a pixel must pass: an image file of the camera's size (a grey value
            above 127 means use); `below:LAT` and `above:LAT`, which take away what lies below and above a latitude;
            `box:LON0:LAT0:LON1:LAT1`, which takes away a box going east from LON0 to LON1 (across the seam when
            LON0 > LON1) and up from LAT0 to LAT1. Angles are in degrees.
        camera: The camera of the images; sectors need an equirectangular one.

    Raises:
        InputError: An item is not understood, its file is unreadable or of another size, or less than 1 % is left.
    """
    items = [spec] if isinstance(spec, str) else list(spec)
    use = torch.ones(camera.height, camera.width, dtype=torch.bool)
    for item in items:
        use &= _sector(item, camera) if item.partition(":")[0] in SECTORS else _image(item, camera)
    area = camera.solid_angle(camera.pixel_grid(dtype=torch.float64))
    left = float(area[use].sum() / area.sum())
    if left < LEAST_SHARE:
        raise InputError(
            f"mask: expected at least {LEAST_SHARE:.0%} of the image to be left, got {left:.2%} from {spec}."
        )
    return use


def _image(path: str, camera: Camera) -> Bool[Tensor, "H W"]:
    file = Path(path).expanduser()
    if not file.is_file():
        raise InputError(f"mask: {EXPECTED}, got {path!r}, which does not exist.")
    try:
        grey = cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error):  # not permitted, or empty
        grey = None
    if grey is None:
        raise InputError(f"mask: expected an image file, got {path}, which cannot be read as one.")
    height, width = grey.shape
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"mask: expected the frames' size {camera.width} x {camera.height}, got {width} x {height} in {path}."
        )
    return torch.from_numpy(grey > 127)


def _sector(item: str, camera: Camera) -> Bool[Tensor, "H W"]:
    if not isinstance(camera, Equirectangular):
        raise InputError(f"mask: expected an image file for a {type(camera).__name__} camera, got the sector {item!r}.")
    name, *words = item.split(":")
    angles = [_angle(word, item) for word in words]
    if len(angles) != SECTORS[name]:
        raise InputError(f"mask: {EXPECTED}, got {item!r}.")
    x, y, z = camera.ray_grid(dtype=torch.float64).unbind(-1)
    lat = torch.rad2deg(torch.asin(-y))
    if name == "below":
        return lat >= _within(angles[0], 90, item)
    if name == "above":
        return lat <= _within(angles[0], 90, item)
    lon = torch.rad2deg(torch.atan2(x, z))
    lon0, lat0, lon1, lat1 = (_within(angle, limit, item) for angle, limit in zip(angles, (180, 90) * 2, strict=True))
    if lat0 >= lat1:
        raise InputError(f"mask: expected LAT0 below LAT1 in box:LON0:LAT0:LON1:LAT1, got {item!r}.")
    inside_lon = (lon >= lon0) & (lon <= lon1) if lon0 <= lon1 else (lon >= lon0) | (lon <= lon1)
    return ~(inside_lon & (lat >= lat0) & (lat <= lat1))


def _angle(word: str, item: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise InputError(f"mask: {EXPECTED}, got {item!r}.") from None


def _within(angle: float, limit: int, item: str) -> float:
    if not (math.isfinite(angle) and abs(angle) <= limit):
        raise InputError(f"mask: expected an angle between -{limit} and {limit} degrees, got {angle:g} in {item!r}.")
    return angle
