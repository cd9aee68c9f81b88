"""The window's energy: what images, priors and an IMU say of keyframes and points, and its normal equations."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import InputError
from torchvo360.residuals.direct import Target
from torchvo360.solve import solve_ldl
from torchvo360.window.calibration import prior_weights
from torchvo360.window.config import MIN_KEYFRAMES, WindowConfig
from torchvo360.window.elimination import back_substitute, reduce
from torchvo360.window.energy import linearize_window
from torchvo360.window.inertial import Coupling, linearize_coupling
from torchvo360.window.layout import Layout
from torchvo360.window.points import WindowPoints
from torchvo360.window.prior import First, Prior, difference
from torchvo360.window.state import (
    PER_FRAME,
    POSE,
    Estimate,
    Metric,
    WindowFrame,
    estimate_of,
    first_poses,
)
from torchvo360.window.stereo import Other, fit_brightness
from torchvo360.window.system import LEAST_CURVATURE, WindowSystem

GAUGE_WEIGHT = 1e9
"""Of the prior that holds the first keyframe: far above what images say, far below what float64 resolves."""
GAIN_WEIGHT, OFFSET_WEIGHT = 0.15, 1e-2
"""Of the weak priors that draw (a, b) to zero."""


class Linearised(NamedTuple):
    """The energy at an estimate, and its normal equations."""

    images: WindowSystem
    """Of the images alone: the leading unknowns, and the points."""
    H: Float64[Tensor, "D D"]
    """Of all else: priors and IMU."""
    g: Float64[Tensor, "D"]
    energy: float
    """Of everything."""

    def step(self, damping: float) -> tuple[Float64[Tensor, "D"], Float64[Tensor, "N"]] | None:
        """Return the step of all unknowns and of the points under damping, None where there is none."""
        images = self.images
        diagonal = images.curvature * (1 + damping) + LEAST_CURVATURE
        reduced, b_images = reduce(images.H, images.g, images.cross, diagonal, images.slope)
        visual = slice(0, len(images.g))
        A, b = self.H.clone(), -self.g
        A[visual, visual] += reduced
        b[visual] += b_images
        curvature = self.H.diagonal().clone()
        curvature[visual] += images.H.diagonal()
        # A keyframe that sees nothing has no curvature either: it must not keep the others from moving.
        A.diagonal().add_(curvature * damping + LEAST_CURVATURE)
        x, ok = solve_ldl(A, b)
        return (x, back_substitute(x[visual], images.cross, diagonal, images.slope)) if bool(ok) else None


@dataclass
class WindowEquations:
    """What the window knows, and the equations that follow.

    Intrinsics that images cannot say are held: see `calibration.py`. With a rig static stereo gives the unit.
    """

    config: WindowConfig
    T_other_first: tuple[Float64[Tensor, "4 4"], ...] = ()
    """Poses of a rig's further cameras against the first, whose images are the targets."""
    frames: list[WindowFrame] = field(default_factory=list)
    points: WindowPoints | None = None
    prior: Prior | None = None
    intrinsics: Float64[Tensor, "4"] | None = None
    """(fx, fy, cx, cy) as they are now; None where the camera's own hold."""
    start: Float64[Tensor, "4"] | None = None
    """Where the intrinsics began: a weak prior draws them there."""
    coupling: Coupling | None = None
    """The IMU; None without one, and before it is known how the map stands to metres and to the vertical."""
    metric: Metric | None = None
    """Scale and gravity, where there is an IMU."""
    first: First = field(default_factory=First)
    """Where the prior was linearised."""

    def __post_init__(self) -> None:
        if self.config.calibrate and self.T_other_first:
            raise InputError("calibrate: expected False with a rig, whose further cameras it does not know.")

    @property
    def layout(self) -> Layout:
        """Where the unknowns stand."""
        return Layout(len(self.frames), self.config.calibrate, self.coupling is not None)

    def estimate(self, points: WindowPoints) -> Estimate:
        """Return where the keyframes and some points stand."""
        return estimate_of(self.frames, points.rho, self.intrinsics, self.metric)

    @property
    def targets(self) -> list[Target]:
        """The keyframes' images."""
        return [frame.target for frame in self.frames]

    def others(self, points: WindowPoints) -> list[Other]:
        """Return the further images of all keyframes, with the brightness that points show."""
        if self.config.stereo_coupling <= 0:
            return []
        return [
            fit_brightness(Other(place, target, T, torch.zeros(2, dtype=torch.float64)), points, self.config)
            for place, frame in enumerate(self.frames)
            for target, T in zip(frame.others, self.T_other_first, strict=False)
            if target is not None
        ]

    def _weak_prior(self, estimate: Estimate) -> tuple[Float64[Tensor, "D"], Float64[Tensor, "D"]]:
        """Return the weights that draw brightness and intrinsics to where they began, and how far they are from it."""
        weak, at = torch.zeros(2, len(self.frames), PER_FRAME, dtype=torch.float64)
        weak[:, POSE], weak[:, POSE + 1] = (GAIN_WEIGHT, OFFSET_WEIGHT) if self.config.affine else (GAUGE_WEIGHT,) * 2
        at[:, POSE:] = estimate.affine
        weights, off = [weak.flatten()], [at.flatten()]
        if estimate.intrinsics is not None:
            assert self.start is not None
            young = self.first.intrinsics is None and len(self.frames) < MIN_KEYFRAMES
            weights.append(prior_weights(self.frames[0].target.camera, young=young))
            off.append(estimate.intrinsics - self.start)
        none = torch.zeros(self.layout.size - self.layout.visual, dtype=torch.float64)
        return torch.cat([*weights, none]), torch.cat([*off, none])

    def linearize_images(
        self, points: WindowPoints, estimate: Estimate, thresholds: Tensor | None, others: Sequence[Other] = ()
    ) -> WindowSystem:
        """Return the normal equations of all keyframes and some points, without any prior."""
        T_first = None
        if self.config.first_estimates and any(frame.T_first is not None for frame in self.frames):
            T_first = first_poses(self.frames, estimate.T_cam_world)
        return linearize_window(
            self.targets,
            points,
            estimate,
            self.config,
            T_first=T_first,
            k_first=self.first.intrinsics if self.config.first_estimates else None,
            thresholds=thresholds,
            others=others,
        )

    def linearize(
        self, points: WindowPoints, estimate: Estimate, thresholds: Tensor | None, others: Sequence[Other] = ()
    ) -> Linearised:
        """Return the normal equations of all unknowns: those of the images, and all else."""
        system = self.linearize_images(points, estimate, thresholds, others)
        assert self.prior is not None
        weak, at = self._weak_prior(estimate)
        d = difference(self.frames, estimate, self.first)
        H, g = self.prior.H + torch.diag(weak), self.prior.g + self.prior.H @ d + weak * at
        energy = 0.5 * float((weak * at.square()).sum()) + float(d @ self.prior.g + 0.5 * d @ self.prior.H @ d)
        if self.coupling is not None:
            inertial = linearize_coupling(self.coupling, estimate, self.layout)
            H, g, energy = H + inertial.H, g + inertial.g, energy + inertial.energy
        return Linearised(system, H, g, system.energy + energy)
