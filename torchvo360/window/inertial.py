"""The inertial energy of the window: what an IMU measured between neighbouring keyframes.

It is weighed against the images by the variance of an intensity: E = E_images + s^2 sum r^T Lambda r / 2 over the
segments (residuals/inertial.py).
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.residuals.inertial import ImuNoise, InertialRows, Preintegrated, gravity_basis, linearize_inertial
from torchvo360.window.layout import Layout
from torchvo360.window.state import POSE, Estimate


@dataclass(frozen=True, eq=False)
class Coupling:
    """An IMU's link to the window."""

    T_cam_imu: Float64[Tensor, "4 4"]
    noise: ImuNoise
    weight: float
    """Intensity^2: the weight of inertial residuals in the energy."""
    segments: Preintegrated
    """From each keyframe to the next: one fewer than keyframes."""

    def with_segments(self, segments: Preintegrated) -> "Coupling":
        """Return the coupling of other keyframes."""
        return Coupling(self.T_cam_imu, self.noise, self.weight, segments)

    def joined(self, segment: Preintegrated) -> "Coupling":
        """Return the coupling with one more segment, a batch of one, behind the others."""
        return self.with_segments(
            Preintegrated(*(torch.cat(pair) for pair in zip(self.segments, segment, strict=True)))
        )


class InertialSystem(NamedTuple):
    """Normal equations of all the window's unknowns, by inertial residuals alone."""

    H: Float64[Tensor, "D D"]
    g: Float64[Tensor, "D"]
    energy: float


def linearize_coupling(
    coupling: Coupling, estimate: Estimate, layout: Layout, *, segment: int | None = None
) -> InertialSystem:
    """Evaluate the inertial energy and linearise it.

    Args:
        coupling: The IMU.
        estimate: Where to linearise, with motions and scale.
        layout: Of the unknowns.
        segment: One segment alone; all by default.
    """
    assert estimate.motion is not None
    assert estimate.metric is not None
    metric, motion, T = estimate.metric, estimate.motion, estimate.T_cam_world
    at = torch.arange(len(T) - 1) if segment is None else torch.tensor([segment])
    gravity = metric.gravity
    rows = linearize_inertial(
        coupling.segments.take(at),
        T[at],
        T[at + 1],
        motion[at],
        motion[at + 1],
        metric.log_scale,
        gravity,
        coupling.T_cam_imu,
        coupling.noise,
    )
    # By the turn from the first gravity: the basis of the present one may lie elsewhere in the plane across it.
    turned = gravity_basis(gravity).mT @ gravity_basis(metric.first_gravity) / gravity.square().sum()
    by_shared = torch.cat([rows.by_shared[..., :1], rows.by_shared[..., 1:] @ turned], -1)
    J = _placed(rows._replace(by_shared=by_shared), at, layout)
    weighted = J.mT @ rows.information
    H = coupling.weight * (weighted @ J).sum(0)
    g = coupling.weight * (weighted @ rows.residual[..., None]).sum(0)[:, 0]
    square = torch.einsum("bi,bij,bj->", rows.residual, rows.information, rows.residual)
    return InertialSystem((H + H.mT) / 2, g, 0.5 * coupling.weight * float(square))


def _placed(rows: InertialRows, at: Tensor, layout: Layout) -> Float64[Tensor, "B 15 D"]:
    """Return the rows' Jacobians by all the window's unknowns."""
    J = rows.residual.new_zeros(len(at), rows.residual.shape[1], layout.size)
    for number, place in enumerate(at.tolist()):
        for by, keyframe in ((rows.by_i, place), (rows.by_j, place + 1)):
            pose = layout.pose(keyframe)
            J[number, :, pose.start : pose.start + POSE] = by[number, :, :POSE]
            J[number, :, layout.motion(keyframe)] = by[number, :, POSE:]
    J[:, :, layout.metric] = rows.by_shared
    return J
