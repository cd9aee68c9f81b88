"""From images, ranges and weights to the points and targets of every pyramid level."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from torchvo360.alignment.config import AlignConfig
from torchvo360.alignment.inputs import Inputs
from torchvo360.cameras import Camera
from torchvo360.image import blur, blur_radius, level_camera, masked_pyramid, resample
from torchvo360.residuals.direct import Reference, Target, make_target


@dataclass(frozen=True)
class Level:
    """One resolution of a batch of pairs."""

    reference: Reference
    target: Target


@dataclass(frozen=True)
class _Maps:
    """What a level is made of, before it is laid out for the kernel."""

    camera: Camera
    ref: Tensor
    tgt: Tensor
    rho: Tensor
    variance: Tensor | None
    known: Tensor
    weight: Tensor | None
    confidence: Tensor | None


def build_levels(inputs: Inputs, camera: Camera, config: AlignConfig) -> list[Level]:
    """Build every level's points and target, the finest first.

    Where not all steps are to be differentiated, the levels beyond `config.finest` carry no gradient.
    """
    branches = not config.solver.fixed_steps
    if inputs.is_pyramid:
        maps = _given_levels(inputs, camera, branches=branches)
    else:
        maps = _own_levels(inputs, camera, config, branches=branches)
    saturation = config.saturation if inputs.ref[0].shape[1] == 1 and not inputs.is_pyramid else None
    finest = 0 if inputs.is_pyramid else config.finest
    levels = []
    for number, each in enumerate(maps):
        with torch.set_grad_enabled(torch.is_grad_enabled() and (config.backward == "unroll" or number <= finest)):
            levels.append(_laid_out(each, inputs.intrinsics, camera, saturation))
    return levels


def _own_levels(inputs: Inputs, camera: Camera, config: AlignConfig, *, branches: bool) -> list[_Maps]:
    """Smooth and halve the one map that is given."""
    ref, tgt = inputs.ref[0], inputs.tgt[0]
    rho, variance, known = inputs.ranges()
    if inputs.ref_finite[0] is not None:
        known = known & eroded(inputs.ref_finite[0], camera, config.blur_px, branches=branches)
    if config.saturation is not None and ref.shape[1] == 1:
        known = known & (ref[:, 0] < config.saturation)
    confidence = confidence_of(inputs, 0, camera, config.blur_px, branches=branches)
    weight = None if inputs.weight_ref is None else inputs.weight_ref[0]
    ref, tgt = blur(ref, camera, config.blur_px), blur(tgt, camera, config.blur_px)
    cameras = [level_camera(camera, level) for level in range(config.level_count(camera))]
    ranges = _range_levels(rho, variance, known, cameras)
    levels = [_Maps(camera, ref, tgt, *ranges[0], weight, confidence)]
    for at, each in zip(cameras[1:], ranges[1:], strict=True):
        ref, tgt = resample(ref, at), resample(tgt, at)
        confidence, weight = (None if x is None else resample(x, at) for x in (confidence, weight))
        levels.append(_Maps(at, ref, tgt, *each, weight, confidence))
    return levels


def _given_levels(inputs: Inputs, camera: Camera, *, branches: bool) -> list[_Maps]:
    """Take a pyramid as it is; only the ranges are brought to its sizes."""
    cameras = [camera.resized(ref.shape[-1], ref.shape[-2]) for ref in inputs.ref]
    ranges = _range_levels(*inputs.ranges(), cameras)
    levels = []
    for number, (ref, tgt, at) in enumerate(zip(inputs.ref, inputs.tgt, cameras, strict=True)):
        rho, variance, known = ranges[number]
        confidence = confidence_of(inputs, number, at, 0.0, branches=branches)
        weight = None if inputs.weight_ref is None else inputs.weight_ref[number]
        finite = inputs.ref_finite[number]
        known = known if finite is None else known & finite
        levels.append(_Maps(at, ref, tgt, rho, variance, known, weight, confidence))
    return levels


def _range_levels(
    rho: Tensor, variance: Tensor | None, known: Bool[Tensor, "B H W"], cameras: list[Camera]
) -> list[tuple[Tensor, Tensor | None, Tensor]]:
    """Return inverse ranges, their variances and where they are known, of every level.

    Errors of neighbouring ranges go together: their mean is no surer than they are.
    """
    means = masked_pyramid(rho, known, cameras)
    if variance is None:
        return [(mean, None, certain) for mean, certain in means]
    spreads = masked_pyramid(variance, known, cameras)
    return [(mean, spread, certain) for (mean, certain), (spread, _) in zip(means, spreads, strict=True)]


def _laid_out(maps: _Maps, intrinsics: Tensor | None, whole: Camera, saturation: float | None) -> Level:
    camera, dtype, device = maps.camera, maps.ref.dtype, maps.ref.device
    area = camera.solid_angle(camera.pixel_grid(dtype=dtype, device=device))
    each = maps.known * (area / area.mean())
    if maps.weight is not None:
        each = each * maps.weight
    if intrinsics is None:
        ray, k = rays_of(camera.ray_grid(dtype=dtype, device=device)[None]), None
    else:
        ray, k = own_rays(intrinsics, camera, whole, dtype)
    reference = Reference(
        ray=ray,
        rho=maps.rho.flatten(1).contiguous(),
        value=maps.ref.flatten(2).contiguous(),
        weight=each.flatten(1).contiguous(),
        variance=None if maps.variance is None else maps.variance.flatten(1).contiguous(),
    )
    return Level(reference, make_target(maps.tgt, camera, maps.confidence, saturation, k))


def rays_of(grid: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B 3 N"]:
    """Return rays of pixels as the kernel takes them."""
    return grid.permute(0, 3, 1, 2).flatten(2).contiguous()


def own_rays(
    intrinsics: Float64[Tensor, "B 4"], camera: Camera, whole: Camera, dtype: torch.dtype
) -> tuple[Float[Tensor, "B 3 N"], Float[Tensor, "B 4"]]:
    """Return the rays of a level's pixels by intrinsics in pixels of the whole image, and those of the level."""
    k = intrinsics * intrinsics.new_tensor([camera.width / whole.width, camera.height / whole.height] * 2)
    fx, fy, cx, cy = k[:, :, None, None].unbind(1)
    ray = camera.ray(camera.pixel_grid(dtype=torch.float64, device=k.device), (fx, fy, cx, cy)).to(dtype)
    return rays_of(ray), k.to(dtype)


def confidence_of(inputs: Inputs, number: int, camera: Camera, blur_px: float, *, branches: bool) -> Tensor | None:
    """Return the weight of each pixel of the target; None where all count fully."""
    weight = None if inputs.weight_tgt is None else inputs.weight_tgt[number]
    finite = inputs.tgt_finite[number]
    if finite is None or (branches and bool(finite.all())):
        return weight
    usable = eroded(finite, camera, blur_px, branches=branches).to(inputs.tgt[number].dtype)
    return usable if weight is None else usable * weight


def eroded(usable: Bool[Tensor, "B H W"], camera: Camera, blur_px: float, *, branches: bool) -> Bool[Tensor, "B H W"]:
    """Drop the pixels near unusable ones, whose values smoothing by `blur_px` and interpolation would mix in."""
    if branches and bool(usable.all()):
        return usable
    reach = 1 + blur_radius(blur_px)
    spoiled = blur((~usable).to(torch.float32), camera, reach / 3) > 0
    return ~spoiled
