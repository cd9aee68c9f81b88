"""A frame made ready: grey image, pyramid and padded targets; what is the same for all frames is made once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from torch import Tensor

from torchvo360.backends.numba.images import look_up_usable
from torchvo360.backends.numba.pictures import gradient_strength, padded_levels
from torchvo360.cameras import Camera, Rig
from torchvo360.image import level_camera, pad_image, resample
from torchvo360.residuals.direct import Target
from torchvo360.vo.sensor import Sensed, SensorConfig, read_depth


@dataclass(frozen=True)
class PyramidFrame:
    """One frame as tracking and mapping see it."""

    index: int
    t_ns: int
    grey: UInt8[np.ndarray, "H W"]
    """For corners."""
    colour: UInt8[np.ndarray, "H W 3"]
    """For the map's points."""
    targets: list[Target]
    """Smoothed grey levels in [0, 1], the finest first, padded for look-up; batch 1, one channel."""
    others: tuple[Target | None, ...] = ()
    """The finest levels of a rig's further cameras; None where one gave no image."""
    sensed: Sensed | None = None
    """What a depth sensor knows; None without one, and where it knows nothing."""

    def value(self, ray: Float[Tensor, "3 *points"]) -> Float[Tensor, "*points"]:
        """Return the finest level's intensities along rays; NaN where they are unseen, masked or clipped."""
        return look_up_usable(self.targets[0], ray)

    @property
    def has_ranges(self) -> bool:
        """Whether the frame tells ranges by itself: by a depth sensor, or by a rig's further cameras."""
        return self.sensed is not None or any(other is not None for other in self.others)

    @property
    def image(self) -> Float[Tensor, "H W"]:
        """The finest level without its padding."""
        return self.targets[0].padded[0, 0, 1:-1, 1:-1]


class FrameBuilder:
    """Builds frames of one camera, or of a rig: level cameras, masks and ray grids are made once.

    The mask is the first camera's; what a rig's further cameras see of the rig is left to the outlier tests.
    """

    def __init__(
        self,
        camera: Camera,
        levels: int,
        blur_px: float,
        mask: Bool[Tensor, "H W"] | None,
        saturation: float,
        device: torch.device | str = "cpu",
        rig: Rig | None = None,
        sensor: SensorConfig | None = None,
    ) -> None:
        self.rig, self._sensor = rig, SensorConfig() if sensor is None else sensor
        self.T_other_first: tuple[Float64[Tensor, "4 4"], ...] = ()
        if rig is not None:
            self.T_other_first = tuple(rig.T_other_first(other) for other in range(1, len(rig)))
        self.cameras = [level_camera(camera, level) for level in range(levels)]
        self.blur_px, self.saturation, self.device = blur_px, saturation, torch.device(device)
        self.mask = torch.ones(camera.height, camera.width, dtype=torch.bool) if mask is None else mask
        self.mask = self.mask.to(self.device)
        self._confidence = self._masked_levels() if mask is not None else [None] * levels
        self._rays = self.cameras[0].ray_grid(device=self.device)

    def _masked_levels(self) -> list[Tensor]:
        share = self.mask.to(torch.float32)
        levels = []
        for camera in self.cameras:
            share = resample(share, camera)
            levels.append(pad_image((share > 0.99).to(torch.float32)[None, None], camera, 1).contiguous())
        return levels

    def recalibrate(self, k: Float64[Tensor, "4"]) -> None:
        """Take other intrinsics (fx, fy, cx, cy) of the finest level for all frames from now on."""
        fx, fy, cx, cy = k.tolist()
        finest = self.cameras[0].recalibrated(fx, fy, cx, cy)
        self.cameras = [level_camera(finest, level) for level in range(len(self.cameras))]
        self._rays = finest.ray_grid(device=self.device)

    def recalibrated(self, frame: PyramidFrame) -> PyramidFrame:
        """Return a frame built before with the present intrinsics."""
        pairs = zip(frame.targets, self.cameras, strict=True)
        return replace(frame, targets=[replace(target, camera=camera) for target, camera in pairs])

    def build(
        self,
        colour: UInt8[np.ndarray, "H W 3"],
        index: int,
        t_ns: int,
        others: Sequence[UInt8[np.ndarray, "H W 3"] | None] = (),
        depth: Float32[np.ndarray, "H W"] | None = None,
    ) -> PyramidFrame:
        """Return the frame of a colour image, and of what a rig's further cameras and a depth sensor saw with it."""
        grey = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
        levels = padded_levels(grey, self.cameras, self.blur_px, self.device)
        targets = [
            Target(camera, padded, confidence, self.saturation)
            for camera, padded, confidence in zip(self.cameras, levels, self._confidence, strict=True)
        ]
        further = tuple(self._other(image, at) for at, image in enumerate(others, start=1))
        sensed = read_depth(depth, self.cameras[0], self._sensor, self.device)
        return PyramidFrame(index, t_ns, grey, colour, targets, further, sensed)

    def _other(self, colour: UInt8[np.ndarray, "H W 3"] | None, at: int) -> Target | None:
        if colour is None or self.rig is None:
            return None
        camera, grey = self.rig.cameras[at], cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
        (padded,) = padded_levels(grey, [camera], self.blur_px, self.device)
        return Target(camera, padded, saturation=self.saturation)

    def strength(self, frame: PyramidFrame) -> Float[Tensor, "H W"]:
        """Return the gradient magnitude of the finest level, intensity per pixel."""
        return gradient_strength(frame.targets[0], self._rays)

    def usable(self, frame: PyramidFrame) -> Bool[Tensor, "H W"]:
        """Return the pixels that may become points: unmasked and not clipped."""
        return self.mask & (frame.image < self.saturation)

    def rays(self, pixel: Tensor) -> Float[Tensor, "3 N"]:
        """Return unit rays of flat pixels of the finest level, so that rho is the inverse distance for every camera."""
        ray = self._rays.view(-1, 3)[pixel]
        return (ray / torch.linalg.vector_norm(ray, dim=-1, keepdim=True)).T.contiguous()

    def sensed(self, frame: PyramidFrame, pixel: Int64[Tensor, "N"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
        """Return what a depth sensor knows at flat pixels: inverse distances and variances, infinite where nothing."""
        if frame.sensed is None:
            none = torch.zeros(len(pixel), device=self.device)
            return none, torch.full_like(none, torch.inf)
        length = torch.linalg.vector_norm(self._rays.view(-1, 3)[pixel], dim=-1)
        rho, variance = (part.flatten()[pixel] for part in frame.sensed)
        return rho / length, variance / length.square()
