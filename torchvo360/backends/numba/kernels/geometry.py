"""From points to places in an image: warp, project, find the cell."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, inlined
from torchvo360.backends.numba.kernels.scratch import (
    HALF,
    HALF_PI,
    INV,
    NEAREST,
    ONE,
    PI,
    RHO,
    SHIFT,
    SHIFT2,
    TINY,
    WEIGHT,
    ZERO,
    U,
    V,
    X,
    Y,
    Z,
    f4,
)


@inlined(fastmath=FAST)
def arctan2(y, x):
    """Return atan2, to 3e-7.

    Source: an odd polynomial of degree 17 for atan on [0, 1] with the least largest error, 6e-9 before rounding.
    """
    ax, ay = abs(x), abs(y)
    most, least = max(max(ax, ay), TINY), min(ax, ay)
    q = least / most
    s = q * q
    p = f4(0.0024567246499792167)
    p = p * s + f4(-0.014401358396545855)
    p = p * s + f4(0.03978122472674371)
    p = p * s + f4(-0.0723485750027518)
    p = p * s + f4(0.10498946155926954)
    p = p * s + f4(-0.1416122921796284)
    p = p * s + f4(0.19985906769611836)
    p = p * s + f4(-0.3333259702825968)
    p = (p * s + f4(0.9999998863829758)) * q
    p = HALF_PI - p if ay > ax else p
    p = PI - p if x < ZERO else p
    return -p if y < ZERO else p


@inlined(fastmath=FAST)
def warp(s, n, x, y, z, rho, weight, T):
    """Move points: their rays in the target, times the ratio of ranges."""
    r00, r01, r02, t0 = f4(T[0, 0]), f4(T[0, 1]), f4(T[0, 2]), f4(T[0, 3])
    r10, r11, r12, t1 = f4(T[1, 0]), f4(T[1, 1]), f4(T[1, 2]), f4(T[1, 3])
    r20, r21, r22, t2 = f4(T[2, 0]), f4(T[2, 1]), f4(T[2, 2]), f4(T[2, 3])
    for i in range(n):
        a, b, c, d = x[i], y[i], z[i], rho[i]
        s[X + i] = t0 * d + r00 * a + r01 * b + r02 * c
        s[Y + i] = t1 * d + r10 * a + r11 * b + r12 * c
        s[Z + i] = t2 * d + r20 * a + r21 * b + r22 * c
        s[RHO + i] = d
        s[WEIGHT + i] = weight[i]


@inlined(fastmath=FAST)
def project_sphere(s, n, fx, fy, cx, cy):
    """Find pixels of a panorama."""
    for i in range(n):
        x, y, z = s[X + i], s[Y + i], s[Z + i]
        horizontal2 = x * x + z * z + SHIFT2
        s[INV + i] = ONE / math.sqrt(horizontal2 + y * y)
        s[U + i] = arctan2(x, z + SHIFT) * fx + cx
        s[V + i] = cy - arctan2(y, math.sqrt(horizontal2)) * fy


@inlined()
def project_pinhole(s, n, fx, fy, cx, cy):
    """Find pixels of a pinhole."""
    # Rounded after every step, as elsewhere: at the identity the outermost pixels lie on the border of what is seen.
    for i in range(n):
        inv_z = ONE / max(s[Z + i], NEAREST)
        s[INV + i] = inv_z
        s[U + i] = s[X + i] * inv_z * fx + cx
        s[V + i] = s[Y + i] * inv_z * fy + cy


@inlined(fastmath=FAST)
def wrap(s, n, period):
    """Bring u into one turn."""
    inv_period = ONE / period
    for i in range(n):
        u = s[U + i]
        u -= math.floor(u * inv_period) * period
        u = u + period if u < ZERO else u
        s[U + i] = u - period if u >= period else u


@inlined(fastmath=FAST)
def hide_unseen(s, n, last_u, last_v, nearest):
    """Let points out of view weigh nothing and stand in as one ahead: behind a pinhole they would be of any size."""
    for i in range(n):
        u, v = s[U + i], s[V + i]
        seen = (u >= HALF) & (u <= last_u) & (v >= HALF) & (v <= last_v) & (s[Z + i] > nearest)
        s[X + i] = s[X + i] if seen else ZERO
        s[Y + i] = s[Y + i] if seen else ZERO
        s[Z + i] = s[Z + i] if seen else ONE
        s[INV + i] = s[INV + i] if seen else ONE
        s[WEIGHT + i] = s[WEIGHT + i] if seen else ZERO


@inlined(fastmath=FAST)
def locate(s, index, n, height, width):
    """Turn points into rays and pixels into fractions of a cell and the cell's index."""
    last_u, last_v = f4(width + 0.5), f4(height + 0.5)
    pitch = np.int32(width + 2)
    for i in range(n):
        inv = s[INV + i]
        s[X + i] *= inv
        s[Y + i] *= inv
        s[Z + i] *= inv
        s[RHO + i] *= inv
        column, row = s[U + i] + HALF, s[V + i] + HALF
        column = column if column > ZERO else ZERO  # NaN too
        row = row if row > ZERO else ZERO
        column = column if column < last_u else last_u
        row = row if row < last_v else last_v
        left, top = np.int32(column), np.int32(row)
        s[U + i] = column - f4(left)
        s[V + i] = row - f4(top)
        index[i] = np.uint32(top * pitch + left)
