"""Two images compared at given poses: how well they agree (`agreement`), and their brightness (`alignment.brightness`).

The formulas are explained there.
"""

import math

import numpy as np

from torchvo360.backends.numba.kernels.geometry import hide_unseen, locate, project_pinhole, project_sphere, warp, wrap
from torchvo360.backends.numba.kernels.jit import FAST, compiled
from torchvo360.backends.numba.kernels.lookup import compare, doubt, gather
from torchvo360.backends.numba.kernels.pairs import element
from torchvo360.backends.numba.kernels.scratch import (
    BLOCK,
    EACH,
    GX,
    GY,
    GZ,
    NEAREST,
    PI,
    PINHOLE,
    RESIDUAL,
    SCRATCH,
    SPHERE,
    TWO,
    ZERO,
    f4,
)


@compiled(fastmath=FAST)
def keep(s, n, at, residual, weight, slope2):
    """Copy what a block found."""
    at = np.uintp(at)
    for i in range(np.uintp(n)):
        gx, gy, gz = s[np.uintp(GX) + i], s[np.uintp(GY) + i], s[np.uintp(GZ) + i]
        residual[at + i] = s[np.uintp(RESIDUAL) + i]
        weight[at + i] = s[np.uintp(EACH) + i]
        slope2[at + i] = gx * gx + gy * gy + gz * gz


@compiled()
def look_up_pair(s, index, b, points, images, T, affine, k, optics, saturation, residual, weight, slope2):
    """Write residuals, weights and squared slopes of all channels and points of pair b, channel by channel."""
    ray, rho, value, weights, _ = points
    padded, confidence = images
    kind, wraps, wrap_again, polar2 = optics
    ray, rho, value, weights = element(ray, b), element(rho, b), element(value, b), element(weights, b)
    image, T, k = element(padded, b), T[b], element(k, b)
    fx, fy, cx, cy = k[0], k[1], k[2], k[3]
    C, height, width = image.shape[0], image.shape[1] - 2, image.shape[2] - 2
    N, pitch = len(rho), width + 2
    gain, offset = f4(math.exp(f4(affine[b, 0]))), f4(affine[b, 1])
    period = f4(width) if wraps else abs(fx) * (TWO * PI)
    nearest = NEAREST if kind == PINHOLE else f4(-np.inf)
    for at in range(0, N, BLOCK):
        end = min(at + BLOCK, N)
        n = end - at
        warp(s, n, ray[0, at:end], ray[1, at:end], ray[2, at:end], rho[at:end], weights[at:end], T)
        if kind == SPHERE:
            project_sphere(s, n, fx, fy, cx, cy)
            if wrap_again:
                wrap(s, n, period)
        else:
            project_pinhole(s, n, fx, fy, cx, cy)
        if not wraps:
            hide_unseen(s, n, f4(width - 0.5), f4(height - 0.5), nearest)
        locate(s, index, n, height, width)
        if confidence.size:
            gather(s, index, n, element(confidence, b)[0].reshape(-1), pitch)
            doubt(s, n)
        for c in range(C):
            gather(s, index, n, image[c].reshape(-1), pitch)
            compare(s, n, kind, value[c, at:end], gain, offset, saturation, fx, fy, polar2)
            keep(s, n, c * N + at, residual, weight, slope2)


@compiled(fastmath=FAST)
def sum_values(first, n, residual, weight, value, gain):
    """Return the weight of a channel, and its values' weighted sum."""
    first, total, sum_ = np.uintp(first), ZERO, ZERO
    for i in range(np.uintp(n)):
        w = weight[first + i]
        total += w
        sum_ += w * (residual[first + i] + gain * value[first + i])
    return total, sum_


