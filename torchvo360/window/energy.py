"""The window's photometric energy, and its normal equations.

Each point is compared, through its pattern, with every keyframe but its host (mathematics.md, section 6):

    r = I_j(project(R_j (R_i^T ray + rho c_i) + rho t_j)) - b_j - e^(a_j - a_i) (I_i - b_i)

where c_i is the host's centre. Keyframes are perturbed from the left; each edge depends on its target by J and on its
host by -J Ad. The edges are summed by torch (`edges.py`) or by a compiled pass (`compiled.py`); both mean the same.
A rig's further images add rows of static stereo (`stereo.py`), estimated intrinsics four columns (`calibration.py`).
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.residuals.direct import Target
from torchvo360.window import compiled, edges
from torchvo360.window.config import WindowConfig
from torchvo360.window.edges import KeyframeSums, PointSums
from torchvo360.window.points import WindowPoints
from torchvo360.window.state import Estimate
from torchvo360.window.stereo import Other, stereo_rows
from torchvo360.window.system import PointSystem, WindowSystem


def linearize_window(
    targets: Sequence[Target],
    points: WindowPoints,
    estimate: Estimate,
    config: WindowConfig,
    *,
    T_first: Float64[Tensor, "K 4 4"] | None = None,
    k_first: Float64[Tensor, "4"] | None = None,
    thresholds: Float[Tensor, "K+S"] | None = None,
    others: Sequence[Other] = (),
) -> WindowSystem:
    """Evaluate the energy of all edges and linearise it.

    Args:
        targets: The keyframes' finest levels.
        points: The points.
        estimate: Where to linearise.
        config: Settings.
        T_first: Poses at which Jacobians are taken, where they differ from the estimate's.
        k_first: Intrinsics at which they are taken.
        thresholds: Outlier thresholds of the images, mean energies; found from the edges by default.
        others: Further images of the keyframes, by a rig's other cameras.
    """
    sums, frames = _edges(
        targets, points, estimate, config, T_first=T_first, k_first=k_first, thresholds=thresholds, keyframes=True
    )
    assert frames is not None
    of_points = _points(sums, points, estimate, config, thresholds, others)
    return WindowSystem(
        H=frames.H, g=frames.g, cross=frames.cross, energy=float(of_points.by_point.sum()), **of_points._asdict()
    )


def linearize_points(
    targets: Sequence[Target],
    points: WindowPoints,
    estimate: Estimate,
    config: WindowConfig,
    *,
    thresholds: Float[Tensor, "K+S"] | None = None,
    others: Sequence[Other] = (),
) -> PointSystem:
    """Evaluate the energy of all edges and linearise it by the points alone, with `linearize_window`'s arguments."""
    sums, _ = _edges(
        targets, points, estimate, config, T_first=None, k_first=None, thresholds=thresholds, keyframes=False
    )
    return _points(sums, points, estimate, config, thresholds, others)


def _edges(
    targets: Sequence[Target],
    points: WindowPoints,
    estimate: Estimate,
    config: WindowConfig,
    *,
    T_first: Float64[Tensor, "K 4 4"] | None,
    k_first: Float64[Tensor, "4"] | None,
    thresholds: Float[Tensor, "K+S"] | None,
    keyframes: bool,
) -> tuple[PointSums, KeyframeSums | None]:
    """Sum the edges by the compiled pass, where it serves these, else by torch."""
    if compiled.serves(targets, points, estimate):
        return compiled.sum_edges(
            targets, points, estimate, config, T_first=T_first, thresholds=thresholds, keyframes=keyframes
        )
    return edges.sum_edges(
        targets,
        points,
        estimate,
        config,
        T_first=T_first,
        k_first=k_first,
        thresholds=thresholds,
        keyframes=keyframes,
    )


def _points(
    sums: PointSums,
    points: WindowPoints,
    estimate: Estimate,
    config: WindowConfig,
    thresholds: Float[Tensor, "K+S"] | None,
    others: Sequence[Other],
) -> PointSystem:
    """Add static stereo and what was known of the points before."""
    rho, edges, limits = estimate.rho, sums.edges, list(sums.thresholds)
    curvature, slope, by_point, inliers = sums.curvature, sums.slope, sums.energy, sums.inliers
    K = len(limits)
    for place, other in enumerate(others):
        first, last = (int(torch.searchsorted(points.host, other.host, right=right)) for right in (False, True))
        at = slice(first, last)
        known = None if thresholds is None else thresholds[K + place]
        stereo = stereo_rows(other, points, rho, at, config, known)
        for total, part in ((curvature, stereo.curvature), (slope, stereo.slope), (by_point, stereo.energy)):
            total[at] += config.stereo_coupling * part
        inliers[at] += stereo.good
        edges += int(stereo.seen.sum())
        limits.append(stereo.threshold)
    off = rho.double() - points.rho_prior.double()
    information = points.information.double()
    return PointSystem(
        curvature=curvature.double() + information,
        slope=slope.double() + information * off,
        by_point=by_point.double() + 0.5 * information * off.square(),
        inliers=inliers,
        edges=edges,
        thresholds=torch.stack(limits),
    )
