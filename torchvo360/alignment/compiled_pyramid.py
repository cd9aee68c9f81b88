"""The levels of pairs in a few compiled passes: what `pyramid.build_levels` builds, where no derivative is asked."""

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.alignment.config import AlignConfig
from torchvo360.alignment.inputs import MAX_RHO, Inputs
from torchvo360.alignment.pyramid import Level, confidence_of, eroded, own_rays, rays_of
from torchvo360.backends import use_numba
from torchvo360.backends.numba import kernel
from torchvo360.backends.numba.arrays import plain
from torchvo360.cameras import Camera
from torchvo360.image import blur_radius, level_camera
from torchvo360.residuals.direct import Reference, Target

KEPT = 2**20
"""Pixels of the largest camera whose rays are kept for the next call, 16 MB of them."""

NO_VALUES, NO_MASK = np.empty(0, np.float32), np.empty(0, np.bool_)
"""Stand-ins for what is not there."""


@dataclass(frozen=True)
class Grids:
    """What a camera's levels have in common, whatever they show."""

    cameras: list[Camera]
    rays: list[Float[Tensor, "1 3 N"]]
    areas: np.ndarray
    """Solid angles of each level's pixels relative to their mean, one level after the other, flat."""
    sizes: np.ndarray
    """(h, w) of each level."""


class Stack:
    """Planes of all levels in one buffer, one level after the other."""

    def __init__(self, planes: int, sizes: np.ndarray) -> None:
        """Take the memory for so many planes at each level's size."""
        shapes = [(planes, h, w) for h, w in sizes.tolist()]
        counts = [math.prod(shape) for shape in shapes]
        whole = torch.empty(sum(counts))
        self.planes = planes
        self.flat = whole.numpy()
        self.levels = [part.view(shape) for part, shape in zip(whole.split(counts), shapes, strict=True)]
        """[planes, h, w] each."""


def serves(inputs: Inputs, camera: Camera, config: AlignConfig) -> bool:
    """Return whether `build_levels` takes these: one float32 map each on the CPU, which is smoothed and halved here."""
    maps = [inputs.ref[0], inputs.tgt[0], inputs.rho, inputs.variance, inputs.intrinsics]
    maps += [*(inputs.weight_ref or []), *(inputs.weight_tgt or [])]
    return (
        use_numba(*maps)
        and not inputs.is_pyramid
        and inputs.rho.dtype == torch.float32
        and inputs.rho.numel() > 0
        and blur_radius(config.blur_px) < min(camera.height, camera.width)
    )


def build_levels(inputs: Inputs, camera: Camera, config: AlignConfig) -> list[Level]:
    """Build every level's points and target, the finest first."""
    B, C = inputs.ref[0].shape[:2]
    grids, planes = _grids(camera, config.level_count(camera)), kernel("planes")
    doubt = confidence_of(inputs, 0, camera, config.blur_px, branches=True)
    weight = None if inputs.weight_ref is None else inputs.weight_ref[0]

    extras = [extra for extra in (doubt, weight) if extra is not None]
    images = Stack(2 * B * C + B * len(extras), grids.sizes)
    finest = images.levels[0]
    _smooth(inputs.ref[0], camera, config.blur_px, finest[: B * C])
    _smooth(inputs.tgt[0], camera, config.blur_px, finest[B * C : 2 * B * C])
    for number, extra in enumerate(extras):
        finest[2 * B * C + B * number :][:B] = extra
    planes.shrink_levels(images.flat, images.planes, grids.sizes)

    def padded(first: int, count: int) -> Stack:
        out = Stack(count, grids.sizes + 2)
        planes.pad_levels(images.flat, first, count, images.planes, grids.sizes, camera.wraps, out.flat)
        return out

    targets = padded(B * C, B * C)
    doubts = None if doubt is None else padded(2 * B * C, B)
    saturation = config.saturation if C == 1 else None
    ranges = _ranges(inputs, camera, config, grids, saturation)
    levels = []
    for number, at in enumerate(grids.cameras):
        image, (*values, weights) = images.levels[number], ranges.levels[number].view(-1, B, at.height * at.width)
        if weight is not None:
            weights = weights * image[-B:].view(B, -1)
        ray, k = grids.rays[number], None
        if inputs.intrinsics is not None:
            ray, k = own_rays(inputs.intrinsics, at, camera, torch.float32)
        reference = Reference(ray, values[0], image[: B * C].view(B, C, -1), weights, *values[1:])
        confidences = None if doubts is None else doubts.levels[number][:, None]
        target = targets.levels[number].view(B, C, at.height + 2, at.width + 2)
        levels.append(Level(reference, Target(at, target, confidences, saturation, k)))
    return levels


def _ranges(inputs: Inputs, camera: Camera, config: AlignConfig, grids: Grids, saturation: float | None) -> Stack:
    """Return inverse ranges, variances where there are some, and weights: B planes of each."""
    B, kinds = len(inputs.rho), 1 + (inputs.variance is not None)
    allowed = inputs.mask
    if inputs.ref_finite[0] is not None:
        sound = eroded(inputs.ref_finite[0], camera, config.blur_px, branches=True)
        allowed = sound if allowed is None else allowed & sound
    out = Stack((kinds + 1) * B, grids.sizes)
    kernel("ranges").open_ranges(
        _flat(inputs.rho),
        NO_VALUES if inputs.variance is None else _flat(inputs.variance),
        NO_MASK if allowed is None else _flat(allowed),
        _flat(inputs.usable),
        NO_VALUES if saturation is None else _flat(inputs.ref[0]),
        np.array([MAX_RHO, MAX_RHO**2, saturation or math.inf], np.float32),
        out.flat,
    )
    kernel("planes").shrink_levels(out.flat, out.planes, grids.sizes)
    kernel("ranges").close_ranges(out.flat, kinds, B, grids.sizes, grids.areas)
    return out


def _smooth(maps: Float[Tensor, "B C H W"], camera: Camera, sigma_px: float, out: Float[Tensor, "BC H W"]) -> None:
    radius = blur_radius(sigma_px)
    if radius == 0:
        out.copy_(maps.view(out.shape))
        return
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma_px) ** 2)
    taps = (taps / taps.sum()).astype(np.float32)
    kernel("planes").blur_planes(_flat(maps), tuple(out.shape), taps, camera.wraps, _flat(out))


def _grids(camera: Camera, levels: int) -> Grids:
    small = camera.width * camera.height <= KEPT
    return (_make_grids if small else _make_grids.__wrapped__)(camera, levels)


@functools.lru_cache(maxsize=8)
def _make_grids(camera: Camera, levels: int) -> Grids:
    cameras = [level_camera(camera, level) for level in range(levels)]
    with torch.inference_mode(False):  # what is kept serves calls outside of it, too
        areas = [at.solid_angle(at.pixel_grid()) for at in cameras]
        rays = [rays_of(at.ray_grid()[None]) for at in cameras]
    return Grids(
        cameras,
        rays,
        torch.cat([(area / area.mean()).flatten() for area in areas]).numpy(),
        np.array([(at.height, at.width) for at in cameras]),
    )


def _flat(value: Tensor) -> np.ndarray:
    return plain(value).reshape(-1)
