"""What a range network is held to: true inverse ranges, or neighbouring views that must look alike through its own.

All means are over the sphere: a pixel counts by its solid angle.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.image import gradient, pad_image, sample

FAR_RHO = 0.01
"""Inverse range, 1/m, below which differences are none: the sky is as good as 100 m away."""
SSIM_SHARE = 0.85
"""Share of structure in the dissimilarity; the rest is intensity (Godard et al., 2019)."""
SSIM_FLOOR = (0.01**2, 0.03**2)
"""Constants of SSIM for intensities in [0, 1] (Wang et al., 2004)."""
EDGE_SLOPE = 10.0
"""How fast an intensity edge lifts the price of a range edge."""


def sphere_mean(
    value: Float[Tensor, "B H W"], camera: Camera, known: Bool[Tensor, "B H W"] | None = None
) -> Float[Tensor, "B"]:
    """Return means over each sphere, or over its known pixels; 0 where there are none."""
    area = camera.solid_angle(camera.pixel_grid(dtype=value.dtype, device=value.device)).expand_as(value)
    weight = area if known is None else area * known
    return (torch.where(weight > 0, value, 0.0) * weight).sum((1, 2)) / weight.sum((1, 2)).clamp_min(1e-12)


def log_error(
    log_rho: Float[Tensor, "B H W"], rho_true: Float[Tensor, "B H W"]
) -> tuple[Float[Tensor, "B H W"], Bool[Tensor, "B H W"]]:
    """Return the errors of log rho, and where there is a range: not in the sky, which counts as `FAR_RHO`."""
    return log_rho - rho_true.clamp_min(FAR_RHO).log(), rho_true > FAR_RHO


def laplace_loss(
    error: Float[Tensor, "B H W"], log_scale: Float[Tensor, "B H W"], camera: Camera
) -> Float[Tensor, "B"]:
    """Return the mean negative log-likelihood of errors under Laplace distributions, but for a constant."""
    return sphere_mean(error.abs() * torch.exp(-log_scale) + log_scale, camera)


def warped(
    tgt: Float[Tensor, "B C H W"], rho: Float[Tensor, "B H W"], T_tgt_ref: Float[Tensor, "B 4 4"], camera: Camera
) -> Float[Tensor, "B C H W"]:
    """Return the target as the reference sees it through its inverse ranges, 1/m; differentiable by all of them."""
    T = T_tgt_ref.to(rho.dtype)
    ray = camera.ray_grid(dtype=rho.dtype, device=rho.device).reshape(1, -1, 3)
    points = ray @ T[:, :3, :3].mT + rho.flatten(1)[..., None] * T[:, None, :3, 3]
    uv, _ = camera.project(points)
    return sample(tgt, uv, camera).view_as(tgt)


def dissimilarity(
    first: Float[Tensor, "B C H W"], second: Float[Tensor, "B C H W"], camera: Camera
) -> Float[Tensor, "B H W"]:
    """Return how unlike two images are at each pixel, 0 to 1: by structure in 3 x 3 windows, and by intensity."""

    def local(value: Tensor) -> Tensor:
        return F.avg_pool2d(pad_image(value, camera, 1), 3, 1)

    mean_1, mean_2 = local(first), local(second)
    spread_1, spread_2 = local(first.square()) - mean_1.square(), local(second.square()) - mean_2.square()
    common = local(first * second) - mean_1 * mean_2
    level, contrast = SSIM_FLOOR
    above = (2 * mean_1 * mean_2 + level) * (2 * common + contrast)
    below = (mean_1.square() + mean_2.square() + level) * (spread_1 + spread_2 + contrast)
    structure = ((1 - above / below) / 2).clamp(0, 1)
    return (SSIM_SHARE * structure + (1 - SSIM_SHARE) * (first - second).abs()).mean(1)


def roughness(log_rho: Float[Tensor, "B H W"], image: Float[Tensor, "B C H W"], camera: Camera) -> Float[Tensor, "B"]:
    """Return the mean slope of log rho, per pixel, where the image has no edge to excuse it."""
    slopes, edges = gradient(log_rho, camera), gradient(image.mean(1), camera)
    price = sum(slope.abs() * torch.exp(-EDGE_SLOPE * edge.abs()) for slope, edge in zip(slopes, edges, strict=True))
    assert isinstance(price, Tensor)
    return sphere_mean(price, camera)
