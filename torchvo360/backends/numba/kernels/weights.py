"""How much a residual weighs: its range's variance, and the robust loss (`residuals.weights`)."""

import math

from torchvo360.backends.numba.kernels.jit import FAST, inlined
from torchvo360.backends.numba.kernels.scratch import (
    COST,
    FORCE,
    GX,
    GY,
    GZ,
    HALF,
    HUBER,
    INV,
    ONE,
    RESIDUAL,
    SHRINK,
    SLOPE,
    STUDENT_T,
    TWO,
    ZERO,
    f4,
)


@inlined(fastmath=FAST)
def shrink(s, n, variance, T, noise):
    """Find the root of the range weight, `depth_variance_weight`, and its slope."""
    t0, t1, t2 = f4(T[0, 3]), f4(T[1, 3]), f4(T[2, 3])
    floor = TWO * noise * noise
    for i in range(n):
        by_rho = (s[GX + i] * t0 + s[GY + i] * t1 + s[GZ + i] * t2) * s[INV + i]
        spread = by_rho * variance[i]
        total = floor + by_rho * spread
        s[SHRINK + i] = math.sqrt(floor / total)
        s[SLOPE + i] = spread / total


@inlined(fastmath=FAST)
def weigh(s, n, loss, scale, freedom, cutoff, most, uncertain):
    """Find the robust weights and costs: a loop for each loss, for the logarithm's would be slow for all."""
    for i in range(n):
        s[FORCE + i] = abs(s[RESIDUAL + i] * s[SHRINK + i]) if uncertain else abs(s[RESIDUAL + i])
    variance = scale * scale
    if loss == HUBER:
        for i in range(n):
            size = s[FORCE + i]
            capped = min(size, scale)
            s[COST + i] = min(capped * (size - HALF * capped), most)
            s[FORCE + i] = scale / max(size, scale) if size <= cutoff else ZERO
    elif loss == STUDENT_T:
        for i in range(n):
            size = s[FORCE + i]
            square = size * size / variance
            s[COST + i] = min((freedom + ONE) * HALF * variance * f4(math.log1p(square / freedom)), most)
            s[FORCE + i] = (freedom + ONE) / (freedom + square) if size <= cutoff else ZERO
    else:
        for i in range(n):
            size = s[FORCE + i]
            s[COST + i] = min(HALF * size * size, most)
            s[FORCE + i] = ONE if size <= cutoff else ZERO
    if uncertain:
        for i in range(n):
            s[FORCE + i] *= s[SHRINK + i] * s[SHRINK + i]
