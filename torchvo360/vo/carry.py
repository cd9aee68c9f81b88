"""The hand-over from an old keyframe to a frame found in it: the same points go on, at their exact places."""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.depth import InverseRange
from torchvo360.depth.filter import box_sums, scatter

GUESS_RADII_PX = (6, 14)
"""Half widths of the surroundings from which new points take their first guess."""


@dataclass(frozen=True)
class CarriedPoints:
    """Points of an old keyframe where they lie in a new one.

    The same points are carried on, at their exact places, instead of pooling them on new pixels: averages over
    neighbours at different ranges are biased, and the bias of every keyframe adds up to a drift of scale.
    """

    pixel: Int64[Tensor, "N"]
    ray: Float[Tensor, "3 N"]
    points: InverseRange

    def take(self, index: Tensor) -> Self:
        """Return some of the points."""
        return type(self)(self.pixel[index], self.ray[:, index], InverseRange(*(part[index] for part in self.points)))

    def one_per_cell(self, cell: Int64[Tensor, "N"], usable: Bool[Tensor, "P"]) -> Self:
        """Return each cell's surest point on a usable pixel."""
        rho, variance, _ = self.points
        good = usable[self.pixel].nonzero()[:, 0]
        sure = good[(variance / rho.square().clamp_min(1e-12))[good].argsort(stable=True)]
        order = sure[cell[sure].argsort(stable=True)]
        first = torch.ones_like(order, dtype=torch.bool)
        first[1:] = cell[order][1:] != cell[order][:-1]
        return self.take(order[first])

    def guess(self, pixel: Int64[Tensor, "M"], camera: Camera) -> InverseRange:
        """Guess new points' inverse ranges from the carried ones around, pooled by 1 / V, with score 0."""
        rho, variance, _ = self.points
        median = rho.median()
        # Relative to the median, so that the thresholds below know no unit; capped, so that no single point rules.
        weight = 1 / (variance / median**2 + 1e-3)
        sums = scatter(camera, self.pixel, torch.stack([weight, weight * rho]))
        near, wide = (box_sums(sums, camera, radius).flatten(1)[:, pixel] for radius in GUESS_RADII_PX)
        around, guess = near[1] / near[0].clamp_min(1e-9), wide[1] / wide[0].clamp_min(1e-9)
        has_near, has_wide = near[0] > 5, wide[0] > 5
        out = torch.where(has_near, around, torch.where(has_wide, guess, median))
        relative = torch.where(has_near, 0.09, 0.36).to(out.dtype)
        return InverseRange(out, relative * out * out, torch.zeros_like(out))
