"""Rows of the normal equations and their sums."""

import math

from torchvo360.backends.numba.kernels.jit import FAST, inlined
from torchvo360.backends.numba.kernels.scratch import (
    BLOCK,
    COST,
    EACH,
    FORCE,
    GAINED,
    GX,
    GY,
    GZ,
    INV,
    RESIDUAL,
    RHO,
    S0,
    S1,
    S2,
    S3,
    S4,
    S5,
    S6,
    S7,
    S8,
    SLOPE,
    ZERO,
    X,
    Y,
    Z,
    f4,
)


@inlined(fastmath=FAST)
def build_rows(s, n):
    """Write weighted rows; return the cost and the weight."""
    cost, weight = ZERO, ZERO
    for i in range(n):
        each = s[EACH + i]
        cost += each * s[COST + i]
        weight += each
        root = math.sqrt(each * s[FORCE + i])
        x, y, z, rho = s[X + i], s[Y + i], s[Z + i], s[RHO + i]
        gx, gy, gz = s[GX + i] * root, s[GY + i] * root, s[GZ + i] * root
        s[S0 + i] = rho * gx
        s[S1 + i] = rho * gy
        s[S2 + i] = rho * gz
        s[S3 + i] = y * gz - z * gy
        s[S4 + i] = z * gx - x * gz
        s[S5 + i] = x * gy - y * gx
        s[S6 + i] = -root * s[GAINED + i]
        s[S7 + i] = -root
        s[S8 + i] = root * s[RESIDUAL + i]
    return cost, weight


@inlined(fastmath=FAST)
def add_slopes(s, n, T):
    """Add what the range weight's slope adds to the rows."""
    t0, t1, t2 = f4(T[0, 3]), f4(T[1, 3]), f4(T[2, 3])
    for i in range(n):
        factor = -s[SLOPE + i] * s[INV + i] * s[S8 + i]
        gx, gy, gz = s[GX + i] * factor, s[GY + i] * factor, s[GZ + i] * factor
        s[S0 + i] += gx
        s[S1 + i] += gy
        s[S2 + i] += gz
        s[S3 + i] += t1 * gz - t2 * gy
        s[S4 + i] += t2 * gx - t0 * gz
        s[S5 + i] += t0 * gy - t1 * gx


@inlined(fastmath=FAST)
def add_products(s, n, M):
    """Add `S S^T` in tiles of 3 x 3, whose sums stay in registers."""
    for p in range(0, 9, 3):
        a0, a1, a2 = S0 + p * BLOCK, S1 + p * BLOCK, S2 + p * BLOCK
        for q in range(p, 9, 3):
            b0, b1, b2 = S0 + q * BLOCK, S1 + q * BLOCK, S2 + q * BLOCK
            m00, m01, m02, m10, m11, m12, m20, m21, m22 = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
            for i in range(n):
                x0, x1, x2 = s[a0 + i], s[a1 + i], s[a2 + i]
                y0, y1, y2 = s[b0 + i], s[b1 + i], s[b2 + i]
                m00 += x0 * y0
                m01 += x0 * y1
                m02 += x0 * y2
                m10 += x1 * y0
                m11 += x1 * y1
                m12 += x1 * y2
                m20 += x2 * y0
                m21 += x2 * y1
                m22 += x2 * y2
            M[p, q] += m00
            M[p, q + 1] += m01
            M[p, q + 2] += m02
            M[p + 1, q] += m10
            M[p + 1, q + 1] += m11
            M[p + 1, q + 2] += m12
            M[p + 2, q] += m20
            M[p + 2, q + 1] += m21
            M[p + 2, q + 2] += m22
