"""Inverse ranges of a pyramid's levels, from what is known of the finest: before and after `planes.shrink_levels`.

What is known is a share: 1 or 0 at first, and the known part of a pixel's area at smaller levels.
"""

from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined
from torchvo360.backends.numba.kernels.planes import u
from torchvo360.backends.numba.kernels.scratch import HALF, ONE, ZERO, f4

LEAST_SHARE = f4(1e-6)


@inlined(fastmath=FAST)
def bound(values, first, shares, at, n, most):
    """Let nothing be known where a value is negative, too large or NaN."""
    first, at = u(first), u(at)
    for i in range(u(n)):
        value = values[first + i]
        shares[at + i] = shares[at + i] if (value >= ZERO) & (value <= most) else ZERO


@inlined(fastmath=FAST)
def keep_below(values, first, shares, at, n, limit):
    """Let nothing be known where a value reaches a limit."""
    first, at = u(first), u(at)
    for i in range(u(n)):
        shares[at + i] = shares[at + i] if values[first + i] < limit else ZERO


@inlined(fastmath=FAST)
def allow(allowed, first, shares, at, n):
    """Let nothing be known where it is not allowed."""
    first, at = u(first), u(at)
    for i in range(u(n)):
        shares[at + i] = shares[at + i] if allowed[first + i] else ZERO


@inlined(fastmath=FAST)
def copy_known(values, first, shares, share, into, at, n):
    """Write values where they are known, else zeros."""
    first, share, at = u(first), u(share), u(at)
    for i in range(u(n)):
        into[at + i] = values[first + i] if shares[share + i] > ZERO else ZERO


@compiled()
def open_ranges(rho, variance, allowed, usable, image, limits, levels):
    """Write inverse ranges, their variances where there are some, and 1 or 0 for what is known: the finest level.

    Args:
        rho: Inverse ranges, flat; negative or not finite is unknown.
        variance: Their variances or an empty array; likewise.
        allowed: Where they may be used, or an empty array.
        usable: Which pairs may be used at all.
        image: What must not be clipped there, or an empty array.
        limits: Of inverse ranges, variances and the image.
        levels: [2, B, N] or [3, B, N], flat.
    """
    B, total = len(usable), len(rho)
    N, most, most_variance, clipped = total // B, limits[0], limits[1], limits[2]
    shares = total + len(variance)
    for b in range(B):
        first, at = b * N, shares + b * N
        levels[at : at + N] = ONE if usable[b] else ZERO
        bound(rho, first, levels, at, N, most)
        if len(variance):
            bound(variance, first, levels, at, N, most_variance)
        if len(allowed):
            allow(allowed, first, levels, at, N)
        if len(image):
            keep_below(image, first, levels, at, N, clipped)
        copy_known(rho, first, levels, at, levels, first, N)
        if len(variance):
            copy_known(variance, first, levels, at, levels, total + first, N)


@inlined(fastmath=FAST)
def divide(levels, at, share, n):
    """Turn sums over what is known into means."""
    at, share = u(at), u(share)
    for i in range(u(n)):
        levels[at + i] /= max(levels[share + i], LEAST_SHARE)


@inlined(fastmath=FAST)
def weigh(levels, share, n, areas, area):
    """Turn shares into weights: a pixel's area where at least half of it is known."""
    share, area = u(share), u(area)
    for i in range(u(n)):
        levels[share + i] = areas[area + i] if levels[share + i] >= HALF else ZERO


@compiled()
def close_ranges(levels, values, B, sizes, areas):
    """Turn sums and shares of every level into means and weights.

    Args:
        levels: Sums of each of `values` kinds of values and the shares that are known, [values + 1, B, h, w] of every
            level one after the other, flat.
        values: How many kinds.
        B: Pairs.
        sizes: (h, w) of every level.
        areas: [h, w] of every level one after the other, flat.
    """
    at, area = 0, 0
    for level in range(len(sizes)):
        N = sizes[level, 0] * sizes[level, 1]
        share = at + values * B * N
        for kind in range(values):
            divide(levels, at + kind * B * N, share, B * N)
        for b in range(B):
            weigh(levels, share + b * N, N, areas, area)
        at, area = share + B * N, area + N
