"""What is kept of a keyframe to close loops with: its points, and its coarse levels in 8 bits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_pose, check_shape
from torchvo360.image import blur, pad_image
from torchvo360.residuals.direct import Reference, Target, look_up_value

FINEST_PIXELS = 256 * 128
"""Levels of more pixels than this are not kept: at 256 x 128 a keyframe costs 43 kB of images, at twice that 172."""
MAX_POINTS = 3000
"""Points kept of a keyframe, 60 kB."""

MAX_RELATIVE_VARIANCE = 0.25
"""Points with a larger V / rho^2 are left out: the logarithm of a range that uncertain says nothing."""


@dataclass(frozen=True)
class LoopFrame:
    """A keyframe as loop closing sees it: about 100 kB."""

    T_world_cam: Float64[Tensor, "4 4"]
    cameras: tuple[Camera, ...]
    """Of each level, the finest first."""
    images: tuple[UInt8[Tensor, "H W"], ...]
    """Smoothed grey levels, 255 standing for 1."""
    known: tuple[Bool[Tensor, "H W"] | None, ...]
    """Pixels that are not masked; None where all count. Frames of one camera may share them."""
    saturation: float | None
    """Values at or above this are clipped."""
    ray: Float[Tensor, "3 N"]
    """Unit rays of the points."""
    rho: Float[Tensor, "N"]
    """Inverse distances, positive, 1/m in this frame's own scale."""
    variance: Float[Tensor, "N"]
    """Of rho."""

    @property
    def bytes(self) -> int:
        """Memory of images and points; masks, which frames share, are not counted."""
        tensors = (*self.images, self.ray, self.rho, self.variance)
        return sum(tensor.numel() * tensor.element_size() for tensor in tensors)

    def target(self, level: int, blur_px: float = 0.0) -> Target:
        """Return a level ready for look-up, 0 being the finest kept.

        Args:
            level: Its number.
            blur_px: Further smoothing, in pixels of the level.
        """
        camera, known = self.cameras[level], self.known[level]
        image = blur(self.images[level].to(self.ray.dtype) / 255, camera, blur_px)
        confidence = None
        if known is not None:
            confidence = pad_image(known.to(image)[None, None], camera, 1).contiguous()
        padded = pad_image(image[None, None], camera, 1).contiguous()
        return Target(camera, padded, confidence, self.saturation if blur_px == 0 else None)

    def recalibrated(self, cameras: tuple[Camera, ...]) -> LoopFrame:
        """Return the frame with other intrinsics: its points keep their pixels and ranges, and their rays turn.

        Args:
            cameras: Of each level, of the same sizes.
        """
        if cameras == self.cameras:
            return self
        uv, _ = self.cameras[0].project(self.ray.T)
        ray = cameras[0].ray(uv).T
        return replace(self, cameras=cameras, ray=(ray / torch.linalg.vector_norm(ray, dim=0)).contiguous())

    def points(self, target: Target, most: int) -> Reference:
        """Return at most `most` of the points, evenly thinned, with their values in this frame's own level."""
        index = thinned(self.rho.numel(), most, self.rho.device)
        ray = self.ray[:, index]
        value = look_up_value(target, ray)
        return Reference(
            ray[None],
            self.rho[None, index],
            value[None, None],
            torch.ones_like(value)[None],
            self.variance[None, index],
        )


def thinned(available: int, most: int, device: torch.device) -> Tensor:
    """Return the numbers of at most `most` of the available, in even steps."""
    if available <= most:
        return torch.arange(available, device=device)
    return torch.arange(most, device=device) * available // most


def make_loop_frame(
    T_world_cam: Float64[Tensor, "4 4"],
    targets: Sequence[Target],
    ray: Float[Tensor, "3 N"],
    rho: Float[Tensor, "N"],
    variance: Float[Tensor, "N"],
    *,
    max_points: int = MAX_POINTS,
) -> LoopFrame:
    """Keep what loop closing needs of a keyframe.

    Args:
        T_world_cam: Its pose.
        targets: Its levels, the finest first (batch 1, one channel); those that are too fine are left out.
        ray: Rays of its trusted points, of any length, in an order that keeps even thinning spread over the image.
        rho: Inverse distances, 1/m; what is not finite and positive, or too uncertain, is left out.
        variance: Of rho, 1/m^2.
        max_points: Most points kept.

    Raises:
        ShapeError: The points' shapes do not match.
        InputError: The pose is not rigid, or no level is small enough.
    """
    check_pose("T_world_cam", T_world_cam)
    check_shape("ray", ray, "3 N")
    for name, value in (("rho", rho), ("variance", variance)):
        check_shape(name, value, f"{ray.shape[1]}")
    kept = [target for target in targets if target.camera.width * target.camera.height <= FINEST_PIXELS]
    if not kept:
        raise InputError(f"targets: expected a level of at most {FINEST_PIXELS} pixels, got none.")
    length = torch.linalg.vector_norm(ray, dim=0)
    usable = torch.isfinite(rho) & (rho > 0) & torch.isfinite(variance) & (variance >= 0)
    usable &= variance <= MAX_RELATIVE_VARIANCE * rho.square()
    usable = (usable & torch.isfinite(length) & (length > 0)).nonzero()[:, 0]
    index = usable[thinned(usable.numel(), max_points, usable.device)]
    images, known = [], []
    for target in kept:
        inside = target.padded[0, 0, 1:-1, 1:-1]
        images.append((inside.clamp(0, 1) * 255).round().to(torch.uint8))
        confidence = target.confidence
        known.append(None if confidence is None else confidence[0, 0, 1:-1, 1:-1] > 0.99)
    return LoopFrame(
        T_world_cam.double(),
        tuple(target.camera for target in kept),
        tuple(images),
        tuple(known),
        kept[0].saturation,
        (ray[:, index] / length[index]).contiguous(),
        rho[index].clone(),
        variance[index].clone(),
    )
