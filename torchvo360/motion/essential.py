"""The essential matrix of two sets of bearings: spherical eight points, RANSAC in one batch, robust refinement.

Bearings may point anywhere, so that nothing here divides by z. The error is the angular Sampson distance.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360 import lie

SAMPLES = 400
CANDIDATES_AT_ONCE = 40
"""Whose errors at a thousand matches stay in the cache while they are computed."""
INLIER_RAD = 2e-3
"""A tenth of a degree: about a third of a pixel at 1024 x 512, the accuracy of tracked corners. In smaller images a
third of a pixel is more, and corners that have been followed through a turn are not better than that."""


class TwoView(NamedTuple):
    """The motion between two views, up to the length of its translation."""

    R_tgt_ref: Float[Tensor, "3 3"]
    t_tgt_ref: Float[Tensor, "3"]
    """Of length 1."""
    inlier: Bool[Tensor, "N"]
    rho: Float[Tensor, "N"]
    """Inverse range of each bearing in the reference, in units of 1 / |t|."""
    parallax: float
    """Median angle between rotated and matched bearings of the inliers, radians."""
    cheirality: float
    """Share of the inliers in front of both cameras."""


def sampson_angle(
    E: Float[Tensor, "*batch 3 3"], ref: Float[Tensor, "N 3"], tgt: Float[Tensor, "N 3"]
) -> Float[Tensor, "*batch N"]:
    """Return the first-order angular distance of bearing pairs from `tgt^T E ref = 0`, in radians."""
    line_tgt, line_ref = ref @ E.mT, tgt @ E
    value = (tgt * line_tgt).sum(-1)
    squared = line_tgt.square().sum(-1) + line_ref.square().sum(-1) - 2 * value.square()
    return value.abs() / squared.clamp_min(1e-18).sqrt()


def _nearest_essential(E: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    U, _, Vh = torch.linalg.svd(E)
    return U @ torch.diag(E.new_tensor([1.0, 1.0, 0.0])) @ Vh


def inverse_ranges(
    R: Float[Tensor, "*batch 3 3"],
    t: Float[Tensor, "*batch 3"],
    ref: Float[Tensor, "N 3"],
    tgt: Float[Tensor, "N 3"],
) -> Float[Tensor, "*batch N"]:
    """Return rho of each reference bearing from its match, in least squares (mathematics.md, section 5)."""
    turned = ref @ R.mT
    n = torch.linalg.cross(tgt.expand_as(turned), t[..., None, :].expand_as(turned))
    return -(n * torch.linalg.cross(tgt.expand_as(turned), turned)).sum(-1) / n.square().sum(-1).clamp_min(1e-12)


def estimate_two_view(
    ref: Float[Tensor, "N 3"],
    tgt: Float[Tensor, "N 3"],
    generator: torch.Generator,
    *,
    inlier_rad: float = INLIER_RAD,
) -> TwoView | None:
    """Estimate the motion between two views from matched bearings.

    Args:
        ref: Unit bearings in the reference, float64.
        tgt: Their matches in the target.
        generator: Draws the samples.
        inlier_rad: Sampson angle within which a match is an inlier, radians.

    Returns:
        The motion, or None for fewer than 16 matches.
    """
    N = ref.shape[0]
    if N < 16:
        return None
    products = (tgt[:, :, None] * ref[:, None, :]).reshape(N, 9)
    chosen = torch.rand(SAMPLES, N, generator=generator).topk(8, dim=1).indices
    null = torch.linalg.qr(products[chosen].mT, mode="complete").Q[..., 8]
    candidates = _nearest_essential(null.reshape(-1, 3, 3))
    E = candidates[_summed_errors(candidates, products, ref, tgt, inlier_rad).argmin()]
    for _ in range(5):
        error = sampson_angle(E, ref, tgt)
        weight = (error < inlier_rad) / (1 + (2 * error / inlier_rad) ** 2)
        refined = torch.linalg.svd(products * weight[:, None], full_matrices=False).Vh[-1]
        refined = _nearest_essential(refined.reshape(3, 3))
        if sampson_angle(refined, ref, tgt).clamp(max=inlier_rad).sum() > error.clamp(max=inlier_rad).sum():
            break
        E = refined
    inlier = sampson_angle(E, ref, tgt) < inlier_rad
    if int(inlier.sum()) < 8:
        return None
    R, t = _in_front(E, ref[inlier], tgt[inlier])
    R, t = _refine(R, t, ref[inlier], tgt[inlier], inlier_rad)
    rho = inverse_ranges(R, t, ref, tgt)
    inlier = sampson_angle(lie.so3_hat(t) @ R, ref, tgt) < inlier_rad
    turned = ref @ R.mT
    ahead = (rho > 0) & (((turned + rho[:, None] * t) * tgt).sum(-1) > 0)
    angle = torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(turned, tgt), dim=-1), (turned * tgt).sum(-1))
    if not bool(inlier.any()):
        return None
    return TwoView(R, t, inlier, rho, float(angle[inlier].median()), float(ahead[inlier].double().mean()))


def _summed_errors(
    E: Float[Tensor, "S 3 3"],
    products: Float[Tensor, "N 9"],
    ref: Float[Tensor, "N 3"],
    tgt: Float[Tensor, "N 3"],
    most: float,
) -> Float[Tensor, "S"]:
    """Return the sum over all matches of their Sampson angles, each at most `most`, for every candidate.

    Value and lines' lengths are linear in products of bearings: two matrix products for all candidates and matches.
    """
    lengths = torch.cat([(side[:, :, None] * side[:, None]).flatten(1) for side in (ref, tgt)], 1)
    sums = []
    for some in E.split(CANDIDATES_AT_ONCE):
        value2 = (some.flatten(1) @ products.mT).square_()
        both = torch.cat([(some.mT @ some).flatten(1), (some @ some.mT).flatten(1)], 1)
        squared = (both @ lengths.mT).sub_(value2, alpha=2).clamp_min_(1e-18)
        sums.append(value2.div_(squared).clamp_max_(most**2).sqrt_().sum(-1))
    return torch.cat(sums)


def _in_front(
    E: Float[Tensor, "3 3"], ref: Float[Tensor, "N 3"], tgt: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Return the one of E's four motions that puts most points in front of both cameras."""
    U, _, Vh = torch.linalg.svd(E)
    U, Vh = U * torch.linalg.det(U).sign(), Vh * torch.linalg.det(Vh).sign()
    quarter = E.new_tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    R = torch.stack([U @ quarter @ Vh, U @ quarter @ Vh, U @ quarter.mT @ Vh, U @ quarter.mT @ Vh])
    t = torch.stack([U[:, 2], -U[:, 2], U[:, 2], -U[:, 2]])
    rho = inverse_ranges(R, t, ref, tgt)
    forward = ((ref @ R.mT + rho[..., None] * t[:, None]) * tgt).sum(-1)
    best = ((rho > 0) & (forward > 0)).sum(-1).argmax()
    return R[best], t[best]


