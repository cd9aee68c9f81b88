"""A rig: several central cameras fixed to one body, that take their images at the same time."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.cameras.base import Camera
from torchvo360.checks import InputError, check_pose, check_shape
from torchvo360.lie import se3_inverse

MIN_BASELINE = 1e-6
"""Centres nearer to each other than this are one centre, metres: no range follows from them."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras and where they are on the body; the first one's poses are the trajectory's.

    Nothing forbids two cameras with one centre, such as pinholes that look in different directions; `baseline` refuses
    them.
    """

    cameras: tuple[Camera, ...]
    T_body_cam: Float64[Tensor, "n 4 4"]
    """Pose of each camera on the body, metres."""

    def __post_init__(self) -> None:
        if not (isinstance(self.cameras, tuple) and all(isinstance(camera, Camera) for camera in self.cameras)):
            raise InputError(f"cameras: expected a tuple of cameras, got {self.cameras!r}.")
        if len(self.cameras) < 2:
            raise InputError(f"cameras: expected at least two, got {len(self.cameras)}.")
        check_shape("T_body_cam", self.T_body_cam, f"{len(self.cameras)} 4 4")
        if self.T_body_cam.dtype != torch.float64:
            raise InputError(f"T_body_cam: expected float64, got {self.T_body_cam.dtype}.")
        check_pose("T_body_cam", self.T_body_cam)

    def __len__(self) -> int:
        return len(self.cameras)

    def T_other_first(self, other: int) -> Float64[Tensor, "4 4"]:
        """Return the pose that maps points of the first camera into another: T_other_body @ T_body_first.

        Args:
            other: Which camera, from 1 on.

        Raises:
            InputError: The rig has no such other camera.
        """
        self._check(other)
        return se3_inverse(self.T_body_cam[other]) @ self.T_body_cam[0]

    def baseline(self, other: int) -> float:
        """Return the distance between the centres of the first camera and another, metres.

        Args:
            other: Which camera, from 1 on.

        Raises:
            InputError: The rig has no such other camera, or its centre is the first one's.
        """
        self._check(other)
        metres = float(torch.linalg.vector_norm(self.T_body_cam[other, :3, 3] - self.T_body_cam[0, :3, 3]))
        if metres < MIN_BASELINE:
            raise InputError(f"T_body_cam: expected camera {other} apart from the first, got {metres:g} m apart.")
        return metres

    def resized(self, sizes: Sequence[tuple[int, int]]) -> "Rig":
        """Return the rig for images resampled to other sizes, (width, height) of each camera, such as a pyramid level.

        Raises:
            InputError: There is not one size for each camera.
        """
        if len(sizes) != len(self):
            raise InputError(f"sizes: expected one for each of the {len(self)} cameras, got {len(sizes)}.")
        cameras = (camera.resized(*size) for camera, size in zip(self.cameras, sizes, strict=True))
        return Rig(tuple(cameras), self.T_body_cam)

    def _check(self, other: int) -> None:
        if not 1 <= other < len(self):
            raise InputError(f"other: expected a camera from 1 to {len(self) - 1}, got {other}.")
