"""The window: keyframes and points that are adjusted together, and the prior that stands for all that came before."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.checks import InputError
from torchvo360.residuals.inertial import Preintegrated
from torchvo360.window.calibration import at_intrinsics, intrinsics_of, unit_rays
from torchvo360.window.elimination import reduce
from torchvo360.window.equations import GAUGE_WEIGHT, WindowEquations
from torchvo360.window.inertial import Coupling, linearize_coupling
from torchvo360.window.layout import Layout
from torchvo360.window.points import WindowPoints
from torchvo360.window.prior import First, Prior, difference, eliminate
from torchvo360.window.settle import settle_points
from torchvo360.window.state import PER_FRAME, Estimate, Metric, WindowFrame
from torchvo360.window.system import LEAST_CURVATURE

DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-6, 1e3


class Adjustment(NamedTuple):
    """How an optimisation went."""

    energy_before: float
    energy_after: float
    steps: int
    inlier_share: float
    """Edges within their keyframe's threshold."""


@dataclass
class Window(WindowEquations):
    """Keyframes, points and prior as they come, are adjusted, and go."""

    def add_frame(self, frame: WindowFrame, segment: Preintegrated | None = None) -> None:
        """Add a keyframe as the newest. The first is held where it is, from the start.

        A first keyframe that is held and later marginalised as if it had been free ruins the trajectory (measured): the
        prior that holds it is marginalised with it.

        Args:
            frame: The keyframe; with its motion where there is a coupling.
            segment: What the IMU measured since the last one, a batch of one, where there is a coupling.
        """
        before = self.layout
        if self.config.calibrate:
            if self.intrinsics is None:
                self.intrinsics = self.start = intrinsics_of(frame.target.camera)
            frame = _recalibrated(frame, self.intrinsics)
        self.frames.append(frame if self.frames else frame.linearised())
        if self.prior is None:
            held = torch.full((PER_FRAME,), GAUGE_WEIGHT, dtype=torch.float64)
            self.prior, before = Prior(torch.diag(held), torch.zeros_like(held)), Layout(1)
        self.prior = self.prior.widened(before, self.layout)
        if self.coupling is not None and segment is not None:
            self.coupling = self.coupling.joined(segment)

    def couple(
        self,
        coupling: Coupling,
        metric: Metric,
        motions: Float64[Tensor, "K 9"],
        information: Float64[Tensor, "12"],
    ) -> None:
        """Begin to use an IMU.

        Args:
            coupling: With the segments between the present keyframes.
            metric: Scale and gravity, as far as they are known.
            motions: Velocity and biases of the keyframes.
            information: Weights of a prior that holds the oldest keyframe's motion, then scale and gravity, to these
                values: of standard deviations, without the coupling's weight.
        """
        assert self.prior is not None
        before = self.layout
        self.coupling, self.metric = coupling, metric
        self.frames = [replace(frame, motion=motion) for frame, motion in zip(self.frames, motions, strict=True)]
        # The oldest keyframe and the metric are held to where they are now; the others are not.
        self.frames[0] = self.frames[0].linearised()
        self.first = replace(self.first, metric=metric)
        at = torch.arange(self.layout.size)
        at = torch.cat([at[self.layout.motion(0)], at[self.layout.metric]])
        self.prior = self.prior.widened(before, self.layout)
        self.prior.H[at, at] += coupling.weight * information

    def hold_scale(self, place: int = 1) -> None:
        """Hold the distance of a keyframe from the first, which gives the unit where no point does."""
        assert self.prior is not None
        frame = self.frames[place] = self.frames[place].linearised()
        first = self.frames[0]
        t = (frame.T_cam_world @ lie.se3_inverse(first.T_cam_world))[:3, 3]
        length2 = t.square().sum().clamp_min(1e-12)
        H = self.prior.H.clone()
        at = slice(place * PER_FRAME, place * PER_FRAME + 3)
        H[at, at] += GAUGE_WEIGHT * torch.outer(t, t) / length2
        self.prior = Prior(H, self.prior.g)

    def add_points(self, points: WindowPoints) -> None:
        """Add points to their hosts'."""
        self.points = points if self.points is None else self.points.joined(points)

    def uncouple(self) -> None:
        """Take the IMU out again: what it said of the poses stays in the prior, all else of it goes."""
        if self.coupling is None:
            return
        assert self.prior is not None
        layout = self.layout
        inertial = torch.arange(layout.visual, layout.size)
        self.prior = Prior(*eliminate(self.prior.H, self.prior.g, inertial))
        self.frames = [replace(frame, motion=None, motion_first=None) for frame in self.frames]
        self.coupling = self.metric = None
        self.first = replace(self.first, metric=None)

    def optimise(self, steps: int | None = None) -> Adjustment:
        """Adjust all keyframes and points by Levenberg-Marquardt; a step is judged by the next linearisation."""
        points = self.points
        assert points is not None
        estimate, others = self.estimate(points), self.others(points)
        system = self.linearize(points, estimate, None, others)
        before, damping, taken, K = system.energy, DAMPING, 0, len(self.frames)
        for _ in range(self.config.steps if steps is None else steps):
            step = system.step(damping)
            if step is None:
                break
            proposed = estimate.moved(*step)
            there = self.linearize(points, proposed, system.images.thresholds, others)
            if not there.energy < system.energy:
                damping = max(damping * 10, 1e-3)
                if damping > MOST_DAMPING:
                    break
                continue
            small = system.energy - there.energy < self.config.tolerance * system.energy
            estimate, system, taken = proposed, there, taken + 1
            damping = max(damping * 0.3, LEAST_DAMPING)
            if small:
                break
        images = system.images
        further = [
            [t for other, t in zip(others, images.thresholds[K:], strict=True) if other.host == i] for i in range(K)
        ]
        self.frames = [
            replace(
                frame,
                T_cam_world=estimate.T_cam_world[i],
                affine=estimate.affine[i],
                motion=None if estimate.motion is None else estimate.motion[i],
                thresholds=torch.stack([images.thresholds[i], *further[i]]),
            )
            for i, frame in enumerate(self.frames)
        ]
        self.metric = estimate.metric
        if estimate.intrinsics is not None:
            self.intrinsics = estimate.intrinsics
            self.frames = [_recalibrated(frame, estimate.intrinsics) for frame in self.frames]
            points = replace(points, ray=unit_rays(self.frames[0].target.camera, points.uv))
        self.points = replace(
            points, rho=estimate.rho, curvature=images.curvature.to(points.rho), inliers=images.inliers
        )
        share = float(images.inliers.sum()) / max(1, images.edges)
        return Adjustment(before, system.energy, taken, share)

    def refine_points(self, points: WindowPoints, steps: int = 3) -> WindowPoints:
        """Return points with inverse ranges settled against all keyframes, which stay where they are.

        Each point accepts or refuses its own steps.
        """
        estimate = self.estimate(points)._replace(intrinsics=None, motion=None, metric=None)
        return settle_points(self.targets, points, estimate, self.config, self.others(points), steps)

    def keep_points(self, keep: Tensor) -> None:
        """Let all other points go."""
        assert self.points is not None
        self.points = self.points.take(keep.nonzero()[:, 0])

    def drop_frame(self, place: int) -> tuple[WindowFrame, WindowPoints]:
        """Marginalise a keyframe with its points: what they say of the others becomes the prior. Return them."""
        points = self.points
        assert points is not None
        assert self.prior is not None
        hosted = points.host == place
        own = points.take(hosted.nonzero()[:, 0])
        estimate = self.estimate(own)
        others = [other for other in self.others(own) if other.host == place]
        gone = self.frames[place]
        known = [frame.thresholds for frame in self.frames if frame.thresholds is not None]
        thresholds = None
        if gone.thresholds is not None and len(known) == len(self.frames):
            thresholds = torch.cat([torch.stack([each[0] for each in known]), gone.thresholds[1:]])
        system = self.linearize_images(own, estimate, thresholds, others)
        # A curvature without end leaves a point out.
        diagonal = torch.where(system.inliers > 0, system.curvature + LEAST_CURVATURE, torch.inf)
        A, b = reduce(system.H, system.g, system.cross, diagonal, system.slope)
        d = difference(self.frames, estimate, self.first)
        H, g = self.prior.H.clone(), self.prior.g + self.prior.H @ d
        images = slice(0, self.layout.visual)
        H[images, images] += A
        g[images] -= b
        H, g = self._without_segments(place, estimate, H, g)
        H, g = eliminate(H, g, self.layout.of(place))
        # All that stay have seen the points that go: the prior holds them from now on.
        self.frames = [frame.linearised() for at, frame in enumerate(self.frames) if at != place]
        rest = points.take((~hosted).nonzero()[:, 0])
        self.points = replace(rest, host=rest.host - (rest.host > place).long())
        self.first = First(
            self.intrinsics if self.first.intrinsics is None else self.first.intrinsics,
            self.metric if self.first.metric is None else self.first.metric,
        )
        d = difference(self.frames, self.estimate(rest), self.first)
        self.prior = Prior(H, g - H @ d)
        return gone, own

    def _without_segments(
        self, place: int, estimate: Estimate, H: Float64[Tensor, "D D"], g: Float64[Tensor, "D"]
    ) -> tuple[Float64[Tensor, "D D"], Float64[Tensor, "D"]]:
        """Add the inertial segments of a keyframe that goes to the equations, and let them go with it."""
        if self.coupling is None:
            return H, g
        if place != 0:
            raise InputError(f"place: expected 0, the oldest keyframe, with an IMU, got {place}.")
        if len(self.frames) > 1:
            inertial = linearize_coupling(self.coupling, estimate, self.layout, segment=0)
            H, g = H + inertial.H, g + inertial.g
            self.coupling = self.coupling.with_segments(self.coupling.segments.take(slice(1, None)))
        return H, g


def _recalibrated(frame: WindowFrame, k: Float64[Tensor, "4"]) -> WindowFrame:
    """Return a keyframe whose image's camera has other intrinsics."""
    return replace(frame, target=replace(frame.target, camera=at_intrinsics(frame.target.camera, k)))
