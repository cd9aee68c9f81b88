"""Static stereo (mathematics.md, section 6): each point seen by its own host's further cameras, at the same moment.

    r = I_other(project(R ray + rho t)) - (e^a I_host + b),      T_other_host = (R, t) known and fixed

The host's pose cancels: only d r / d rho = G . t / s remains, and the known baseline gives the unit.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from torchvo360.residuals.direct import Reference, Target, by_rho, look_up
from torchvo360.residuals.weights import robust
from torchvo360.window.config import WindowConfig
from torchvo360.window.points import WindowPoints
from torchvo360.window.thresholds import judge

FIT_STEPS = 10
"""Reweightings of the brightness fit."""
FIT_PRIOR = 0.5
"""Number of pixels of full contrast that speak for one exposure."""


class Other(NamedTuple):
    """A keyframe's image by a further camera of its rig."""

    host: int
    """Place of the keyframe in the window."""
    target: Target
    T_other_host: Float64[Tensor, "4 4"]
    affine: Float64[Tensor, "2"]
    """(a, b): I_other = e^a I_host + b."""


class StereoRows(NamedTuple):
    """What one further image adds to the points of its keyframe, without the coupling's weight."""

    curvature: Float[Tensor, "n"]
    slope: Float[Tensor, "n"]
    energy: Float[Tensor, "n"]
    seen: Bool[Tensor, "n"]
    good: Bool[Tensor, "n"]
    threshold: Float[Tensor, ""]


def _reference(points: WindowPoints, rho: Float[Tensor, "N"], at: slice) -> Reference:
    return Reference(
        ray=points.ray[:, at].reshape(1, 3, -1),
        rho=rho[at].repeat_interleave(points.value.shape[1])[None],
        value=points.value[at].reshape(1, 1, -1),
        weight=points.weight[at].reshape(1, -1),
    )


def stereo_rows(
    other: Other,
    points: WindowPoints,
    rho: Float[Tensor, "N"],
    at: slice,
    config: WindowConfig,
    threshold: Float[Tensor, ""] | None,
) -> StereoRows:
    """Compare a keyframe's points with a further image of it.

    Args:
        other: The image.
        points: All points.
        rho: Their inverse distances.
        at: Those of the keyframe.
        config: Settings.
        threshold: Mean energy from which a point is an outlier; found from the points by default.
    """
    reference = _reference(points, rho, at)
    T = other.T_other_host.to(rho)[None]
    samples = look_up(reference, other.target, T, other.affine.to(rho)[None])
    robust_weight, cost = robust(samples.residual, config.loss)
    shape = points.value[at].shape
    weight = samples.weight[0, 0].view(shape)
    edge = judge(cost[0, 0].view(shape), weight, points.weight[at].sum(1), config, threshold)
    weight = weight * robust_weight[0, 0].view(shape) * edge.good[:, None]
    along = by_rho(samples, T[:, :3, 3])[0, 0].view(shape)
    return StereoRows(
        curvature=(weight * along.square()).sum(1),
        slope=(weight * along * samples.residual[0, 0].view(shape)).sum(1),
        energy=edge.energy,
        seen=edge.seen,
        good=edge.good,
        threshold=edge.threshold,
    )


def fit_brightness(other: Other, points: WindowPoints, config: WindowConfig) -> Other:
    """Return the further image with the gain and offset that its keyframe's points show, by robust least squares.

    The cameras of a rig mostly share their exposure: few or feeble points leave it so. The fit stands outside the
    joint adjustment: with the ranges held, it is closed.
    """
    first, last = (int(torch.searchsorted(points.host, other.host, right=right)) for right in (False, True))
    if last - first == 0:
        return other
    T, none = other.T_other_host.to(points.rho)[None], points.rho.new_zeros(1, 2)
    samples = look_up(_reference(points, points.rho, slice(first, last)), other.target, T, none)
    own = samples.gained[0, 0].double()
    value, known = own + samples.residual[0, 0].double(), samples.weight[0, 0].double()
    gain, offset = 1.0, 0.0
    for _ in range(FIT_STEPS):
        weight = known * robust(value - gain * own - offset, config.loss)[0]
        rows = torch.stack([own, torch.ones_like(own)])
        # Of the difference from one exposure, which the prior draws to zero.
        A = (rows * weight) @ rows.mT + FIT_PRIOR * torch.eye(2, dtype=own.dtype, device=own.device)
        change = torch.linalg.solve(A, (rows * weight) @ (value - own))
        gain, offset = 1 + float(change[0].clamp(-0.75, 3.0)), float(change[1])
    affine = torch.tensor([gain, offset], dtype=torch.float64)
    affine[0] = affine[0].log()
    return other._replace(affine=affine)
