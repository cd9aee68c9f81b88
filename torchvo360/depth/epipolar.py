"""Search for every point's match along its epipolar great circle, all points at once.

The match of a reference ray r1 in the target lies on the great circle from R r1 (a point at infinity) to t (a point at
the camera), at the angle theta with tan(theta) = rho |t| sin(phi) / (1 + rho |t| cos(phi)), where phi is the angle
between the two ends (mathematics.md, section 5). The search runs in steps of one pixel of arc around the predicted
angle, compares five samples spaced along the curve, refines the best by a parabola, and says how sure the result is
(LSD-SLAM, Engel et al. 2013: geometric and photometric error of a disparity).

It is a compiled pass over the points where numba serves (`backends.numba`), and eager torch elsewhere.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.backends.numba.arrays import plain
from torchvo360.backends.numba.images import can_see, image_view, look_up_usable
from torchvo360.backends.numba.kernel import kernel
from torchvo360.checks import InputError, check_finite_number
from torchvo360.residuals.direct import Target

HALF_PATTERN = 2
"""Samples on each side of the centre: 5 in all (S2, section 4.1)."""


@dataclass(kw_only=True)
class EpipolarConfig:
    """Settings of the search along great circles."""

    max_half_width_px: int = 20
    """Points whose two-sigma interval is wider than this on either side of the prediction wait for less."""
    min_gradient: float = 5 / 255
    """Root mean square change of intensity per pixel along the curve below which a match says nothing."""
    min_sine: float = 0.1
    """Sine of the angle between ray and translation below which a point hardly moves."""
    max_ssd: float = 5 * (13 / 255) ** 2
    """Sum of the five squared differences above which nothing was found."""
    min_distinction: float = 2.0
    """The second best match, three steps away or more, must be this many times worse: else it is ambiguous."""
    noise: float = 4 / 255
    """Standard deviation of an intensity."""
    position_error_px: float = 0.22
    """Standard deviation of a match in pixels that no gradient takes away: interpolation, pose and calibration."""
    line_error_px: float = 0.2
    """Standard deviation of the curve's own position, which counts by the angle between gradient and curve."""

    def __post_init__(self) -> None:
        if not 3 <= self.max_half_width_px <= 256:
            raise InputError(f"max_half_width_px: expected 3 to 256, got {self.max_half_width_px}.")
        for name in ("min_gradient", "max_ssd", "noise", "position_error_px", "line_error_px"):
            check_finite_number(name, getattr(self, name), above=0)
        check_finite_number("min_sine", self.min_sine, above=0, at_most=1)
        check_finite_number("min_distinction", self.min_distinction, above=0)


class EpipolarMatch(NamedTuple):
    """What the search found for each point."""

    rho: Float[Tensor, "N"]
    """Inverse range in the reference, 1/m."""
    variance: Float[Tensor, "N"]
    """Of rho; infinite where nothing was found."""
    searched: Bool[Tensor, "N"]
    """Whether gradient, baseline and uncertainty made a search worth while."""
    found: Bool[Tensor, "N"]
    """Whether a clear match was found."""


