"""What the points of pairs meet in the images, without rows or sums."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined
from torchvo360.backends.numba.kernels.lookup import compare, gather
from torchvo360.backends.numba.kernels.pairs import element, place_block
from torchvo360.backends.numba.kernels.scratch import BLOCK, EACH, GAINED, GX, GY, GZ, RESIDUAL, SCRATCH, f4


@inlined(fastmath=FAST)
def keep(s, n, scale, residual, value, weight, slope2):
    """Write out a block's samples."""
    for i in range(n):
        residual[i] = s[RESIDUAL + i]
        value[i] = s[RESIDUAL + i] + s[GAINED + i]
        weight[i] = s[EACH + i]
        gx, gy, gz = s[GX + i], s[GY + i], s[GZ + i]
        slope2[i] = (gx * gx + gy * gy + gz * gz) * scale


@inlined()
def sample_pair(s, index, b, points, images, T, affine, k, optics, saturation, scale, out):
    """Write residuals, values, weights and squared gradients of all samples of pair b, [4, C, N]."""
    kind, _, _, polar2 = optics
    ray, rho, value, weight = element(points[0], b), element(points[1], b), element(points[2], b), element(points[3], b)
    image, each_k = element(images[0], b), element(k, b)
    gain, offset = f4(math.exp(f4(affine[b, 0]))), f4(affine[b, 1])
    _, C, N = out.shape
    for at in range(0, N, BLOCK):
        end = min(at + BLOCK, N)
        n = end - at
        place_block(s, index, at, end, ray, rho, weight, images, b, T[b], each_k, optics)
        for c in range(C):
            gather(s, index, n, image[c].reshape(-1), image.shape[2])
            compare(s, n, kind, value[c, at:end], gain, offset, saturation, each_k[0], each_k[1], polar2)
            keep(s, n, scale, out[0, c, at:end], out[1, c, at:end], out[2, c, at:end], out[3, c, at:end])


@compiled()
def sample_pairs(points, images, T, affine, k, optics, saturation, scale, out):
    """Write residuals, values, weights and squared gradients of all samples.

    Args:
        points: As in `pairs.sum_pairs`, as are all but the last three; variances are not read.
        images: Likewise.
        T: Poses.
        affine: Brightness.
        k: Intrinsics.
        optics: The camera.
        saturation: Values from this on weigh nothing.
        scale: What squared gradients are multiplied by, float32.
        out: [B, 4, C, N], float32.
    """
    s, index = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32)
    for b in range(len(T)):
        sample_pair(s, index, b, points, images, T, affine, k, optics, saturation, scale, out[b])
