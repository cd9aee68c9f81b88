"""Depth images: what a sensor says of a frame's inverse ranges, and how well it knows them."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_finite_number
from torchvo360.data.frame import Frame
from torchvo360.image import pad_image


@dataclass(kw_only=True)
class SensorConfig:
    """Settings of a depth sensor's noise: the standard deviation of rho is hypot(relative * rho, constant)."""

    relative: float = 0.01
    """Share of the range: what calibration leaves, and noise that grows with the range."""
    constant: float = 1.5e-3
    """Of the inverse range, 1/m: a disparity's error is the same at all ranges. Structured light has 1.4 mm of noise at
    1 m, growing with the square of the range (Khoshelham and Elberink 2012, Sensors 12, eq. 11 and section 5)."""
    edge: float = 0.1
    """Spread of the inverse ranges of 3 x 3 pixels, relative to the middle one, from which it lies on an edge: ranges
    between the two sides belong to nothing."""

    def __post_init__(self) -> None:
        check_finite_number("relative", self.relative, above=-1e-12, at_most=1)
        check_finite_number("constant", self.constant, above=-1e-12)
        check_finite_number("edge", self.edge, above=0)
        if self.relative == 0 and self.constant == 0:
            raise InputError("relative, constant: expected one of them above 0, got 0 and 0.")


class Sensed(NamedTuple):
    """A depth image as the map uses it, in the camera's measure."""

    rho: Float[Tensor, "H W"]
    """Inverse range, 1/m; 0 where it is not known."""
    variance: Float[Tensor, "H W"]
    """Of rho; infinite where it is not known."""


def read_depth(
    depth: Float32[np.ndarray, "H W"] | None, camera: Camera, config: SensorConfig, device: torch.device
) -> Sensed | None:
    """Return inverse ranges and their variances, without those on edges; None where nothing is known.

    Args:
        depth: Ranges in the camera's measure, metres; 0, negative or not finite is unknown.
        camera: The camera of the image.
        config: Settings.
        device: Where the result is kept.
    """
    if depth is None:
        return None
    given = torch.from_numpy(np.ascontiguousarray(depth)).to(device)
    known = torch.isfinite(given) & (given > 0)
    rho = torch.where(known, given, 1.0).reciprocal()
    known = known & torch.isfinite(rho)
    rho = torch.where(known, rho, 0.0)
    # Neighbours that are not known contradict nothing: they are least in both maxima.
    sides = torch.stack([torch.where(known, rho, -torch.inf), torch.where(known, -rho, -torch.inf)])
    known = known & (_most_around(sides, camera).sum(0) <= config.edge * rho)
    if not bool(known.any()):
        return None
    variance = (config.relative * rho).square() + config.constant**2
    return Sensed(torch.where(known, rho, 0.0), torch.where(known, variance, torch.inf))


def _most_around(values: Float[Tensor, "K H W"], camera: Camera) -> Float[Tensor, "K H W"]:
    """Return the largest of each pixel's 3 x 3."""
    padded = pad_image(values, camera, 1)
    if values.device.type != "cpu":
        return F.max_pool2d(padded[None], 3, stride=1)[0]
    # Torch takes seventy times as long on one thread.
    square = np.ones((3, 3), np.uint8)
    return torch.from_numpy(np.stack([cv2.dilate(plane.numpy(), square)[1:-1, 1:-1] for plane in padded]))


def check_depth(frame: Frame, camera: Camera) -> None:
    """Refuse a depth image that is not one of the camera's.

    Raises:
        InputError: It is no NumPy array of float32, or of another size.
    """
    if frame.depth is None:
        return
    shape, kind = (camera.height, camera.width), getattr(frame.depth, "dtype", type(frame.depth).__name__)
    if kind != "float32" or frame.depth.shape != shape:
        got = f"{list(getattr(frame.depth, 'shape', []))} of {kind}"
        raise InputError(f"depth: expected metres of shape {list(shape)} of float32, got {got}.")