class GreatCircles(NamedTuple):
    """The great circles of all points: `start cos(theta) + towards sin(theta)` for theta from 0 to phi."""

    start: Float[Tensor, "3 N"]
    towards: Float[Tensor, "3 N"]
    phi: Float[Tensor, "N"]
    sine: Float[Tensor, "N"]
    baseline: Float[Tensor, ""]

    def angle(self, rho: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
        """Return where points of these inverse distances lie on their circles."""
        along = rho * self.baseline
        return torch.atan2(along * self.sine, 1 + along * self.phi.cos())

    def rho(self, theta: Float[Tensor, "N *places"]) -> Float[Tensor, "N *places"]:
        """Return the inverse distances of places on the circles."""
        phi = self.phi.view(-1, *[1] * (theta.ndim - 1))
        return theta.sin() / (self.baseline * (phi - theta).clamp_min(1e-3).sin())

    def rho_by_angle(self, theta: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
        """Return d rho / d theta."""
        return self.sine / (self.baseline * (self.phi - theta).clamp_min(1e-3).sin() ** 2)

    def take(self, index: Tensor) -> "GreatCircles":
        """Return some of the circles."""
        return GreatCircles(
            self.start[:, index], self.towards[:, index], self.phi[index], self.sine[index], self.baseline
        )


def great_circles(ray: Float[Tensor, "3 N"], T_tgt_ref: Float[Tensor, "4 4"]) -> GreatCircles:
    """Return the great circles in a target image on which the points of a reference image may lie.

    Args:
        ray: The points' unit rays in the reference camera.
        T_tgt_ref: The known motion.
    """
    R, t = T_tgt_ref[:3, :3], T_tgt_ref[:3, 3]
    baseline = torch.linalg.vector_norm(t).clamp_min(1e-12)
    epipole = (t / baseline)[:, None]
    start = R @ ray
    cosine = (epipole * start).sum(0).clamp(-1, 1)
    across = epipole - cosine * start
    # Not vector_norm: over the leading axis it is ten times slower.
    sine = across.square().sum(0).sqrt()
    return GreatCircles(start, across / sine.clamp_min(1e-6), torch.atan2(sine, cosine), sine, baseline)


def search_great_circles(
    reference: Target,
    target: Target,
    ray: Float[Tensor, "3 N"],
    rho: Float[Tensor, "N"],
    variance: Float[Tensor, "N"],
    slope: Float[Tensor, "N"],
    T_tgt_ref: Float[Tensor, "4 4"],
    affine: Float[Tensor, "2"],
    config: EpipolarConfig,
) -> EpipolarMatch:
    """Match every point of a reference image in a target image along its great circle.

    Args:
        reference: The reference image, batch 1 and one channel.
        target: The target image, likewise.
        ray: The points' unit rays in the reference camera.
        rho: Their predicted inverse distances, 1/m.
        variance: Of the predictions.
        slope: Gradient magnitude at the points, intensity per pixel.
        T_tgt_ref: The known motion.
        affine: The known brightness change (a, b).
        config: Settings.
    """
    if can_see(reference, target, also=(ray, rho, variance, slope)):
        return _search_compiled(reference, target, (ray, rho, variance, slope), T_tgt_ref, affine, config)
    step = target.camera.pixel_angle
    T, affine = T_tgt_ref.to(ray), affine.to(ray)
    circles = great_circles(ray, T)
    samples = reference_samples(reference, ray, circles, T, step)
    samples = samples * affine[0].exp() + affine[1]
    slope2_along = samples.diff(dim=1).square().mean(1)

    sigma = variance.sqrt()
    nearest, farthest = circles.angle(rho + 2 * sigma), circles.angle((rho - 2 * sigma).clamp_min(0.0))
    middle, half_width = (nearest + farthest) / 2, ((nearest - farthest) / (2 * step)).clamp_min(1.5)
    match_sigma = circles.rho_by_angle(circles.angle(rho)) * step * 0.3
    searched = (
        (slope2_along > config.min_gradient**2)
        & (circles.sine > config.min_sine)
        & (match_sigma < 2 * sigma)
        & (half_width <= config.max_half_width_px)
    )
    out_rho, out_variance = rho.clone(), torch.full_like(rho, torch.inf)
    found = torch.zeros_like(searched)
    # Most intervals are a few pixels wide: searched apart, they need a quarter of the samples.
    for low, high in ((0.0, 3.0), (3.0, float(config.max_half_width_px))):
        index = (searched & (half_width > low) & (half_width <= high)).nonzero()[:, 0]
        if index.numel() == 0:
            continue
        part = circles.take(index)
        theta, ok = _search(target, part, samples[index], middle[index], half_width[index], int(high), step, config)
        gradient_ratio = (slope[index].square() / slope2_along[index].clamp_min(1e-12)).clamp(1, 50)
        error_px2 = (
            config.position_error_px**2
            + config.line_error_px**2 * gradient_ratio
            + config.noise**2 / (4 * slope2_along[index].clamp_min(1e-12))
        )
        out_rho[index] = torch.where(ok, part.rho(theta), rho[index])
        error = (part.rho_by_angle(theta) * step).square() * error_px2
        out_variance[index] = torch.where(ok, error, torch.inf)
        found[index] = ok
    return EpipolarMatch(out_rho, out_variance, searched, found)


def _search_compiled(
    reference: Target,
    target: Target,
    points: tuple[Tensor, ...],
    T_tgt_ref: Float[Tensor, "4 4"],
    affine: Float[Tensor, "2"],
    config: EpipolarConfig,
) -> EpipolarMatch:
    rho, variance = (torch.empty_like(points[1]) for _ in range(2))
    searched, found = (torch.empty_like(rho, dtype=torch.bool) for _ in range(2))
    limits = (config.min_gradient, config.min_sine, config.max_half_width_px, config.max_ssd, config.min_distinction)
    kernel("epipolar").search(
        *(plain(part) for part in (*points, T_tgt_ref.double(), affine.double())),
        image_view(reference),
        image_view(target),
        target.camera.pixel_angle,
        np.array([*limits, config.noise, config.position_error_px, config.line_error_px]),
        *(part.numpy() for part in (rho, variance, searched, found)),
    )
    return EpipolarMatch(rho, variance, searched, found)


def reference_samples(
    reference: Target, ray: Float[Tensor, "3 N"], circles: GreatCircles, T: Float[Tensor, "4 4"], step: float
) -> Float[Tensor, "N 5"]:
    """Look up five samples of the reference along each point's own epipolar curve, one pixel apart."""
    towards = T[:3, :3].mT @ circles.towards
    angle = torch.arange(-HALF_PATTERN, HALF_PATTERN + 1, dtype=ray.dtype, device=ray.device) * step
    return look_up_usable(reference, ray[..., None] * angle.cos() + towards[..., None] * angle.sin())


def _search(
    target: Target,
    circles: GreatCircles,
    samples: Float[Tensor, "M 5"],
    middle: Float[Tensor, "M"],
    half_width: Float[Tensor, "M"],
    reach: int,
    step: float,
    config: EpipolarConfig,
) -> tuple[Float[Tensor, "M"], Bool[Tensor, "M"]]:
    """Return the angle of the best match within `reach` pixels of the middle, and whether it is clear."""
    offsets = torch.arange(
        -reach - HALF_PATTERN - 1, reach + HALF_PATTERN + 2, dtype=middle.dtype, device=middle.device
    )
    theta = middle[:, None] + offsets * step
    direction = circles.start[..., None] * theta.cos() + circles.towards[..., None] * theta.sin()
    window = look_up_usable(target, direction).unfold(1, 2 * HALF_PATTERN + 1, 1)
    ssd = (window - samples[:, None]).square().sum(-1).nan_to_num(nan=torch.inf)
    centre = theta[:, HALF_PATTERN:-HALF_PATTERN]
    inside = (
        (offsets[HALF_PATTERN:-HALF_PATTERN].abs() <= half_width[:, None] + 0.5)
        & (centre > -1.5 * step)
        & (centre < circles.phi[:, None] - 0.02)
    )
    inside[:, 0] = inside[:, -1] = False
    allowed = torch.where(inside, ssd, torch.inf)
    best, at = allowed.min(1)
    place = torch.arange(ssd.shape[1], device=ssd.device)
    apart = (place - at[:, None]).abs() > HALF_PATTERN
    second = torch.where(apart, allowed, torch.inf).min(1).values
    at = at.clamp(1, ssd.shape[1] - 2)
    before, after = ssd.gather(1, at[:, None] - 1)[:, 0], ssd.gather(1, at[:, None] + 1)[:, 0]
    curvature = before - 2 * best + after
    shift = torch.where(curvature > 1e-9, (before - after) / (2 * curvature), 0.0).nan_to_num(0.0).clamp(-0.6, 0.6)
    refined = (centre.gather(1, at[:, None])[:, 0] + shift * step).clamp_min(0.0)
    clear = (best < config.max_ssd) & (second > config.min_distinction * best)
    return refined, clear
