"""Sums over what pairs show each other: how much of their gradient agrees, and how bright they are.

The samples of one pair at a time are kept. Sums are float64, those of a block float32.
"""

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined
from torchvo360.backends.numba.kernels.samples import sample_pair
from torchvo360.backends.numba.kernels.scratch import BLOCK, SCRATCH, ZERO, f4


@inlined(fastmath=FAST)
def sum_values(value, weight):
    """Return the sums of weights, and of weights times values."""
    total, weighted = ZERO, ZERO
    for i in range(len(value)):
        total += weight[i]
        weighted += weight[i] * value[i]
    return total, weighted


@inlined(fastmath=FAST)
def sum_energy(residual, value, weight, slope2, mean, tolerance2):
    """Return the gradient's energy, and that of where residuals, and where values less their mean, are explained."""
    energy, explained, by_chance = ZERO, ZERO, ZERO
    for i in range(len(value)):
        slope, r = slope2[i], residual[i]
        each, most, about = weight[i] * slope, tolerance2 * slope, value[i] - mean
        energy += each
        explained += each if r * r < most else ZERO
        by_chance += each if about * about < most else ZERO
    return energy, explained, by_chance


@compiled()
def explain_pairs(points, images, T, affine, k, optics, saturation, scale, tolerance2, sums):
    """Add up each pair's gradient energy, what of it the reference explains, and what each channel's mean would.

    Args:
        points: As in `samples.sample_pairs`, as are all but the last two.
        images: Likewise.
        T: Likewise.
        affine: Likewise.
        k: Likewise.
        optics: Likewise.
        saturation: Likewise.
        scale: Likewise.
        tolerance2: Square of the displacement that explains a residual, pixels.
        sums: [B, 3], float64; zeros.
    """
    C, N = points[2].shape[1:]
    s, index, kept = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32), np.empty((4, C, N), f4)
    for b in range(len(T)):
        sample_pair(s, index, b, points, images, T, affine, k, optics, saturation, scale, kept)
        for c in range(C):
            residual, value, weight, slope2 = kept[0, c], kept[1, c], kept[2, c], kept[3, c]
            total, weighted = 0.0, 0.0
            for at in range(0, N, BLOCK):
                parts = sum_values(value[at : at + BLOCK], weight[at : at + BLOCK])
                total += parts[0]
                weighted += parts[1]
            mean = f4(weighted / total) if total > 0 else ZERO
            for at in range(0, N, BLOCK):
                end = at + BLOCK
                each = sum_energy(residual[at:end], value[at:end], weight[at:end], slope2[at:end], mean, tolerance2)
                for m in range(3):
                    sums[b, m] += each[m]


@compiled()
def measure_pairs(points, images, T, affine, k, optics, saturation, scale, moments):
    """Write mean and variance of each pair's target and reference, where both are seen, over channels' means.

    Args:
        points: As in `samples.sample_pairs`, as are all but the last; what weighs more than the mean counts like it.
        images: Likewise.
        T: Likewise.
        affine: Zeros.
        k: Likewise.
        optics: Likewise.
        saturation: Likewise.
        scale: Likewise.
        moments: [B, 4], float64; zeros.
    """
    C, N = points[2].shape[1:]
    s, index, kept = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32), np.empty((4, C, N), f4)
    for b in range(len(T)):
        sample_pair(s, index, b, points, images, T, affine, k, optics, saturation, scale, kept)
        found, given, each, most = np.zeros(N), np.zeros(N), np.zeros(N), 0.0
        for c in range(C):
            for i in range(N):
                found[i] += kept[1, c, i] / C
                given[i] += (kept[1, c, i] - kept[0, c, i]) / C
                each[i] += kept[2, c, i] / C
                most += kept[2, c, i] / (C * N)
        total = 0.0
        for i in range(N):
            each[i] = min(each[i], most)
            total += each[i]
        total = max(total, 1e-12)
        for i in range(N):
            moments[b, 0] += each[i] / total * found[i]
            moments[b, 2] += each[i] / total * given[i]
        for i in range(N):
            moments[b, 1] += each[i] / total * (found[i] - moments[b, 0]) ** 2
            moments[b, 3] += each[i] / total * (given[i] - moments[b, 2]) ** 2
