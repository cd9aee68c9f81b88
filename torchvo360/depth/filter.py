"""The inverse-range filter: each point's rho is a Gaussian, fused with every match (mathematics.md, section 5).

Inverse ranges are pooled by 1 / V: weights of rho^2 / V favour near points and shrink the scale fivefold over a minute
(measured on real video).
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_finite_number
from torchvo360.depth.epipolar import EpipolarMatch
from torchvo360.image import pad_image

LEAST_EXPONENT = -80.0
"""Of a weight that is none."""


@dataclass(kw_only=True)
class FilterConfig:
    """Settings of the inverse-range filter."""

    inflation: float = 1.01
    """Growth of the variance with each frame (S2, LSD-SLAM)."""
    gate_sigma: float = 3.0
    """A match farther away than this from the prediction is an outlier."""
    outlier_inflation: float = 1.5
    """Growth of the variance with an outlier."""
    variance_floor: float = 2e-3
    """Least relative variance V / rho^2 a point keeps when it is carried over to a frame found in its keyframe."""
    smoothing: float = 0.3
    """Share by which a point moves towards the mean of consistent neighbours at a start; 0 leaves it."""
    radius_px: int = 2
    """Neighbours are points within this many pixels in both directions."""
    max_score: float = 8.0
    min_score: float = -5.0
    """Bounds of the score: matches add 1, outliers take 1, failed searches a third; a point is used above 0."""

    def __post_init__(self) -> None:
        check_finite_number("inflation", self.inflation, above=0.999)
        check_finite_number("gate_sigma", self.gate_sigma, above=0)
        check_finite_number("outlier_inflation", self.outlier_inflation, above=0.999)
        check_finite_number("variance_floor", self.variance_floor, above=0)
        if not 0 <= self.smoothing <= 1:
            raise InputError(f"smoothing: expected a share between 0 and 1, got {self.smoothing}.")
        if not 1 <= self.radius_px <= 32:
            raise InputError(f"radius_px: expected 1 to 32, got {self.radius_px}.")
        check_finite_number("max_score", self.max_score, above=0)
        check_finite_number("min_score", self.min_score, at_most=0)


class InverseRange(NamedTuple):
    """Inverse ranges of N points with their variances, and a score that counts successes and outliers."""

    rho: Float[Tensor, "N"]
    variance: Float[Tensor, "N"]
    score: Float[Tensor, "N"]


def fuse(prior: InverseRange, match: EpipolarMatch, config: FilterConfig) -> InverseRange:
    """Return the inverse ranges after one frame's matches, by the Kalman update of a scalar.

    Args:
        prior: Before the frame.
        match: What the epipolar search found.
        config: Settings.
    """
    rho, variance, score = prior
    innovation = match.rho - rho
    total = variance + torch.where(match.found, match.variance, torch.ones_like(variance))
    consistent = match.found & (innovation.square() < config.gate_sigma**2 * total)
    outlier = match.found & ~consistent
    gain = variance / total
    # A point is never put behind infinity, nor nearer to the camera than ten times its present closeness at once.
    moved = torch.maximum(torch.minimum(rho + gain * innovation, 10 * rho), 0.02 * rho)
    shrunk = (1 - gain) * variance * config.inflation
    grown = variance * torch.where(outlier, config.outlier_inflation, config.inflation)
    change = consistent.to(rho.dtype) - outlier.to(rho.dtype)
    change = change - (match.searched & ~match.found).to(rho.dtype) / 3
    return InverseRange(
        torch.where(consistent, moved, rho),
        torch.where(consistent, shrunk, grown),
        (score + change).clamp(config.min_score, config.max_score),
    )


def guess_around(
    ray: Float[Tensor, "3 M"], known_ray: Float[Tensor, "3 N"], known_rho: Float[Tensor, "N"], spread_rad: float
) -> InverseRange:
    """Guess inverse ranges by those of the directions around, as loose priors: half their size, score 0.

    Args:
        ray: Unit rays of the points to guess.
        known_ray: Unit rays of at least one point that is known.
        known_rho: Their inverse ranges.
        spread_rad: Standard deviation of the Gaussian by which directions count; far from all it is their median.
    """
    # Numbers below the normal ones, which weigh nothing, are ten times slower to come by.
    weight = torch.exp(((ray.T @ known_ray - 1) / spread_rad**2).clamp_min(LEAST_EXPONENT))
    median = known_rho.median()
    rho = (weight @ known_rho + 0.02 * median) / (weight.sum(1) + 0.02)
    rho = torch.maximum(torch.minimum(rho, 8 * median), 0.05 * median)
    return InverseRange(rho, (0.5 * rho) ** 2, torch.zeros_like(rho))


def box_sums(grid: Float[Tensor, "C H W"], camera: Camera, radius: int) -> Float[Tensor, "C H W"]:
    """Return sums over squares of `2 radius + 1` pixels around every pixel, across the seam and the poles."""
    padded = pad_image(grid, camera, radius + 1)
    # Sums by differences of cumulative sums, in float64: the cost does not grow with the radius.
    total = padded.double().cumsum(-1).cumsum(-2)
    size = 2 * radius + 1
    H, W = grid.shape[-2:]
    return (
        total[..., size : size + H, size : size + W]
        - total[..., :H, size : size + W]
        - total[..., size : size + H, :W]
        + total[..., :H, :W]
    ).to(grid.dtype)


def scatter(camera: Camera, pixel: Int64[Tensor, "N"], values: Float[Tensor, "C N"]) -> Float[Tensor, "C H W"]:
    """Add values up on an image's pixels."""
    grid = values.new_zeros(values.shape[0], camera.height * camera.width)
    return grid.index_add(1, pixel, values).view(-1, camera.height, camera.width)


def smooth(
    points: InverseRange, pixel: Int64[Tensor, "N"], camera: Camera, usable: Bool[Tensor, "N"], config: FilterConfig
) -> InverseRange:
    """Draw points towards the mean of their consistent neighbours, and mark down those that contradict them.

    Args:
        points: Inverse ranges.
        pixel: Their flat pixels in the keyframe.
        camera: The keyframe's camera.
        usable: Points that speak; the others keep their values.
        config: Settings.
    """
    rho, variance, score = points
    weight = variance.clamp_min(1e-12).reciprocal() * usable
    sums = box_sums(
        scatter(camera, pixel, torch.stack([weight, weight * rho, weight * rho * rho])), camera, config.radius_px
    ).flatten(1)[:, pixel]
    around, mean = sums[0], sums[1] / sums[0].clamp_min(1e-12)
    spread = (sums[2] / sums[0].clamp_min(1e-12) - mean.square()).clamp_min(0.0).sqrt()
    away = (rho - mean).abs()
    sigma = variance.sqrt()
    agrees = usable & (around > 2 * weight) & (away < 2 * sigma) & (spread < 0.25 * mean)
    contradicts = usable & (around > 6 * weight) & (away > 0.5 * mean) & (spread < 0.2 * mean) & (sigma > 0.1 * rho)
    return InverseRange(
        torch.where(agrees, torch.lerp(rho, mean, config.smoothing), rho), variance, score - 0.5 * contradicts
    )
