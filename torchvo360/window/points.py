"""The window's points: each is hosted by one keyframe and seen through a pattern in all the others."""

from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torchvo360.residuals.direct import Target, look_up_gradient
from torchvo360.window.config import WindowConfig
from torchvo360.window.pattern import PATTERN, pattern_rays

LEAST_WEIGHT = 0.5
"""Share of its pattern that a point must keep, in its host and in a target."""
LEADING = ("ray", "uv")
"""Fields that have their components before the points."""


@dataclass
class WindowPoints:
    """Points of all keyframes of a window, in the order of their hosts."""

    host: Int64[Tensor, "N"]
    """Place of the host in the window."""
    pixel: Int64[Tensor, "N"]
    """Flat pixel in the host's finest level."""
    ray: Float[Tensor, "3 N P"]
    """Unit rays of the pattern in the host's camera."""
    uv: Float[Tensor, "2 N P"]
    """Their pixels, which stay when intrinsics are estimated, while the rays turn."""
    value: Float[Tensor, "N P"]
    """Intensities in the host; 0 where there is none."""
    weight: Float[Tensor, "N P"]
    """Of each pixel of the pattern; 0 where it is not to be used."""
    rho: Float[Tensor, "N"]
    """Inverse distance in the host, 1 / unit."""
    rho_prior: Float[Tensor, "N"]
    """What was known of rho before, and how well: `information` is 0 where nothing was."""
    information: Float[Tensor, "N"]
    """Weight of that prior in the energy: intensity^2 unit^2."""
    curvature: Float[Tensor, "N"]
    """Second derivative of the energy by rho at the last optimisation; 0 before the first."""
    inliers: Float[Tensor, "N"]
    """Number of keyframes that saw the point well at the last optimisation."""

    def __len__(self) -> int:
        return len(self.rho)

    def take(self, index: Tensor) -> Self:
        """Return some of the points."""
        parts = {part.name: getattr(self, part.name) for part in fields(self)}
        return replace(self, **{name: p[:, index] if name in LEADING else p[index] for name, p in parts.items()})

    def joined(self, other: Self) -> Self:
        """Return these points and others, in the order of their hosts."""
        parts = {}
        order = torch.cat([self.host, other.host]).argsort(stable=True)
        for part in fields(self):
            name, axis = part.name, int(part.name in LEADING)
            parts[name] = torch.cat([getattr(self, name), getattr(other, name)], axis).index_select(axis, order)
        return replace(self, **parts)


def make_points(
    target: Target,
    pixel: Int64[Tensor, "N"],
    ray: Float[Tensor, "3 N"],
    rho: Float[Tensor, "N"],
    config: WindowConfig,
    host: int = 0,
    information: Float[Tensor, "N"] | None = None,
) -> WindowPoints:
    """Make points of pixels of a keyframe; those of which too little of the pattern can be used weigh nothing.

    Args:
        target: The keyframe's finest level.
        pixel: Their flat pixels.
        ray: Their unit rays.
        rho: Inverse distances to start from.
        config: Settings.
        host: Place of the keyframe in the window.
        information: How well rho is known; not at all by default.
    """
    camera = target.camera
    rays = pattern_rays(ray, camera.pixel_angle, PATTERN if config.pattern == "dso" else ((0, 0),))
    value, slope2 = look_up_gradient(target, rays)
    c2 = config.gradient_scale**2
    known = torch.isfinite(value)
    weight = torch.where(known, c2 / (c2 + slope2), 0.0)
    if config.solid_angle:
        # As the cosine of the latitude: the solid angle of a panorama's pixel against that on the equator.
        weight = weight * (1 - ray[1].square()).clamp_min(0).sqrt()[:, None]
    x, y, z = rays
    zero = torch.zeros_like(rho)
    return WindowPoints(
        host=torch.full_like(pixel, host),
        pixel=pixel,
        ray=rays,
        uv=torch.stack(camera.pixel_of(x, y, z)),
        value=value.nan_to_num(nan=0.0),
        weight=weight * (known.to(rho.dtype).mean(1) > LEAST_WEIGHT)[:, None],
        rho=rho,
        rho_prior=rho.clone(),
        information=zero if information is None else information,
        curvature=zero.clone(),
        inliers=zero.clone(),
    )
