"""Robust losses: how much a residual counts, and what it costs.

Each loss is given by its weight `w(r) = cost'(r) / r`, so that iteratively reweighted least squares minimises its cost.
Residuals are in intensities of [0, 1] (or in the unit of the features).
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.checks import check_choice, check_finite_number
from torchvo360.residuals.direct import Reference, Samples, by_rho

LOSSES = ("huber", "student_t", "none")


@dataclass(kw_only=True)
class LossConfig:
    """How residuals are weighted."""

    name: str = "huber"
    """huber, student_t or none."""
    scale: float = 9 / 255
    """Huber: the residual at which the cost turns from square to linear (DSO: 9 of 255). Student-t: its sigma."""
    degrees_of_freedom: float = 5.0
    """Student-t only (Kerl et al. 2013 measured 5 on RGB-D residuals)."""
    cutoff: float | None = None
    """Residuals beyond this weigh nothing and cost a constant; None keeps all."""

    def __post_init__(self) -> None:
        check_choice("loss.name", self.name, LOSSES)
        check_finite_number("loss.scale", self.scale, above=0)
        check_finite_number("loss.degrees_of_freedom", self.degrees_of_freedom, above=0)
        if self.cutoff is not None:
            check_finite_number("loss.cutoff", self.cutoff, above=0)


def robust(
    residual: Float[Tensor, "*batch"], loss: LossConfig
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Return (weight, cost) of residuals; both are finite for finite residuals.

    Huber: cost r^2 / 2 within the scale k, k (|r| - k / 2) beyond. Student-t with nu degrees of freedom and scale s:
    (nu + 1) / 2 s^2 log(1 + r^2 / (nu s^2)). The cut-off turns either into a constant from there on.
    """
    if loss.name == "huber":
        size = residual.abs()
        capped = size.clamp(max=loss.scale)
        weight = loss.scale / size.clamp_min(loss.scale)
        cost = capped * torch.sub(size, capped, alpha=0.5)
    elif loss.name == "student_t":
        size = residual.abs()
        nu, variance = loss.degrees_of_freedom, loss.scale**2
        square = residual * residual
        weight = (nu + 1) / (nu + square / variance)
        cost = torch.log1p(square / (nu * variance)) * ((nu + 1) / 2 * variance)
    else:
        size = residual.abs()
        weight, cost = torch.ones_like(residual), residual * residual * 0.5
    if loss.cutoff is not None:
        limit = residual.new_tensor(loss.cutoff)
        _, most = robust(
            limit, LossConfig(name=loss.name, scale=loss.scale, degrees_of_freedom=loss.degrees_of_freedom)
        )
        weight = weight * (size <= loss.cutoff)
        cost = torch.minimum(cost, most)
    return weight, cost


def depth_variance_weight(
    dI_drho: Float[Tensor, "*batch"], variance: Float[Tensor, "*batch"], noise: float
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Return W = `2 s^2 / (2 s^2 + (dI/drho)^2 V)` and its logarithmic slope `-d ln(sqrt W) / d(dI/drho)`.

    W is LSD-SLAM's weight (mathematics.md, section 5) relative to exact depth. The slope is needed because dI/drho
    grows with the translation: with W held constant in a Gauss-Newton step, noise in rho shrinks every translation a
    little, and the scale drifts. With it the normalised residual is minimised as it is, which is total least squares.

    Args:
        dI_drho: Derivative of the residual by the inverse range.
        variance: Variance V of the inverse range.
        noise: Standard deviation s of an intensity.
    """
    floor = 2 * noise**2
    spread = dI_drho * variance
    total = torch.addcmul(torch.full_like(spread, floor), dI_drho, spread)
    return floor / total, spread / total


class Weighed(NamedTuple):
    """How samples count, besides their own weights."""

    weight: Float[Tensor, "B C N"]
    """Of the robust loss, times that of the uncertain range."""
    cost: Float[Tensor, "B C N"]
    slope: Float[Tensor, "B C N"] | None
    """The range weight's logarithmic slope (`depth_variance_weight`); None where ranges are exact."""


def weigh(
    samples: Samples, reference: Reference, t_tgt_ref: Float[Tensor, "B 3"], loss: LossConfig, noise: float
) -> Weighed:
    """Return the robust weights and costs of samples, by the variance of their inverse ranges where there is one.

    Args:
        samples: Warped points.
        reference: The points they came from.
        t_tgt_ref: Translations of the pairs, metres.
        loss: The robust loss; of residuals that uncertain ranges have been taken out of.
        noise: Standard deviation of an intensity.
    """
    if reference.variance is None:
        weight, cost = robust(samples.residual, loss)
        return Weighed(weight, cost, None)
    by_depth, slope = depth_variance_weight(by_rho(samples, t_tgt_ref), reference.variance[:, None], noise)
    weight, cost = robust(samples.residual * by_depth.sqrt(), loss)
    return Weighed(weight * by_depth, cost, slope)
