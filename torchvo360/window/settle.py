"""Settling new points: each finds its own inverse distance against keyframes that stay where they are."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from torchvo360.residuals.direct import Target
from torchvo360.window.config import WindowConfig
from torchvo360.window.energy import linearize_points
from torchvo360.window.points import WindowPoints
from torchvo360.window.state import Estimate
from torchvo360.window.stereo import Other
from torchvo360.window.system import LEAST_CURVATURE

START_DAMPING = 1e-2


def settle_points(
    targets: Sequence[Target],
    points: WindowPoints,
    estimate: Estimate,
    config: WindowConfig,
    others: Sequence[Other],
    steps: int,
) -> WindowPoints:
    """Return points after some Levenberg-Marquardt steps, which each accepts or refuses for itself.

    Args:
        targets: The keyframes' finest levels.
        points: The points.
        estimate: Where keyframes and points stand; the cameras' own intrinsics hold.
        config: Settings.
        others: Further images of the keyframes.
        steps: How many steps.
    """
    damping = torch.full_like(points.rho, START_DAMPING)
    system = linearize_points(targets, points, estimate, config, others=others)
    for _ in range(steps):
        rho = estimate.rho
        limit = 0.3 * rho.clamp_min(0.05 * float(rho.median()) if len(rho) else 0.0)
        move = -system.slope.to(rho) / (system.curvature.to(rho) * (1 + damping) + LEAST_CURVATURE)
        proposed = estimate._replace(rho=(rho + torch.clamp(move, -limit, limit)).clamp_min(0))
        there = linearize_points(targets, points, proposed, config, thresholds=system.thresholds, others=others)
        better = there.by_point < system.by_point
        estimate = estimate._replace(rho=torch.where(better, proposed.rho, rho))
        damping = torch.where(better, damping * 0.3, damping * 10)
        system = system._replace(
            **{
                name: torch.where(better, getattr(there, name), getattr(system, name))
                for name in ("curvature", "slope", "by_point", "inliers")
            }
        )
    return replace(points, rho=estimate.rho, curvature=system.curvature.to(points.rho), inliers=system.inliers)
