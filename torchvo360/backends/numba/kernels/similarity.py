"""Levenberg-Marquardt of two keyframes' similarity in one call: what `loop.similarity` does in steps of torch.

One level, from several starts, by (v, w, sigma, a, b, a, b).
"""

import numpy as np

from torchvo360.backends.numba.kernels.jit import compiled, inlined
from torchvo360.backends.numba.kernels.neighbours import sum_ranges
from torchvo360.backends.numba.kernels.pairs import SUMS, sum_part
from torchvo360.backends.numba.kernels.rigid import multiply
from torchvo360.backends.numba.kernels.scratch import BLOCK, SCRATCH, f4
from torchvo360.backends.numba.kernels.similarities import is_sensible, sim3_exp, split, step_of_inverse
from torchvo360.backends.numba.kernels.steps import begin, copy_motion, find_step, has_arrived, judge, places

D = 11
EQUATIONS = D * D + D + 3


@inlined()
def add_congruent(M, P, factor, row):
    """Add `P^T M P` and `P^T m` to H and g, of which [M, m] are the first rows of a matrix; P is [rows, D]."""
    n = len(P)
    at_g, _, _, _ = places(D)
    product = np.empty(n)
    for p in range(D):
        pull = 0.0
        for i in range(n):
            product[i] = 0.0
            for j in range(n):
                product[i] += M[i, j] * P[j, p]
            pull += P[i, p] * M[i, n]
        row[at_g + p] += factor * pull
        for q in range(D):
            total = 0.0
            for i in range(n):
                total += P[i, q] * product[i]
            row[q * D + p] += factor * total


@inlined()
def unfold(sums, M):
    """Write the 9 x 9 matrix of which sums hold the upper triangle."""
    m = 0
    for p in range(9):
        for q in range(p, 9):
            M[p, q] = M[q, p] = sums[m]
            m += 1


@inlined()
def spread(J, scale, way, P, Q):
    """Write how a step moves one way's rigid motion and brightness [8, D], and its ranges [4, D].

    Args:
        J: How it moves that way's similarity [7, 7].
        scale: That way's: its translation is in the unit of the frame that it starts from.
        way: 0 or 1.
        P: Of (v, w, a, b).
        Q: Of (v, sigma).
    """
    for p in range(D):
        for i in range(8):
            P[i, p] = J[i, p] / (scale if i < 3 else 1.0) if i < 6 and p < 7 else 0.0
        for i in range(4):
            Q[i, p] = J[i if i < 3 else 6, p] if p < 7 else 0.0
    P[6, 7 + 2 * way] = P[7, 8 + 2 * way] = 1.0


@compiled()
def _evaluate(s, index, S, affine, frames, k, optics, precision, ranges, row):
    """Write the normal equations of one similarity and brightness."""
    motion, S_way = np.empty((2, 4, 4)), np.empty((2, 4, 4))
    copy_motion(S, affine, S_way[0], affine)
    scale = split(S, S_way[1], motion[0], motion[1])
    J, P, Q = np.zeros((7, 7)), np.empty((8, D)), np.empty((4, D))
    sums, M, R = np.empty(SUMS), np.empty((9, 9)), np.empty((5, 5))
    _, at_cost, at_weight, at_square = places(D)
    for m in range(EQUATIONS):
        row[m] = 0.0
    for i in range(7):
        J[i, i] = 1.0
    for way in range(2):
        points, images, loss, compared, near = frames[way]
        own = affine[2 * way : 2 * way + 2].reshape(1, 2)
        sum_part(s, index, 0, 0, len(points[1][0]), points, images, motion[way : way + 1], own, k, optics, loss, sums)
        unfold(sums, M)
        if way == 1:
            step_of_inverse(S_way[1], 1.0 / scale, J)
        spread(J, scale if way == 0 else 1.0 / scale, way, P, Q)
        add_congruent(M, P, precision, row)
        cost, count = sum_ranges(S_way[way], compared, near, ranges, R)
        add_congruent(R, Q, 1.0, row)
        row[at_cost] += precision * sums[45] + cost
        row[at_square] += precision * sums[44] + R[4, 4]
        row[at_weight] += sums[46] + count


