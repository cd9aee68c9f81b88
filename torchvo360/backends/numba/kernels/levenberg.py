"""Levenberg-Marquardt of pairs in one call: what `solve.minimize` does with the direct alignment, on arrays.

A step is proposed, its candidate linearised and judged (`steps`), for every pair by itself. On one thread a pair is
solved to its end before the next begins; on several all go in step, and the parts of those that have not ended are
handed out together. Either way a pair gets the same bits.
"""

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined
from torchvo360.backends.numba.kernels.pairs import PART, SUMS, element, in_threads, sum_in_threads, sum_part
from torchvo360.backends.numba.kernels.rigid import se3_log, times_inverse
from torchvo360.backends.numba.kernels.scratch import BLOCK, SCRATCH, f4
from torchvo360.backends.numba.kernels.steps import begin, find_candidate, judge, places

EQUATIONS = 75
"""Numbers of a pair's normal equations of (v, w, a, b)."""


@inlined(fastmath=FAST)
def weigh_ranges(rho, weight):
    """Return the sums of weights, and of weights times inverse ranges."""
    total, near = 0.0, 0.0
    for i in range(len(rho)):
        w = np.float64(weight[i])
        total += w
        near += w * np.float64(rho[i])
    return total, near


@inlined()
def find_scale(points, per_radian, scale):
    """Write each pair's factors from steps of (v, w, a, b) to comparable units: of v by the mean inverse range."""
    rho, weight = points[1], points[3]
    for b in range(len(scale)):
        if b == 0 or rho.shape[0] > 1 or weight.shape[0] > 1:
            total, near = weigh_ranges(element(rho, b), element(weight, b))
            by_v = near / max(total, 1e-12) * per_radian
        else:
            by_v = scale[0, 0]
        for p in range(8):
            scale[b, p] = by_v if p < 3 else (per_radian if p < 6 else 1.0)


@inlined()
def add_up(sums, b, T, prior, row):
    """Write normal equations: the sums of a pair's parts in their order, and the prior's, to first order.

    The first part's sums are overwritten.
    """
    total = sums[0]
    for part in range(1, len(sums)):
        for m in range(SUMS):
            total[m] += sums[part, m]
    m = 0
    at_g, at_cost, at_weight, at_square = places(8)
    for p in range(8):
        for q in range(p, 8):
            row[p * 8 + q] = row[q * 8 + p] = total[m]
            m += 1
        row[at_g + p] = total[m]
        m += 1
    row[at_square], row[at_cost], row[at_weight] = total[44], total[45], total[46]
    T_prior, information = prior
    if information.size:
        known = element(information, b)
        d = se3_log(times_inverse(T, element(T_prior, b)))
        for p in range(6):
            pull = 0.0
            for q in range(6):
                pull += known[p, q] * d[q]
                row[p * 8 + q] += known[p, q]
            row[at_g + p] += pull
            row[at_cost] += 0.5 * d[p] * pull


@inlined()
def go_on(b, first, sums, prior, state, candidate, scale, free, rules, outcomes):
    """Judge what has been evaluated, the start first of all; return whether a further candidate is to be evaluated."""
    add_up(sums, b, candidate[0][b], prior, candidate[2][b])
    if first:
        for m in range(EQUATIONS):
            state[2][b, m] = candidate[2][b, m]
        going = begin(b, state, free, rules, outcomes)
    else:
        going = judge(b, not first, state, candidate, free, rules, outcomes)
    return going and find_candidate(b, state, candidate, scale, free, rules, outcomes)


@compiled()
def solve_one_by_one(points, images, k, optics, loss, prior, per_radian, state, candidate, free, rules, outcomes):
    """Solve pair after pair."""
    T, affine = candidate[0], candidate[1]
    B, N = len(T), points[1].shape[1]
    s, index = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32)
    scale, sums = np.empty((B, 8)), np.empty((max((N + PART - 1) // PART, 1), SUMS))
    find_scale(points, per_radian, scale)
    for b in range(B):
        going, first = True, True
        while going:
            for part in range(len(sums)):
                last = min((part + 1) * PART, N)
                sum_part(s, index, b, part * PART, last, points, images, T, affine, k, optics, loss, sums[part])
            going = go_on(b, first, sums, prior, state, candidate, scale, free, rules, outcomes)
            first = False


@compiled()
def solve_in_step(workers, points, images, k, optics, loss, prior, per_radian, state, candidate, free, rules, outcomes):
    """Evaluate all pairs that have not ended together, in threads, step by step."""
    T, affine = candidate[0], candidate[1]
    B, parts = len(T), max((points[1].shape[1] + PART - 1) // PART, 1)
    scale, sums, places = np.empty((B, 8)), np.empty((B * parts, SUMS)), np.arange(B)
    find_scale(points, per_radian, scale)
    count, first = B, True
    while count:
        tasks = count * parts
        workers = min(workers, tasks)
        sum_in_threads(workers, parts, places[:count], points, images, T, affine, k, optics, loss, sums[:tasks])
        left = 0
        for at in range(count):
            b = places[at]
            own = sums[at * parts : (at + 1) * parts]
            if go_on(b, first, own, prior, state, candidate, scale, free, rules, outcomes):
                places[left] = b
                left += 1
        count, first = left, False


def solve_pairs(
    points: tuple[np.ndarray, ...],
    images: tuple[np.ndarray, np.ndarray],
    T: np.ndarray,
    affine: np.ndarray,
    k: np.ndarray,
    optics: tuple[int, bool, bool, np.float32],
    loss: tuple[int | np.float32, ...],
    prior: tuple[np.ndarray, np.ndarray],
    per_radian: float,
    free: np.ndarray,
    rules: tuple[int | float | bool, ...],
    outcomes: tuple[int, ...],
    threads: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Solve every pair from its own start. Nothing is checked: wrong shapes read foreign memory.

    Args:
        points: As in `pairs.sum_pairs`, as are the images, k, the optics and the loss.
        images: Likewise.
        T: Starts [B, 4, 4], float64.
        affine: (a, b) to start from [B, 2], float64.
        k: Intrinsics.
        optics: The camera.
        loss: The robust loss.
        prior: Poses [B, 4, 4] and their information [B, 6, 6], float64, with a batch axis of B or of 1; or empty.
        per_radian: Pixels to a radian: the unit of a rotation's steps.
        free: 1 for parameters that are estimated, 0 for others [8], float64.
        rules: Most steps; whether damping follows the gain ratio; damping to start from; most damping; tolerance of
            steps; of costs; least share of the cost that a refused step must have promised; least weight; farthest
            position; most log gain; least pivot.
        outcomes: Codes of going on, converged, out of steps, stalled, singular, too few pixels, diverged.
        threads: How many to use at most; no more than numba is allowed.

    Returns:
        T [B, 4, 4], (a, b) [B, 2], normal equations [B, EQUATIONS], status [B] and steps [B].
    """
    B, parts = len(T), max(-(-points[1].shape[1] // PART), 1)
    status, steps = np.zeros(B, np.int64), np.zeros(B, np.int64)
    equations, proposed = np.empty((2, B, EQUATIONS))
    state = T.copy(), affine.copy(), equations, np.empty((B, 2)), status, steps
    candidate = T.copy(), affine.copy(), proposed, np.empty((B, 8))
    arguments = points, images, k, optics, loss, prior, per_radian, state, candidate, free, rules, outcomes
    workers = min(threads, B * parts)
    if workers <= 1:
        solve_one_by_one(*arguments)
    else:
        with in_threads(workers):
            solve_in_step(workers, *arguments)
    return state[0], state[1], equations, status, steps
