"""Levenberg-Marquardt of a similarity as one compiled call: tensors to arrays, and rows to normal equations."""

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from torchvo360.backends.numba.arrays import as_arrays
from torchvo360.backends.numba.kernel import kernel
from torchvo360.backends.numba.solve import Outcomes, Rules
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig

D = 11


class RangeArrays(NamedTuple):
    """Points whose ranges are compared, or among which neighbours are sought, in float32."""

    ray: np.ndarray
    """[3, N]; of those among which neighbours are sought, in the order of y."""
    rho: np.ndarray
    relative: np.ndarray
    """Variance over the square of rho."""


class OneWay(NamedTuple):
    """One direction of two keyframes on one level; batch axes are 1."""

    points: Reference
    image: Target
    compared: RangeArrays
    near: RangeArrays


class SolvedSimilarities(NamedTuple):
    """What became of every start."""

    S_b_a: Float64[Tensor, "K 4 4"]
    affine: Float64[Tensor, "K 4"]
    equations: NormalEquations
    status: Int64[Tensor, "K"]
    steps: Int64[Tensor, "K"]


def range_arrays(
    ray: Float[Tensor, "3 N"], rho: Float[Tensor, "N"], variance: Float[Tensor, "N"], *, ordered: bool
) -> RangeArrays:
    """Return points as arrays.

    Args:
        ray: Unit rays.
        rho: Inverse distances, positive.
        variance: Of rho.
        ordered: Whether neighbours are sought among them.
    """
    index = ray[1].argsort() if ordered else slice(None)
    parts = (ray[:, index], rho[index], (variance / rho.square())[index])
    return RangeArrays(*(part.contiguous().numpy() for part in parts))


def solve_similarities(
    ways: tuple[OneWay, OneWay],
    S_b_a: Float64[Tensor, "K 4 4"],
    affine: Float64[Tensor, "K 4"],
    loss: LossConfig,
    *,
    noise: float,
    ranges: tuple[float, float, float, float],
    scale: list[float],
    rules: Rules,
    limits: tuple[float, float],
    outcomes: Outcomes,
) -> SolvedSimilarities:
    """Solve one level from every start, by (v, w, sigma, a, b, a, b).

    Args:
        ways: A into B, and B into A; as `serves` takes them.
        S_b_a: Starts.
        affine: Brightness to start from, from A to B and from B to A.
        loss: Of the photometric residuals.
        noise: Standard deviation of an intensity.
        ranges: Largest chord of neighbours, slope of surfaces, least variance, degrees of freedom of the loss.
        scale: Turns a step into comparable units [11].
        rules: Of the solver.
        limits: Largest component of a step; largest ratio of scales.
        outcomes: How they are called.
    """
    frames, k, optics = [], None, None
    for at, way in enumerate(ways):
        own = affine[:1, 2 * at : 2 * at + 2]
        points, images, _, _, k, optics, robust = as_arrays(way.points, way.image, S_b_a[:1], own, loss, noise)
        frames.append((points, images, robust, tuple(way.compared), tuple(way.near)))
    arrays: tuple[Any, ...] = S_b_a.contiguous().numpy(), affine.contiguous().numpy(), k, optics
    S, ab, rows, status, steps = kernel("similarity").solve_similarities(
        tuple(frames), *arrays, noise, ranges, np.array(scale), tuple(rules), limits, tuple(outcomes)
    )
    numbers = torch.from_numpy(rows)
    H, g = numbers[:, : D * D].view(-1, D, D), numbers[:, D * D : D * D + D]
    equations = NormalEquations(H, g, *numbers[:, D * D + D :].unbind(1))
    S, ab, status, steps = (torch.from_numpy(part) for part in (S, ab, status, steps))
    return SolvedSimilarities(S, ab, equations, status, steps)
