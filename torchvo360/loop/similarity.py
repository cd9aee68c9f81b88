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
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from torchvo360 import lie, pairs
from torchvo360.agreement import agreeing_share
from torchvo360.alignment import AlignConfig
from torchvo360.backends import linearize, numba, use_numba
from torchvo360.loop.ranges import MIN_RANGE_SIGMA, NEAR_RAD, SLOPE, RangePairs, RangePoints, pair_ranges
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
        S_a_b = lie.sim3_inverse(S_b_a)
        return self.ranges_both_ways(S_b_a, S_a_b, -lie.sim3_adjoint(S_a_b))

    def ranges_forward(self, S_b_a: Float64[Tensor, "K 4 4"]) -> RangePairs:
        """Return the comparison of A's points in B."""
        _, b, some_a, _ = self._range_points
        return pair_ranges(some_a, b, S_b_a)

    def ranges_both_ways(
        self, S_b_a: Float64[Tensor, "K 4 4"], S_a_b: Float64[Tensor, "K 4 4"], J_back: Float64[Tensor, "K 7 7"]
    ) -> tuple[RangePairs, RangePairs]:
        """Return what `ranges` does, given the inverse and its step by one of S_b_a, -Ad(S_a_b)."""
        a, _, _, some_b = self._range_points
        backward = pair_ranges(some_b, a, S_a_b)
        return self.ranges_forward(S_b_a), backward._replace(J=backward.J @ J_back.to(backward.J))

    @cached_property
    def _range_points(self) -> tuple[RangePoints, RangePoints, RangePoints, RangePoints]:
        """All of A's and B's, and those of A and B that are compared."""
        a, b = (_range_points(points) for points in (self.points_a, self.points_b))
        return a, b, a.thinned(self.range_points), b.thinned(self.range_points)

    @cached_property
    def compiled(self) -> tuple[numba.OneWay, numba.OneWay]:
        """Return A into B and B into A as the compiled solve takes them."""
        a, b, some_a, some_b = self._range_points
        near_a, near_b = (numba.range_arrays(*points, ordered=True) for points in (a, b))
        compared_a, compared_b = (numba.range_arrays(*points, ordered=False) for points in (some_a, some_b))
        return (
            numba.OneWay(self.points_a, self.image_b, compared_a, near_b),
            numba.OneWay(self.points_b, self.image_a, compared_b, near_a),
        )


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
    J_back = -lie.sim3_adjoint(S_a_b)
    ways = ((pair.points_a, pair.image_b, affine[:, :2]), (pair.points_b, pair.image_a, affine[:, 2:]))
    both, scales = rigid(torch.stack([S_b_a, S_a_b]).flatten(0, 1))
    found = [
        linearize(points.repeated(K), image.repeated(K), T, ab, loss, noise=noise)
        for (points, image, ab), T in zip(ways, both.split(K), strict=True)
    ]
    # How a step of S moves either rigid step, whose translation is in the scale of the frame it starts from.
    J = S_b_a.new_zeros(2, K, 8, 11)
    J[0, :, :6, :7] = torch.eye(6, 7, dtype=J.dtype, device=J.device)
    J[1, :, :6, :7] = J_back[:, :6]
    J[:, :, :3] /= scales.view(2, K, 1, 1)
    J[0, :, 6, 7] = J[0, :, 7, 8] = J[1, :, 6, 9] = J[1, :, 7, 10] = 1.0
    H, g, cost, weight, square = (torch.stack(parts) for parts in zip(*found, strict=True))
    H, g = (J.mT @ H @ J).sum(0), (J.mT @ g[..., None])[..., 0].sum(0)
    H, g, cost, square = (part / noise**2 for part in (H, g, cost.sum(0), square.sum(0)))

    difference, trust, J_r = (
        torch.cat(parts, 1) for parts in zip(*pair.ranges_both_ways(S_b_a, S_a_b, J_back), strict=True)
    )
    w, c = robust(difference * trust.sqrt(), RANGE_LOSS)
    paired, total = trust > 0, (trust * w).double()
    J_r, difference = J_r.double(), difference.double()
    weighted = J_r * total[..., None]
    H[:, :7, :7] += weighted.mT @ J_r
    g[:, :7] += (weighted.mT @ difference[..., None])[..., 0]
    cost = cost + (c * paired).sum(-1, dtype=torch.float64)
    square = square + (total * difference.square()).sum(-1)
    return NormalEquations(H, g, cost, weight.sum(0) + paired.sum(-1), square)


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

    per_radian = 1 / pair.image_b.camera.pixel_angle
    scale = [float(pair.points_b.rho.mean()) * per_radian] * 3 + [per_radian] * 4 + [1.0] * 4
    solver = replace(config.solver, max_steps=max_steps)
    if _serves(pair, S_b_a, affine):
        solved = numba.solve_similarities(
            *(pair.compiled, S_b_a, affine, config.loss),
            noise=config.noise,
            ranges=(NEAR_RAD, SLOPE, MIN_RANGE_SIGMA**2, RANGE_LOSS.degrees_of_freedom),
            scale=scale,
            rules=pairs.rules_of(solver, config.min_pixels, MAX_TRANSLATION, MAX_LOG_GAIN),
            limits=(MAX_STEP, MAX_SCALE),
            outcomes=pairs.OUTCOMES,
        )
        return Solution((solved.S_b_a, solved.affine), solved.equations, solved.status, solved.steps)

    def evaluate(state: tuple[Tensor, ...], _: Int64[Tensor, "A"]) -> NormalEquations:
        return linearize_similarity(pair, state[0], state[1], config.loss, config.noise)

    def retract(state: tuple[Tensor, ...], delta: Float[Tensor, "A 11"]) -> tuple[Tensor, ...]:
        return lie.sim3_exp(delta[:, :7].clamp(-MAX_STEP, MAX_STEP)) @ state[0], state[1] + delta[:, 7:]

    return minimize(
        evaluate,
        retract,
        (S_b_a, affine),
        solver,
        step_scale=S_b_a.new_tensor(scale).expand(S_b_a.shape[0], -1),
        free=torch.ones(11, dtype=torch.bool, device=S_b_a.device),
        min_weight=config.min_pixels,
        sensible=_is_sensible,
    )


def _serves(pair: LevelPair, *float64: Tensor) -> bool:
    """Return whether the compiled solve takes these points and images, and starts."""
    ways = ((pair.points_a, pair.image_b), (pair.points_b, pair.image_a))
    return use_numba(*float64) and all(pairs.serves(*way, *float64) and way[0].rho.numel() > 0 for way in ways)


def _is_sensible(state: tuple[Tensor, ...]) -> Bool[Tensor, "K"]:
    """Return which states are within any scene, any ratio of scales and any exposure."""
    S, affine = state
    volume = torch.linalg.det(S[:, :3, :3])
    near = S[:, :3, 3].abs().amax(-1) < MAX_TRANSLATION
    return near & (volume > MAX_SCALE**-3) & (volume < MAX_SCALE**3) & (affine[:, ::2].abs().amax(-1) < MAX_LOG_GAIN)