def _refine(
    R: Float[Tensor, "3 3"],
    t: Float[Tensor, "3"],
    ref: Float[Tensor, "N 3"],
    tgt: Float[Tensor, "N 3"],
    inlier_rad: float,
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Minimise the Cauchy-weighted Sampson distance over rotation (3) and direction (2) by Gauss-Newton."""
    for _ in range(6):
        turned = ref @ R.mT
        E = lie.so3_hat(t) @ R
        value = (tgt * torch.linalg.cross(t.expand_as(turned), turned)).sum(-1)
        squared = (ref @ E.mT).square().sum(-1) + (tgt @ E).square().sum(-1) - 2 * value.square()
        scale = squared.clamp_min(1e-12).rsqrt()
        residual = value * scale
        by_rotation = torch.linalg.cross(turned, torch.linalg.cross(tgt, t.expand_as(tgt)))
        tangent = torch.linalg.svd(t[None], full_matrices=True).Vh[1:]
        by_direction = torch.linalg.cross(turned, tgt) @ tangent.mT
        J = torch.cat([by_rotation, by_direction], -1) * scale[:, None]
        weight = 1 / (1 + (2 * residual / inlier_rad) ** 2)
        A = J.mT @ (J * weight[:, None]) + 1e-9 * torch.eye(5, dtype=J.dtype)
        delta = -torch.linalg.solve(A, J.mT @ (weight * residual))
        R = lie.so3_exp(delta[:3]) @ R
        t = t + delta[3:] @ tangent
        t = t / torch.linalg.vector_norm(t)
    return R, t
