"""What an alignment gives."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360.solve import inverse_ldl


@dataclass(frozen=True)
class LevelHistory:
    """How the solve of one pyramid level went; S is the number of steps of the element that took most."""

    T_tgt_ref: Float[Tensor, "*batch 4 4"]
    """At the level's end; it carries gradients where the steps are unrolled."""
    status: Int64[Tensor, "*batch"]
    """`Status` of the level as integers."""
    cost: Float[Tensor, "*batch S"]
    """Mean robust cost of a pixel before each step; 0 where none was tried."""
    damping: Float[Tensor, "*batch S"]
    """Lambda of each step; 0 where none was tried."""
    tried: Bool[Tensor, "*batch S"]
    """False where the element had ended before."""
    accepted: Bool[Tensor, "*batch S"]


@dataclass(frozen=True)
class AlignMaps:
    """Images in the reference's frame, at the finest level and the solution; they carry gradients."""

    residual: Float[Tensor, "*batch C H W"]
    """Target minus reference after gain and offset; 0 where not visible."""
    weight: Float[Tensor, "*batch C H W"]
    """How much each residual counts in all: solid angle, confidences, range variance and robust loss."""
    visible: Bool[Tensor, "*batch H W"]
    """Whether a pixel is known and unmasked, and meets a usable pixel of the target in view."""
    warped: Float[Tensor, "*batch C H W"]
    """The target's values where the reference's pixels come to lie; 0 where not visible."""


@dataclass(frozen=True)
class AlignResult:
    """What `align` found, for each element of the batch."""

    T_tgt_ref: Float[Tensor, "*batch 4 4"]
    """Poses, float64: points of the reference frame into the target's, metres."""
    a: Float[Tensor, "*batch"]
    """Log gain: the target's brightness is e^a times the reference's, plus b."""
    b: Float[Tensor, "*batch"]
    status: Int64[Tensor, "*batch"]
    """`Status` as integers."""
    cost: Float[Tensor, "*batch"]
    """Mean robust cost of a pixel at the end; infinite where there was none."""
    steps: Int64[Tensor, "*batch"]
    """Steps of the solver over all levels."""
    H: Float[Tensor, "*batch 8 8"]
    """Information: J^T W J by (v, w, a, b) at the end, undamped."""
    variance: Float[Tensor, "*batch"]
    """Variance of a residual at the end."""
    agreement: Float[Tensor, "*batch"]
    """Share of the image gradient that is matched to within half a pixel beyond chance, 0 to 1."""
    differentiable: Bool[Tensor, "*batch"]
    """Whether gradients flow to the inputs: not to those of elements without a solution, whose gradients are zero."""
    estimated: Bool[Tensor, "*batch 8"]
    """Which of (v, w, a, b) were estimated."""
    history: list[LevelHistory] | None = None
    """The coarsest level first; asked for by `outputs=("history",)`."""
    maps: AlignMaps | None = None
    """Asked for by `outputs=("maps",)`."""

    def covariance(self) -> Float[Tensor, "*batch 8 8"]:
        """Return the covariance of (v, w, a, b) about the solution, `variance * H^-1`; infinite where H is singular.

        Rows and columns of what was not estimated are zero. It takes the residuals as independent; those of
        neighbouring pixels are not, so that it is a lower bound.
        """
        used = self.estimated[..., None] & self.estimated[..., None, :]
        eye = torch.eye(self.H.shape[-1], dtype=self.H.dtype, device=self.H.device)
        inverse, ok = inverse_ldl(torch.where(used, self.H, eye))
        scaled = inverse * self.variance[..., None, None]
        scaled = torch.where(ok[..., None, None] & torch.isfinite(scaled), scaled, torch.inf)
        return torch.where(used, scaled, 0.0)