@compiled(fastmath=FAST)
def sum_explained(first, n, residual, weight, slope2, value, gain, mean, tolerance2):
    """Return the gradient's energy, and how much of it residuals and values about their mean are small enough for."""
    first, energy, explained, by_chance = np.uintp(first), ZERO, ZERO, ZERO
    for i in range(np.uintp(n)):
        j = first + i
        slope, r = slope2[j], residual[j]
        each, most = weight[j] * slope, tolerance2 * slope
        without = r + gain * value[j] - mean
        energy += each
        explained += each if r * r < most else ZERO
        by_chance += each if without * without < most else ZERO
    return energy, explained, by_chance


@compiled(nogil=True)
def sum_agreement(points, images, T, affine, k, optics, saturation, tolerance2, sums):
    """Sum each pair's gradient energy, what of it is explained, and what would be by chance, as rows of `sums`.

    Args:
        points: As `kernels.pairs.sum_pairs` takes them, with `images`, `T`, `affine`, `k` and `optics`.
        images: Likewise.
        T: Likewise.
        affine: Likewise.
        k: Likewise.
        optics: Likewise.
        saturation: Values from here on are clipped.
        tolerance2: The square of the displacement that explains a residual, in radians.
        sums: [B, 3], float64; zeros.
    """
    C, N = points[2].shape[1:]
    s, index = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32)
    residual, weight, slope2 = np.empty(C * N, f4), np.empty(C * N, f4), np.empty(C * N, f4)
    for b in range(len(T)):
        look_up_pair(s, index, b, points, images, T, affine, k, optics, saturation, residual, weight, slope2)
        value, gain = element(points[2], b).reshape(-1), f4(math.exp(f4(affine[b, 0])))
        for c in range(C):
            total, sum_ = 0.0, 0.0
            for at in range(c * N, (c + 1) * N, BLOCK):
                n = min(BLOCK, (c + 1) * N - at)
                block_total, block_sum = sum_values(at, n, residual, weight, value, gain)
                total += block_total
                sum_ += block_sum
            mean = f4(sum_ / total) if total > 0 else ZERO
            for at in range(c * N, (c + 1) * N, BLOCK):
                n = min(BLOCK, (c + 1) * N - at)
                parts = sum_explained(at, n, residual, weight, slope2, value, gain, mean, tolerance2)
                sums[b, 0] += parts[0]
                sums[b, 1] += parts[1]
                sums[b, 2] += parts[2]


@compiled(nogil=True)
def measure_brightness(points, images, T, affine, k, optics, saturation, moments):
    """Write the mean and the variance of each pair's target and reference, where both are seen, as rows of `moments`.

    Args:
        points: As `kernels.pairs.sum_pairs` takes them, with `images`, `T`, `affine`, `k` and `optics`.
        images: Likewise.
        T: Likewise.
        affine: Likewise; zeros.
        k: Likewise.
        optics: Likewise.
        saturation: Values from here on are clipped.
        moments: [B, 4], float64; zeros.
    """
    C, N = points[2].shape[1:]
    s, index = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32)
    residual, weight, slope2 = np.empty(C * N, f4), np.empty(C * N, f4), np.empty(C * N, f4)
    for b in range(len(T)):
        look_up_pair(s, index, b, points, images, T, affine, k, optics, saturation, residual, weight, slope2)
        value = element(points[2], b).reshape(-1)
        found, given, each, heavy = np.zeros(N), np.zeros(N), np.zeros(N), 0.0
        for c in range(C):
            for i in range(N):
                j = c * N + i
                found[i] += (residual[j] + value[j]) / C
                given[i] += value[j] / C
                each[i] += weight[j] / C
                heavy += weight[j] / (C * N)
        total = 0.0
        for i in range(N):
            each[i] = min(each[i], heavy)
            total += each[i]
        total = max(total, 1e-12)
        for i in range(N):
            moments[b, 0] += each[i] * found[i] / total
            moments[b, 2] += each[i] * given[i] / total
        for i in range(N):
            moments[b, 1] += each[i] * (found[i] - moments[b, 0]) ** 2 / total
            moments[b, 3] += each[i] * (given[i] - moments[b, 2]) ** 2 / total
