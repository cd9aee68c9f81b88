"""Direct Sim(3) alignment of two keyframes: the joint least-squares problem of one level.

    S_b_a = [s R, t; 0, 1],   X_b = S_b_a X_a,   S_b_a <- exp(xi) S_b_a,   xi = [v, w, sigma]

Four kinds of rows, each over its own standard deviation, with one brightness (a, b) for either direction:

    photometric, A into B    the pose of mathematics.md, section 3, is (R, t / s), in A's scale
    photometric, B into A    likewise (R^T, -R^T t), in B's scale, with xi carried over by -Ad(S_a_b)
    range, A against B       e = log rho_b' - log rho_b: a point of A, moved into B, beside B's nearest point
    range, B against A       likewise

The photometric rows of one direction do not see the scale, and those of both see it by the length of t alone: between
coincident views the ranges give it. In both directions, because noise in rho pulls either by its square.
Source: Engel, Schoeps and Cremers, LSD-SLAM (2014), section 3.5, there one way, with rho and not its logarithm.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.agreement import agreeing_share
from torchvo360.alignment import AlignConfig
from torchvo360.backends import linearize
from torchvo360.loop.ranges import RangePairs, RangePoints, pair_ranges
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig, robust
from torchvo360.solve import Solution, minimize

RANGE_LOSS = LossConfig(name="student_t", scale=1.0, degrees_of_freedom=3.0)
"""Of normalised differences of log-ranges: occlusions give them heavy tails."""

MAX_STEP = 3.0
"""Steps are cut here, in every component: exp of more is nowhere near."""
MAX_TRANSLATION = 1e6
MAX_SCALE = 100.0
MAX_LOG_GAIN = 10.0


@dataclass(frozen=True)
class LevelPair:
    """One level of two keyframes; every batch axis is 1."""

    points_a: Reference
    points_b: Reference
    image_a: Target
    image_b: Target
    range_points: int
    """Points of either frame that are compared with the other's by their range; with all of the other's."""

    def ranges(self, S_b_a: Float64[Tensor, "K 4 4"]) -> tuple[RangePairs, RangePairs]:
        """Return the comparisons of A's points in B, and of B's in A, with derivatives by a step of S_b_a for both."""
        a, b = (_range_points(points) for points in (self.points_a, self.points_b))
        S_a_b = lie.sim3_inverse(S_b_a)
        forward = pair_ranges(a.thinned(self.range_points), b, S_b_a)
        backward = pair_ranges(b.thinned(self.range_points), a, S_a_b)
        return forward, backward._replace(J=backward.J @ -lie.sim3_adjoint(S_a_b).to(backward.J))


def _range_points(points: Reference) -> RangePoints:
    variance = torch.zeros_like(points.rho) if points.variance is None else points.variance
    return RangePoints(points.ray[0], points.rho[0], variance[0])


def rigid(S: Float64[Tensor, "K 4 4"]) -> tuple[Float64[Tensor, "K 4 4"], Float64[Tensor, "K"]]:
    """Return the rigid motion (R, t / s) of similarities, in the scale of the frame they start from, and s."""
    scale = torch.linalg.det(S[:, :3, :3]).clamp_min(1e-300).pow(1 / 3)
    return lie.se3(S[:, :3, :3] / scale[:, None, None], S[:, :3, 3] / scale[:, None]), scale


class Direction(NamedTuple):
    """One direction of a pair at one similarity, as rigid alignment sees it."""

    points: Reference
    image: Target
    T: Float64[Tensor, "1 4 4"]
    """(R, t / s) from the points' frame to the image's, in the points' scale."""
    affine: Float64[Tensor, "1 2"]

    @property
    def agreement(self) -> float:
        """Share of the gradient that agrees beyond chance."""
        return float(agreeing_share(self.points, self.image, self.T, self.affine)[0])


def directions(
    pair: LevelPair, S_b_a: Float64[Tensor, "1 4 4"], affine: Float64[Tensor, "1 4"]
) -> tuple[Direction, Direction]:
    """Return A into B, and B into A."""
    forward, _ = rigid(S_b_a)
    backward, _ = rigid(lie.sim3_inverse(S_b_a))
    return (
        Direction(pair.points_a, pair.image_b, forward, affine[:, :2]),
        Direction(pair.points_b, pair.image_a, backward, affine[:, 2:]),
    )


def _photometric(
    points: Reference,
    image: Target,
    S: Float64[Tensor, "K 4 4"],
    affine: Float64[Tensor, "K 2"],
    loss: LossConfig,
    noise: float,
) -> tuple[NormalEquations, Float64[Tensor, "K 6 7"]]:
    """Return one direction's equations by its rigid step and brightness, and how a step of S moves that rigid step."""
    T, scale = rigid(S)
    index = torch.zeros(S.shape[0], dtype=torch.int64, device=S.device)
    equations = linearize(points.take(index), image.take(index), T, affine, loss, noise=noise)
    chain = torch.eye(6, 7, dtype=S.dtype, device=S.device).repeat(S.shape[0], 1, 1)
    chain[:, :3] /= scale[:, None, None]
    return equations, chain


