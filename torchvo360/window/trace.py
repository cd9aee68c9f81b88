"""Tracing: from no idea of a new point's range to a start for its optimisation, all points at once.

The points of a new keyframe are traced backwards into the last ones, which makes them usable at once. Along each
point's great circle (mathematics.md, section 5) every pixel of arc is compared by five samples spaced along the curve,
which takes one look-up a pixel; the best few places are then compared through the whole pattern, in all views.

These two are compiled passes over the points where numba serves (`backends.numba`), and eager torch elsewhere.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from torchvo360.backends.numba.arrays import plain
from torchvo360.backends.numba.images import can_see, image_view, look_up_usable
from torchvo360.backends.numba.kernel import kernel
from torchvo360.checks import InputError, check_finite_number
from torchvo360.depth.epipolar import HALF_PATTERN, GreatCircles, great_circles, reference_samples
from torchvo360.residuals.direct import Target
from torchvo360.window.points import WindowPoints

FINE_STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Where the pattern is compared around each candidate, pixels of arc."""
APART = 3
"""Candidates are at least this many pixels apart."""
LEAST_BEND = 0.1 / 255**2
"""Second difference of the cost over half pixels below which nothing says where the match lies: no texture."""
NEVER = 1e6


@dataclass(kw_only=True)
class TraceConfig:
    """Settings of tracing new points."""

    reach_px: int = 128
    """Pixels of arc from infinity that are searched, at a width of 1024; it grows and shrinks with a panorama's."""
    candidates: int = 4
    """Places along the curve that are compared through the whole pattern."""
    views: int = 2
    """Earlier keyframes that a new point is traced into."""
    max_difference: float = 20 / 255
    """Differences of intensity count at most this much."""
    max_energy: float = 200 / 255**2
    """Mean square difference above which nothing was found."""
    min_distinction: float = 1.5
    """The second best place must be this many times worse."""

    def __post_init__(self) -> None:
        if self.reach_px < 8 or self.candidates < 1 or self.views < 1:
            raise InputError(
                "reach_px, candidates, views: expected at least 8, 1 and 1, got "
                f"{self.reach_px}, {self.candidates} and {self.views}."
            )
        for name in ("max_difference", "max_energy"):
            check_finite_number(name, getattr(self, name), above=0)
        check_finite_number("min_distinction", self.min_distinction, above=1 - 1e-9)


class View(NamedTuple):
    """Another image of what the host sees."""

    target: Target
    T_tgt_host: Float64[Tensor, "4 4"]
    affine: Float64[Tensor, "2"]
    """(a, b) of the view against the host: I_view = e^a I_host + b."""


class Traced(NamedTuple):
    """What tracing found for each point."""

    rho: Float[Tensor, "N"]
    found: Bool[Tensor, "N"]


def trace(points: WindowPoints, host: Target, views: list[View], config: TraceConfig) -> Traced:
    """Find the inverse distances of points by their great circles.

    Args:
        points: New points of one host.
        host: The host's image.
        views: Images to search in; the first one's great circles are walked along.
        config: Settings.
    """
    first = views[0]
    step = first.target.camera.pixel_angle
    reach = max(8, round(config.reach_px * first.target.camera.width / 1024)) if host.camera.wraps else config.reach_px
    centre = points.ray.sum(2)
    centre = centre / centre.square().sum(0).sqrt()
    circles = great_circles(centre, first.T_tgt_host.to(centre))
    candidates, allowed = _walk(centre, circles, host, first, reach, step, config)
    place = candidates[..., None] + candidates.new_tensor(FINE_STEPS)
    theta = place * step
    N, C, F = theta.shape
    rho = circles.rho(theta.flatten(1))
    inside = (theta > -0.5 * step) & (theta < 0.9 * circles.phi[:, None, None]) & allowed[..., None]
    cost = torch.where(inside, _pattern_cost(points, rho, views, config).view(N, C, F), NEVER)
    best, at = cost.min(2)
    # A minimum on the edge of its neighbourhood belongs to no valley.
    inner = at.clamp(1, F - 2)
    left, right = (cost.gather(2, inner[..., None] + side)[..., 0] for side in (-1, 1))
    middle = cost.gather(2, inner[..., None])[..., 0]
    bend = left + right - 2 * middle
    shift = torch.where((bend > 1e-12) & (left < NEVER) & (right < NEVER), (left - right) / (2 * bend), 0.0)
    spacing = FINE_STEPS[1] - FINE_STEPS[0]
    refined = place.gather(2, inner[..., None])[..., 0] + shift.clamp(-1, 1) * spacing
    lowest, which = best.min(1)
    chosen = refined.gather(1, which[:, None])[:, 0]
    apart = (candidates - candidates.gather(1, which[:, None])).abs() >= APART
    second = torch.where(apart, best, NEVER).min(1).values
    distinct = second > config.min_distinction * lowest.clamp_min(1 / 255**2)
    out = circles.rho((chosen * step).clamp_min(0.0)[:, None])[:, 0].clamp_min(0.0)
    curved = bend.gather(1, which[:, None])[:, 0] > LEAST_BEND
    found = (lowest < config.max_energy) & distinct & curved & (chosen > 0.25) & torch.isfinite(out)
    return Traced(torch.where(found, out, 1.0), found)


