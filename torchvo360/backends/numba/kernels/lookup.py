"""What an image shows at these places: gather, interpolate, compare."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, inlined
from torchvo360.backends.numba.kernels.scratch import (
    EACH,
    GAINED,
    GX,
    GY,
    GZ,
    ONE,
    RESIDUAL,
    SPHERE,
    T00,
    T01,
    T10,
    T11,
    WEIGHT,
    ZERO,
    U,
    V,
    X,
    Y,
    Z,
)


@inlined(fastmath=FAST)
def gather(s, index, n, image, pitch):
    """Fetch the four pixels about every place."""
    right, below = np.uintp(1), np.uintp(pitch)
    for i in range(n):
        j = np.uintp(index[i])
        s[T00 + i] = image[j]
        s[T01 + i] = image[j + right]
        s[T10 + i] = image[j + below]
        s[T11 + i] = image[j + below + right]


@inlined(fastmath=FAST)
def doubt(s, n):
    """Weigh by the confidence that was gathered."""
    for i in range(n):
        across = s[U + i]
        upper = s[T00 + i] + across * (s[T01 + i] - s[T00 + i])
        lower = s[T10 + i] + across * (s[T11 + i] - s[T10 + i])
        s[WEIGHT + i] *= upper + s[V + i] * (lower - upper)


@inlined(fastmath=FAST)
def compare(s, n, kind, value, gain, offset, saturation, fx, fy, polar2):
    """Interpolate what was gathered: the residuals, and gradients as covectors."""
    for i in range(n):
        across, down = s[U + i], s[V + i]
        upper_slope, lower_slope = s[T01 + i] - s[T00 + i], s[T11 + i] - s[T10 + i]
        upper, lower = s[T00 + i] + across * upper_slope, s[T10 + i] + across * lower_slope
        found = upper + down * (lower - upper)
        by_v = (lower - upper) * fy
        by_u = (upper_slope + down * (lower_slope - upper_slope)) * fx
        gained = gain * value[i]
        s[GAINED + i] = gained
        s[RESIDUAL + i] = found - gained - offset
        s[EACH + i] = s[WEIGHT + i] if found < saturation else ZERO
        x, y, z = s[X + i], s[Y + i], s[Z + i]
        if kind == SPHERE:
            horizontal2 = x * x + z * z
            inv_cos = ONE / math.sqrt(max(horizontal2, polar2))
            radial = by_v * y * inv_cos
            turn = by_u * inv_cos * inv_cos
            s[GX + i] = radial * x + turn * z
            s[GY + i] = -by_v * horizontal2 * inv_cos
            s[GZ + i] = radial * z - turn * x
        else:
            s[GX + i] = by_u
            s[GY + i] = by_v
            s[GZ + i] = -(by_u * x + by_v * y)
