"""Tracing of new points: the walk along great circles by five samples, and the whole pattern at the best places.

The compiled form of `_walk` and `_pattern_cost` of `window.trace`, where they are explained, without their tensors of
all points, places and samples: 105,000 look-ups of a walk and 250,000 of the patterns for 800 points.
"""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined
from torchvo360.backends.numba.kernels.scratch import ONE, ZERO, f4
from torchvo360.backends.numba.kernels.sight import desk, see

SAMPLES = 5


@inlined(fastmath=FAST)
def _along(x, y, z, n, start, towards, i, cosine, sine):
    """Write the first n directions of a curve."""
    a, b, c = start[0, i], start[1, i], start[2, i]
    d, e, f = towards[0, i], towards[1, i], towards[2, i]
    for j in range(n):
        x[j] = a * cosine[j] + d * sine[j]
        y[j] = b * cosine[j] + e * sine[j]
        z[j] = c * cosine[j] + f * sine[j]


@inlined(fastmath=FAST)
def _compare(seen, samples, i, n, most, never, ssd):
    """Write the sums of five squared differences at n places, from the second number on."""
    a, b, c, d, e = samples[i, 0], samples[i, 1], samples[i, 2], samples[i, 3], samples[i, 4]
    for j in range(n):
        p, q, r, s, t = (
            abs(seen[j] - a),
            abs(seen[j + 1] - b),
            abs(seen[j + 2] - c),
            abs(seen[j + 3] - d),
            abs(seen[j + 4] - e),
        )
        # A NaN stays one, and its sum is then not less than what stands for never.
        p = most if p > most else p
        q = most if q > most else q
        r = most if r > most else r
        s = most if s > most else s
        t = most if t > most else t
        total = p * p + q * q + r * r + s * s + t * t
        ssd[j + 1] = total if total < never else never


@inlined(fastmath=FAST)
def _valleys(ssd, n, never, valley):
    """Write the n sums again where they are lower than around; of a level stretch only the first: it is one place."""
    for j in range(n):
        here = ssd[j + 1]
        lowest = (here < ssd[j]) & (here <= ssd[j + 2])
        valley[j] = here if lowest else never


@inlined()
def _reach(theta, limit):
    """Return how many places, the third angle the first of them, lie nearer than a limit."""
    most = len(theta) - SAMPLES + 1
    n = min(max(int(limit / (theta[3] - theta[2])), 0), most)
    while n > 0 and theta[n + 1] >= limit:
        n -= 1
    while n < most and theta[n + 2] < limit:
        n += 1
    return n


@compiled()
def walk(start, towards, limit, samples, theta, cosine, sine, view, most, never, place, value):
    """Find the lowest valleys along each curve.

    Args:
        start: The curves' beginnings [3, N], float32 as all arrays here.
        towards: Their directions there [3, N].
        limit: Angles up to which they are searched [N].
        samples: What the host shows about the points [N, 5].
        theta: Angles of the places and, at both ends, of two more samples [L].
        cosine: Of theta [L].
        sine: Of theta [L].
        view: The image that is searched, as `see` has it.
        most: Bound of a difference.
        never: Stands for no match.
        place: Out: the best places in their order, numbered from the first [N, C].
        value: Out: their sums of squared differences, `never` where there are no more [N, C].
    """
    s, index = desk()
    N, C = place.shape
    L = len(theta)
    x, y, z, seen = np.zeros(L, f4), np.zeros(L, f4), np.zeros(L, f4), np.zeros(L, f4)
    ssd, valley = np.zeros(L, f4), np.zeros(L, f4)
    ssd[0] = never
    for i in range(N):
        for c in range(C):
            place[i, c], value[i, c] = ZERO, never
        n = _reach(theta, limit[i])
        if n == 0:
            continue
        _along(x, y, z, n + SAMPLES - 1, start, towards, i, cosine, sine)
        see(s, index, x, y, z, n + SAMPLES - 1, view, seen)
        _compare(seen, samples, i, n, most, never, ssd)
        ssd[n + 1] = never
        _valleys(ssd, n, never, valley)
        for j in range(n):
            here = valley[j]
            if here < value[i, C - 1]:
                c = C - 1
                while c > 0 and here < value[i, c - 1]:
                    place[i, c], value[i, c] = place[i, c - 1], value[i, c - 1]
                    c -= 1
                place[i, c], value[i, c] = f4(j), here


@inlined(fastmath=FAST)
def _place_pattern(x, y, z, ray, i, rho, T):
    """Write a point's pattern at all its inverse distances as rays in a view."""
    M, P = rho.shape[1], ray.shape[2]
    t0, t1, t2 = f4(T[0, 3]), f4(T[1, 3]), f4(T[2, 3])
    for p in range(P):
        a, b, c = ray[0, i, p], ray[1, i, p], ray[2, i, p]
        u = f4(T[0, 0]) * a + f4(T[0, 1]) * b + f4(T[0, 2]) * c
        v = f4(T[1, 0]) * a + f4(T[1, 1]) * b + f4(T[1, 2]) * c
        w = f4(T[2, 0]) * a + f4(T[2, 1]) * b + f4(T[2, 2]) * c
        at = p * M
        for m in range(M):
            x[at + m] = u + rho[i, m] * t0
            y[at + m] = v + rho[i, m] * t1
            z[at + m] = w + rho[i, m] * t2


@inlined(fastmath=FAST)
def _add_squares(seen, at, M, expected, weight, most, square, total):
    """Add one pixel of the pattern at all places."""
    for m in range(M):
        off = abs(seen[at + m] - expected)
        known = off < f4(math.inf)  # no NaN
        off = most if off > most else off
        square[m] += weight * off * off if known else ZERO
        total[m] += weight if known else ZERO


@compiled()
def compare_patterns(ray, reference, weight, rho, T, gain, offset, view, most, worst, sees):
    """Compare whole patterns in one view, and keep the mean square differences of the view that fits worst.

    Args:
        ray: Unit rays of the patterns in the host [3, N, P], float32.
        reference: Their intensities there [N, P].
        weight: Of each pixel [N, P].
        rho: Inverse distances to be tried [N, M].
        T: T_view_host [4, 4], float64.
        gain: e^a, float32.
        offset: b, float32.
        view: The image, as `see` has it.
        most: Bound of a difference.
        worst: In and out: the largest mean square difference so far [N, M].
        sees: In and out: whether any view sees a place [N, M].
    """
    s, index = desk()
    N, M = rho.shape
    P = ray.shape[2]
    x, y, z, seen = np.zeros(P * M, f4), np.zeros(P * M, f4), np.zeros(P * M, f4), np.zeros(P * M, f4)
    square, total = np.zeros(M, f4), np.zeros(M, f4)
    for i in range(N):
        _place_pattern(x, y, z, ray, i, rho, T)
        see(s, index, x, y, z, P * M, view, seen)
        whole = ZERO
        for m in range(M):
            square[m], total[m] = ZERO, ZERO
        for p in range(P):
            whole += weight[i, p]
            _add_squares(seen, p * M, M, gain * reference[i, p] + offset, weight[i, p], most, square, total)
        least = f4(0.5) * max(whole, f4(1e-6))
        for m in range(M):
            if total[m] > least:
                worst[i, m] = max(worst[i, m], square[m] * (ONE / max(total[m], f4(1e-6))))
                sees[i, m] = True