def _walk(
    centre: Tensor, circles: GreatCircles, host: Target, view: View, reach: int, step: float, config: TraceConfig
) -> tuple[Float[Tensor, "N C"], Bool[Tensor, "N C"]]:
    """Return the best places along the curves by five samples each, in pixels of arc from infinity."""
    T = view.T_tgt_host.to(centre)
    samples = reference_samples(host, centre, circles, T, step)
    samples = samples * math.exp(float(view.affine[0])) + float(view.affine[1])
    offsets = torch.arange(-HALF_PATTERN, reach + HALF_PATTERN + 1, dtype=centre.dtype, device=centre.device)
    theta = offsets * step
    if can_see(view.target, also=(samples,)):
        return _walk_compiled(circles, samples, theta, view.target, config)
    direction = circles.start[..., None] * theta.cos() + circles.towards[..., None] * theta.sin()
    seen = look_up_usable(view.target, direction).unfold(1, 2 * HALF_PATTERN + 1, 1)
    difference = (seen - samples[:, None]).abs().clamp_max(config.max_difference)
    ssd = difference.square().sum(-1).nan_to_num(nan=NEVER)
    inside = theta[HALF_PATTERN:-HALF_PATTERN] < 0.9 * circles.phi[:, None]
    ssd = torch.where(inside, ssd, NEVER)
    valley = torch.nn.functional.pad(ssd, (1, 1), value=NEVER)
    # Of a level stretch only the beginning: it is one place, not several.
    lowest = (ssd < valley[:, :-2]) & (ssd <= valley[:, 2:])
    count = min(config.candidates, ssd.shape[1])
    value, place = torch.where(lowest, ssd, NEVER).topk(count, dim=1, largest=False)
    return place.to(centre.dtype), value < NEVER


def _walk_compiled(
    circles: GreatCircles, samples: Float[Tensor, "N 5"], theta: Float[Tensor, "L"], target: Target, config: TraceConfig
) -> tuple[Float[Tensor, "N C"], Bool[Tensor, "N C"]]:
    count = min(config.candidates, len(theta) - 2 * HALF_PATTERN)
    place, value = (samples.new_empty(len(samples), count) for _ in range(2))
    kernel("tracing").walk(
        *(plain(part) for part in (circles.start, circles.towards, 0.9 * circles.phi, samples)),
        *(plain(part) for part in (theta, theta.cos(), theta.sin())),
        image_view(target),
        np.float32(config.max_difference),
        np.float32(NEVER),
        place.numpy(),
        value.numpy(),
    )
    return place, value < NEVER


def _pattern_cost(
    points: WindowPoints, rho: Float[Tensor, "N M"], views: list[View], config: TraceConfig
) -> Float[Tensor, "N M"]:
    """Return the mean square difference of the whole pattern at some inverse distances, in the view that fits worst.

    What moves by itself may fit one view at a false range, but then not the other; a view that does not see a place
    says nothing of it.
    """
    if can_see(*(view.target for view in views), also=(rho, points.ray)):
        return _pattern_cost_compiled(points, rho, views, config)
    weight = points.weight
    whole = weight.sum(1, keepdim=True).clamp_min(1e-6)
    worst, seen_by = torch.zeros_like(rho), torch.zeros_like(rho)
    for view in views:
        T = view.T_tgt_host.to(rho)
        turned = torch.einsum("ij,jnp->inp", T[:3, :3], points.ray)
        ray = turned[:, :, None] + rho[..., None] * T[:3, 3, None, None, None]
        value = look_up_usable(view.target, ray)
        expected = (points.value * math.exp(float(view.affine[0])) + float(view.affine[1]))[:, None]
        w = weight[:, None] * torch.isfinite(value)
        square = (value.nan_to_num(nan=0.0) - expected).abs().clamp_max(config.max_difference).square()
        total = w.sum(-1)
        sees = total > 0.5 * whole
        worst = torch.where(sees, torch.maximum(worst, (square * w).sum(-1) / total.clamp_min(1e-6)), worst)
        seen_by += sees
    return torch.where(seen_by > 0, worst, NEVER)


def _pattern_cost_compiled(
    points: WindowPoints, rho: Float[Tensor, "N M"], views: list[View], config: TraceConfig
) -> Float[Tensor, "N M"]:
    worst, sees = torch.zeros_like(rho), torch.zeros_like(rho, dtype=torch.bool)
    arrays = [plain(part) for part in (points.ray, points.value, points.weight, rho)]
    for view in views:
        kernel("tracing").compare_patterns(
            *arrays,
            plain(view.T_tgt_host.double()),
            np.float32(math.exp(float(view.affine[0]))),
            np.float32(view.affine[1]),
            image_view(view.target),
            np.float32(config.max_difference),
            worst.numpy(),
            sees.numpy(),
        )
    return torch.where(sees, worst, NEVER)
