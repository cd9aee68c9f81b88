"""The kernel for those who differentiate it: a linearisation kept open, and the gradient of the cost alone.

Neither builds rows under autograd, nor divides the points: every part would bring a gradient image of its own.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.backends.eager import gram
from torchvo360.residuals.direct import (
    Reference,
    Samples,
    Target,
    along,
    look_up,
    row_sums,
    slope_along,
    weight_slope_sums,
)
from torchvo360.residuals.weights import LossConfig, Weighed, weigh


@dataclass(frozen=True)
class OpenLinearization:
    """What `linearize` looks up and weighs, for questions that cost less than all of its answers."""

    samples: Samples
    weighed: Weighed
    t_tgt_ref: Float[Tensor, "B 3"]

    @staticmethod
    def at(
        reference: Reference,
        target: Target,
        T_tgt_ref: Float[Tensor, "B 4 4"],
        affine: Float[Tensor, "B 2"],
        loss: LossConfig,
        noise: float,
    ) -> "OpenLinearization":
        """Look up and weigh all samples, with the arguments of `linearize`."""
        T, ab = T_tgt_ref.to(reference.value.dtype), affine.to(reference.value.dtype)
        samples = look_up(reference, target, T, ab)
        t = T[:, :3, 3]
        return OpenLinearization(samples, weigh(samples, reference, t, loss, noise), t)

    def matrix(self) -> Float64[Tensor, "B 8 8"]:
        """Return `linearize`'s H."""
        return gram(self.samples, self.weighed, self.t_tgt_ref)[:, :8, :8]

    def pull(self, direction: Float[Tensor, "B 8"]) -> Float64[Tensor, "B"]:
        """Return `linearize`'s g along a direction."""
        samples, weighed = self.samples, self.weighed
        direction = direction.to(samples.residual.dtype)
        slope = along(samples, direction)
        if weighed.slope is not None:
            slope = slope - weighed.slope * samples.residual * slope_along(samples, direction, self.t_tgt_ref)
        return (samples.weight * weighed.weight * samples.residual * slope).sum((1, 2), dtype=torch.float64)

    def gradient(self) -> Float64[Tensor, "B 8"]:
        """Return `linearize`'s g."""
        samples, weighed = self.samples, self.weighed
        force = samples.weight * weighed.weight * samples.residual
        g = row_sums(samples, force)
        if weighed.slope is None:
            return g
        slopes = weight_slope_sums(samples, weighed.slope * samples.residual * force, self.t_tgt_ref)
        return torch.cat([g[:, :6] + slopes, g[:, 6:]], -1)