@inlined()
def find_candidate(b, state, candidate, scale, free, rules, limits, outcomes):
    """Propose steps until one is to be evaluated; return False where the solve has ended before."""
    S, affine, delta = state[0][b], state[1][b], candidate[3]
    S_new, affine_new = candidate[0][b], candidate[1][b]
    while True:
        if find_step(b, state, delta, free, rules):
            short = np.empty(7)
            for p in range(7):
                short[p] = min(max(delta[b, p], -limits[0]), limits[0])
            multiply(sim3_exp(short), S, S_new)
            for m in range(4):
                affine_new[m] = affine[m] + delta[b, 7 + m]
            if not is_sensible(S_new, affine_new, rules[8], limits[1], rules[9]):
                copy_motion(S, affine, S_new, affine_new)
            if not has_arrived(b, state, delta, scale, rules):
                return True
            # So short a step is taken without being evaluated.
            copy_motion(S_new, affine_new, S, affine)
            state[4][b] = outcomes[1]
            return False
        if not judge(b, False, state, candidate, free, rules, outcomes):
            return False


@compiled()
def _solve(frames, k, optics, precision, ranges, state, candidate, scale, free, rules, limits, outcomes):
    s, index = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32)
    for b in range(len(state[0])):
        S, affine, row = candidate[0][b], candidate[1][b], candidate[2][b]
        _evaluate(s, index, S, affine, frames, k, optics, precision, ranges, row)
        for m in range(EQUATIONS):
            state[2][b, m] = row[m]
        going = begin(b, state, free, rules, outcomes)
        while going and find_candidate(b, state, candidate, scale, free, rules, limits, outcomes):
            _evaluate(s, index, S, affine, frames, k, optics, precision, ranges, row)
            going = judge(b, True, state, candidate, free, rules, outcomes)


def solve_similarities(
    frames: tuple,
    S: np.ndarray,
    affine: np.ndarray,
    k: np.ndarray,
    optics: tuple,
    noise: float,
    ranges: tuple[float, float, float, float],
    scale: np.ndarray,
    rules: tuple,
    limits: tuple[float, float],
    outcomes: tuple[int, ...],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Solve one level from every start. Nothing is checked: wrong shapes read foreign memory.

    Args:
        frames: For A into B and for B into A: points, images and loss as `pairs.sum_pairs` takes them, with a batch
            axis of 1, and points and near points as `neighbours.sum_ranges` takes them.
        S: Starts [K, 4, 4], float64.
        affine: Brightness to start from [K, 4], float64.
        k: Intrinsics [1, 4].
        optics: The camera.
        noise: Standard deviation of an intensity.
        ranges: Settings of `neighbours.sum_ranges`.
        scale: Turns a step into comparable units [D].
        rules: As in `levenberg.solve_pairs`.
        limits: Largest component of a step; largest ratio of scales.
        outcomes: As in `levenberg.solve_pairs`.

    Returns:
        S [K, 4, 4], brightness [K, 4], normal equations [K, EQUATIONS], status [K] and steps [K].
    """
    K = len(S)
    status, steps = np.zeros(K, np.int64), np.zeros(K, np.int64)
    equations, proposed = np.empty((2, K, EQUATIONS))
    state = S.copy(), affine.copy(), equations, np.empty((K, 2)), status, steps
    candidate = S.copy(), affine.copy(), proposed, np.empty((K, D))
    scale = np.tile(scale, (K, 1))
    _solve(frames, k, optics, noise**-2, ranges, state, candidate, scale, np.ones(D), rules, limits, outcomes)
    return state[0], state[1], equations, status, steps
