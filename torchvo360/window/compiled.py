"""Edges by the compiled pass: tensors to arrays, one call a keyframe, and back.

The pass runs on one thread and lets others run Python meanwhile.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.backends import use_numba
from torchvo360.backends.numba.arrays import intrinsics_of, loss_of, optics_of, plain
from torchvo360.backends.numba.kernel import kernel
from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.residuals.direct import Target
from torchvo360.window.config import WindowConfig
from torchvo360.window.edges import KeyframeSums, PointSums
from torchvo360.window.pattern import PATTERN
from torchvo360.window.points import WindowPoints
from torchvo360.window.state import Estimate
from torchvo360.window.thresholds import find_threshold

NO_IMAGE, NO_POSES = np.empty((0, 0), np.float32), np.empty((0, 4, 4))
NO_SUMS = np.empty((0, 0)), np.empty((0, 9, 9))
MEANS, RANGES, ALL = 0, 1, 2
"""As in `kernels.edges`, which cannot be imported without numba."""


def serves(targets: Sequence[Target], points: WindowPoints, estimate: Estimate) -> bool:
    """Return whether `sum_edges` takes these: float32 on the CPU, known cameras that stay as they are, no gradient."""
    tensors = [estimate.rho, points.ray, points.value, points.weight]
    for target in targets:
        tensors += [target.padded] if target.confidence is None else [target.padded, target.confidence]
    return (
        estimate.intrinsics is None
        and all(tensor.dtype == torch.float32 for tensor in tensors)
        and all(type(t.camera) in (Equirectangular, Pinhole) and t.intrinsics is None for t in targets)
        and all(t.padded.shape == (1, 1, t.camera.height + 2, t.camera.width + 2) for t in targets)
        and points.value.shape[1] <= len(PATTERN)
        and use_numba(*tensors, estimate.T_cam_world, estimate.affine)
        # A step to nowhere has no energy: torch says so by NaN.
        and bool(torch.isfinite(estimate.T_cam_world).all())
    )


def sum_edges(
    targets: Sequence[Target],
    points: WindowPoints,
    estimate: Estimate,
    config: WindowConfig,
    *,
    T_first: Float64[Tensor, "K 4 4"] | None,
    thresholds: Float[Tensor, "K+S"] | None,
    keyframes: bool,
) -> tuple[PointSums, KeyframeSums | None]:
    """Evaluate and linearise all edges as `edges.sum_edges` does."""
    kernels = kernel("edges")
    N, P = points.value.shape
    K = len(targets)
    T, affine = plain(estimate.T_cam_world), plain(estimate.affine)
    at = NO_POSES if T_first is None else plain(T_first)
    arrays = (plain(x) for x in (points.ray, estimate.rho, points.value, points.weight, points.host))
    packed, counts = kernels.pack(*arrays, affine)
    sums, means = np.zeros((4, N)), np.empty(N, np.float32)
    cross, M = NO_SUMS
    if keyframes:
        cross, M = kernels.begin_cross(K, packed), np.zeros((K, K, 9, 9))
    edges, limits, optics = 0, np.zeros(K, np.float32), {}
    if thresholds is not None:
        limits[:] = thresholds[:K].numpy()
    for j, target in enumerate(targets):
        if counts[j] == N:
            continue
        if target.camera not in optics:
            optics[target.camera] = intrinsics_of(target)[0], optics_of(target)
        confidence = NO_IMAGE if target.confidence is None else plain(target.confidence[0, 0])
        image = plain(target.padded[0, 0]), confidence
        loss = loss_of(config.loss, target.saturation, 0.0)
        outputs = means, sums, cross, M[j] if keyframes else M
        arguments = packed, T, at, affine, image, *optics[target.camera], loss, *outputs
        if thresholds is None:
            means.fill(-1)
            kernels.add_target(j, P, MEANS, limits[j], *arguments)
            limits[j] = float(find_threshold(torch.from_numpy(means[means >= 0]), config))
        edges += kernels.add_target(j, P, ALL if keyframes else RANGES, limits[j], *arguments)
    total = torch.from_numpy(sums)
    curvature, slope, energy, inliers = total.unbind()
    of_points = PointSums(curvature, slope, energy, inliers.to(estimate.rho), edges, list(torch.from_numpy(limits)))
    if not keyframes:
        return of_points, None
    H, g = kernel("normal").assemble(M, T if T_first is None else at, affine)
    return of_points, KeyframeSums(torch.from_numpy(H), torch.from_numpy(g), torch.from_numpy(cross).T)
