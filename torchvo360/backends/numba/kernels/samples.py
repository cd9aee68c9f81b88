"""What the points of pairs meet in the images, without rows or sums."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, compiled
from torchvo360.backends.numba.kernels.lookup import compare, gather
from torchvo360.backends.numba.kernels.pairs import element, place_block
from torchvo360.backends.numba.kernels.scratch import BLOCK, EACH, GAINED, GX, GY, GZ, RESIDUAL, SCRATCH, f4


@compiled(fastmath=FAST)
def keep(s, n, scale, residual, value, weight, slope2):
    """Write out a block's samples."""
    for i in range(n):
        residual[i] = s[RESIDUAL + i]
        value[i] = s[RESIDUAL + i] + s[GAINED + i]
        weight[i] = s[EACH + i]
        gx, gy, gz = s[GX + i], s[GY + i], s[GZ + i]
        slope2[i] = (gx * gx + gy * gy + gz * gz) * scale


@compiled(nogil=True)
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
        out: [4, B, C, N], float32.
    """
    kind, _, _, polar2 = optics
    s, index = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32)
    _, B, C, N = out.shape
    for b in range(B):
        ray, rho, value, weight = element(points[0], b), element(points[1], b), element(points[2], b), points[3]
        image, each_k = element(images[0], b), element(k, b)
        gain, offset = f4(math.exp(f4(affine[b, 0]))), f4(affine[b, 1])
        for at in range(0, N, BLOCK):
            end = min(at + BLOCK, N)
            n = end - at
            place_block(s, index, at, end, ray, rho, element(weight, b), images, b, T[b], each_k, optics)
            for c in range(C):
                gather(s, index, n, image[c].reshape(-1), image.shape[2])
                compare(s, n, kind, value[c, at:end], gain, offset, saturation, each_k[0], each_k[1], polar2)
                found = out[:, b, c, at:end]
                keep(s, n, scale, found[0], found[1], found[2], found[3])
