"""The hot kernel in eager torch: the reference, and what computes where numba does not; autograd flows through it.

`linearize` never keeps the Jacobian: rows are built, weighted and contracted chunk by chunk into one 9 x 9 matrix
`S W S^T` per pair, where the ninth row is the residual. The chunk is small enough for its rows to stay in the cache.
How samples are divided depends on the points alone: a pair gets the same bits whatever else is in its batch.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.backends import buffered
from torchvo360.backends.buffered import ALIGNED
from torchvo360.residuals.direct import (
    Reference,
    Samples,
    Target,
    look_up,
    nine_rows,
    system_rows,
    weight_slope_rows,
)
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig, Weighed, weigh

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
    C = reference.value.shape[1]
    in_buffers = buffered.serves(reference, target, T_tgt_ref, affine)
    groups = []
    for chunks in _divided(reference, target, T_tgt_ref, affine):
        parts = []
        for points, images, T, ab in chunks:
            room = buffered.room_for(points) if in_buffers else None
            samples = look_up(points, images, T, ab) if room is None else buffered.look_up(points, images, T, ab, room)
            weighed = weigh(samples, points, T[:, :3, 3], loss, noise)
            M = gram(samples, weighed, T[:, :3, 3], room)
            cost = (samples.weight * weighed.cost).sum((1, 2)).double()
            weight = samples.weight.sum((1, 2)).double() * (C / samples.weight.shape[1])
            parts.append((M, cost, weight))
        groups.append(
            [column[0] if len(parts) == 1 else torch.stack(column).sum(0) for column in zip(*parts, strict=True)]
        )
    M, cost, total = groups[0] if len(groups) == 1 else (torch.cat(column) for column in zip(*groups, strict=True))
    return NormalEquations(M[:, :8, :8], M[:, :8, 8], cost, total, M[:, 8, 8])


Part = tuple[Reference, Target, Tensor, Tensor]


def _divided(reference: Reference, target: Target, T_tgt_ref: Tensor, affine: Tensor) -> Iterator[Iterator[Part]]:
    """Divide pairs into groups, and each group's points into chunks, of about `CHUNK_SAMPLES` samples."""
    B, N = reference.rho.shape
    dtype = reference.value.dtype
    T, ab = T_tgt_ref.to(dtype), affine.to(dtype)
    most = max(256, CHUNK_SAMPLES // reference.value.shape[1])
    group = max(1, most // max(N, 1))

    def chunks(pairs: slice) -> Iterator[Part]:
        points, images, T_group, ab_group = reference, target, T, ab
        # Under autograd the chunks' gradients are summed here first, in one order whatever part of a batch this is.
        if group < B or torch.is_grad_enabled():
            points, images, T_group, ab_group = reference.take(pairs), target.take(pairs), T[pairs], ab[pairs]
        for start in range(0, max(N, 1), most):
            yield (points if most >= N else points.chunk(start, min(start + most, N))), images, T_group, ab_group

    for first in range(0, max(B, 1), group):
        yield chunks(slice(first, first + group))


def gram(
    samples: Samples, weighed: Weighed, t_tgt_ref: Float[Tensor, "B 3"], room: buffered.Room | None = None
) -> Float64[Tensor, "B 9 9"]:
    """Return `S W S^T` of the Jacobian's eight columns and the residual, with S in buffers where there are any."""
    if room is not None:
        root = torch.mul(samples.weight, weighed.weight, out=room.samples[3]).sqrt_()
        S = _rows(samples, weighed, t_tgt_ref, root, room)
        return _product(S, S)
    W = samples.weight * weighed.weight
    if torch.is_grad_enabled():
        # Without the roots, whose slope is infinite where a weight is zero.
        S = _rows(samples, weighed, t_tgt_ref, torch.ones_like(W), None)
        return _product(S * W.flatten(1)[:, None], S)
    S = _rows(samples, weighed, t_tgt_ref, W.sqrt(), None)
    return _product(S, S)


def _rows(
    samples: Samples, weighed: Weighed, t_tgt_ref: Tensor, root: Tensor, room: buffered.Room | None
) -> Float[Tensor, "B 9 M"]:
    if room is None:
        S = system_rows(samples, root)
    else:
        nine_rows(samples, root, room.rows)
        S = room.S
    if weighed.slope is not None:
        slopes = weight_slope_rows(samples, weighed.slope * samples.residual * root, t_tgt_ref)
        S[:, :6, : slopes.shape[2]] += slopes
    return S


def _product(A: Float[Tensor, "B 9 M"], S: Float[Tensor, "B 9 M"]) -> Float64[Tensor, "B 9 9"]:
    """Return `A S^T`, summed block by block."""
    if S.shape[2] % ALIGNED:
        A, S = (F.pad(x, (0, -x.shape[2] % ALIGNED)) for x in (A, S))
    blocks = S.shape[2] // SUM_SAMPLES
    if blocks < 2 or not len(S):
        return torch.bmm(A, S.mT).double()
    # Element by element: the blocks of one are a view, those of all would be a copy.
    whole = slice(0, blocks * SUM_SAMPLES)
    left, right = (x[..., whole].unflatten(2, (blocks, SUM_SAMPLES)).transpose(1, 2) for x in (A, S))
    total = torch.stack([torch.bmm(a, b.mT).sum(0, dtype=torch.float64) for a, b in zip(left, right, strict=True)])
    rest = slice(blocks * SUM_SAMPLES, None)
    return total + torch.bmm(A[..., rest], S[..., rest].mT) if S.shape[2] > blocks * SUM_SAMPLES else total
