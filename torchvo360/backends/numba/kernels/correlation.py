"""How alike an image and points are under rotations: normalised cross-correlation."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined
from torchvo360.backends.numba.kernels.lookup import gather
from torchvo360.backends.numba.kernels.pairs import place_block
from torchvo360.backends.numba.kernels.scratch import BLOCK, ONE, SCRATCH, T00, T01, T10, T11, ZERO, U, V, f4


@inlined(fastmath=FAST)
def add_moments(s, n, centred, weight):
    """Return the weighted sums of a block's interpolated values, their squares, and their products with others."""
    total, square, product = ZERO, ZERO, ZERO
    for i in range(n):
        a, b = s[U + i], s[V + i]
        upper = s[T00 + i] * (ONE - a) + s[T01 + i] * a
        lower = s[T10 + i] * (ONE - a) + s[T11 + i] * a
        value = upper * (ONE - b) + lower * b
        weighted = weight[i] * value
        total += weighted
        square += weighted * value
        product += weighted * centred[i]
    return total, square, product


@compiled()
def correlate(ray, rho, weight, centred, images, T, k, optics, out):
    """Write the correlation of an image of one channel with points for each of some rotations.

    Args:
        ray: [3, N], float32.
        rho: [N]; zeros.
        weight: [N], with a sum of 1.
        centred: The points' values less their weighted mean [N].
        images: The padded image [1, 1, Hp, Wp] and an empty array.
        T: Rotations as poses [M, 4, 4], float64.
        k: Intrinsics [4].
        optics: The camera, one that wraps.
        out: [M], float64.
    """
    s, index = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32)
    image, N, spread = images[0][0, 0], len(rho), 0.0
    for i in range(N):
        spread += np.float64(weight[i]) * np.float64(centred[i]) ** 2
    for m in range(len(T)):
        total, square, product = 0.0, 0.0, 0.0
        for at in range(0, N, BLOCK):
            end = min(at + BLOCK, N)
            place_block(s, index, at, end, ray, rho, weight, images, 0, T[m], k, optics)
            gather(s, index, end - at, image.reshape(-1), image.shape[1])
            parts = add_moments(s, end - at, centred[at:end], weight[at:end])
            total += parts[0]
            square += parts[1]
            product += parts[2]
        out[m] = product / math.sqrt(max((square - total * total) * spread, 1e-12))
