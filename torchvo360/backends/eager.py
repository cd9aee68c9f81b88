"""The hot kernel in eager torch: the default and the reference; autograd flows through it.

`linearize` never keeps the Jacobian: rows are built, weighted and contracted chunk by chunk into one 9 x 9 matrix
`S W S^T` per pair, where the ninth row is the residual. The chunk is small enough for its rows to stay in the cache.
"""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.residuals.direct import Reference, Target, by_rho, look_up, system_rows, weight_slope_rows
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig, depth_variance_weight, robust

CHUNK_SAMPLES = 49152
"""Samples in one go; measured fastest between 32768 and 65536 on a core with 1 MB of L2 cache."""

SUM_SAMPLES = 2048
"""Samples summed in the dtype of the rows before float64 takes over: errors of a float32 H stay near 1e-7, not 1e-6."""


def linearize(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    loss: LossConfig,
    *,
    noise: float = 4 / 255,
) -> NormalEquations:
    """Linearise the direct alignment of every pair at its own pose and brightness.

    Args:
        reference: Points of the reference frames.
        target: Target images.
        T_tgt_ref: Poses, float64.
        affine: (a, b) of each pair, float64.
        loss: The robust loss.
        noise: Standard deviation of an intensity, for the weights of points with a variance.
    """
    B, N = reference.rho.shape
    C = reference.value.shape[1]
    dtype = reference.value.dtype
    T, ab = T_tgt_ref.to(dtype), affine.to(dtype)
    size = max(256, CHUNK_SAMPLES // max(1, B * C))
    parts = []
    for start in range(0, max(N, 1), size):
        points = reference if size >= N else reference.chunk(start, min(start + size, N))
        samples = look_up(points, target, T, ab)
        weight, residual = samples.weight, samples.residual
        slope_rows = None
        if points.variance is not None:
            t = T[:, :3, 3]
            by_depth, slope = depth_variance_weight(by_rho(samples, t), points.variance[:, None], noise)
            robust_weight, robust_cost = robust(residual * by_depth.sqrt(), loss)
            robust_weight = robust_weight * by_depth
            slope_rows = weight_slope_rows(samples, slope * residual * _root(weight * robust_weight), t)
        else:
            robust_weight, robust_cost = robust(residual, loss)
        S = system_rows(samples, _root(weight * robust_weight))
        if slope_rows is not None:
            S[:, :6] += slope_rows
        parts.append(
            (_gram(S), (weight * robust_cost).sum((1, 2)).double(), weight.sum((1, 2)).double() * (C / weight.shape[1]))
        )
    M, cost, total = (torch.stack(column).sum(0) for column in zip(*parts, strict=True))
    return NormalEquations(M[:, :8, :8], M[:, :8, 8], cost, total, M[:, 8, 8])


def _gram(S: Float[Tensor, "B 9 M"]) -> Float64[Tensor, "B 9 9"]:
    """Return `S S^T`, summed block by block."""
    blocks = S.shape[2] // SUM_SAMPLES
    if blocks < 2 or not len(S):
        return torch.bmm(S, S.mT).double()
    # Element by element: the blocks of one are a view, those of all would be a copy.
    whole = S[..., : blocks * SUM_SAMPLES].unflatten(2, (blocks, SUM_SAMPLES)).transpose(1, 2)
    total = torch.stack([torch.bmm(part, part.mT).sum(0, dtype=torch.float64) for part in whole])
    rest = S[..., blocks * SUM_SAMPLES :]
    return total + torch.bmm(rest, rest.mT) if rest.shape[2] else total


def _root(weight: Float[Tensor, "B C N"]) -> Float[Tensor, "B C N"]:
    """Return the square root, with a zero gradient at zero, where the bare root's is infinite."""
    if not weight.requires_grad:
        return weight.sqrt()
    positive = weight > 0
    return torch.where(positive, weight, 1.0).sqrt() * positive