def linearize_similarity(
    pair: LevelPair,
    S_b_a: Float64[Tensor, "K 4 4"],
    affine: Float64[Tensor, "K 4"],
    loss: LossConfig,
    noise: float,
) -> NormalEquations:
    """Linearise the joint problem at each of K similarities.

    Args:
        pair: The level.
        S_b_a: Similarities.
        affine: Brightness (a, b) from A to B and from B to A.
        loss: Of the photometric residuals.
        noise: Standard deviation of an intensity.

    Returns:
        H and g by (v, w, sigma, a, b, a, b), in which every row has been divided by its standard deviation.
    """
    K = S_b_a.shape[0]
    S_a_b = lie.sim3_inverse(S_b_a)
    carried = -lie.sim3_adjoint(S_a_b)
    H = S_b_a.new_zeros(K, 11, 11)
    g, cost, weight, square = S_b_a.new_zeros(K, 11), S_b_a.new_zeros(K), S_b_a.new_zeros(K), S_b_a.new_zeros(K)
    for k, (points, image, S) in enumerate(
        ((pair.points_a, pair.image_b, S_b_a), (pair.points_b, pair.image_a, S_a_b))
    ):
        own = slice(2 * k, 2 * k + 2)
        equations, chain = _photometric(points, image, S, affine[:, own], loss, noise)
        J = S_b_a.new_zeros(K, 8, 11)
        J[:, :6, :7] = chain if k == 0 else chain @ carried
        J[:, 6:, 7 + 2 * k : 9 + 2 * k] = torch.eye(2, dtype=J.dtype, device=J.device)
        H = H + J.mT @ equations.H @ J / noise**2
        g = g + (J.mT @ equations.g[..., None])[..., 0] / noise**2
        cost, square = cost + equations.cost / noise**2, square + equations.square / noise**2
        weight = weight + equations.weight
    for ranges in pair.ranges(S_b_a):
        root = ranges.weight.sqrt()
        w, c = robust(ranges.difference * root, RANGE_LOSS)
        paired = ranges.weight > 0
        total = (ranges.weight * w).double()
        weighted = ranges.J.double() * total[..., None]
        H[:, :7, :7] += weighted.mT @ ranges.J.double()
        g[:, :7] += (weighted.mT @ ranges.difference.double()[..., None])[..., 0]
        cost = cost + (c * paired).sum(-1, dtype=torch.float64)
        square = square + (total * ranges.difference.square()).sum(-1)
        weight = weight + paired.sum(-1)
    return NormalEquations(H, g, cost, weight, square)


def solve_similarity(
    pair: LevelPair,
    S_b_a: Float64[Tensor, "K 4 4"],
    affine: Float64[Tensor, "K 4"],
    config: AlignConfig,
    max_steps: int,
) -> Solution:
    """Minimise the joint problem of one level from K starts, each for itself.

    Args:
        pair: The level.
        S_b_a: Starts.
        affine: Brightness (a, b) to start from, from A to B and from B to A.
        config: Loss, noise, solver and least number of pixels.
        max_steps: Most steps.

    Returns:
        The solution, whose state is (S_b_a, affine).
    """

    def evaluate(state: tuple[Tensor, ...], _: Int64[Tensor, "A"]) -> NormalEquations:
        return linearize_similarity(pair, state[0], state[1], config.loss, config.noise)

    def retract(state: tuple[Tensor, ...], delta: Float[Tensor, "A 11"]) -> tuple[Tensor, ...]:
        return lie.sim3_exp(delta[:, :7].clamp(-MAX_STEP, MAX_STEP)) @ state[0], state[1] + delta[:, 7:]

    per_radian = 1 / pair.image_b.camera.pixel_angle
    scale = [float(pair.points_b.rho.mean()) * per_radian] * 3 + [per_radian] * 4 + [1.0] * 4
    return minimize(
        evaluate,
        retract,
        (S_b_a, affine),
        replace(config.solver, max_steps=max_steps),
        step_scale=S_b_a.new_tensor(scale).expand(S_b_a.shape[0], -1),
        free=torch.ones(11, dtype=torch.bool, device=S_b_a.device),
        min_weight=config.min_pixels,
        sensible=_is_sensible,
    )


def _is_sensible(state: tuple[Tensor, ...]) -> Bool[Tensor, "K"]:
    """Return which states are within any scene, any ratio of scales and any exposure."""
    S, affine = state
    volume = torch.linalg.det(S[:, :3, :3])
    near = S[:, :3, 3].abs().amax(-1) < MAX_TRANSLATION
    return near & (volume > MAX_SCALE**-3) & (volume < MAX_SCALE**3) & (affine[:, ::2].abs().amax(-1) < MAX_LOG_GAIN)
