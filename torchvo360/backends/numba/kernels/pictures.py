"""Whole images: smoothed levels, padded for look-up, the strength of their gradient, and the strongest pixels."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined
from torchvo360.backends.numba.kernels.scratch import HALF, f4

QUARTER, STEP = f4(0.25), f4(1 / 255)
INFINITE = np.int32(0x7F800000)
"""The bits of infinity."""


@inlined(fastmath=FAST)
def _scale(row, margin, wraps, wide):
    """Write a row of 8 bits in [0, 1], with its margins."""
    W = len(row)
    for c in range(W):
        wide[margin + c] = f4(row[c]) * STEP
    for c in range(margin):
        wide[c] = wide[W + c] if wraps else wide[margin]
        wide[margin + W + c] = wide[margin + c] if wraps else wide[margin + W - 1]


@inlined(fastmath=FAST)
def _weigh(wide, taps, out):
    for c in range(len(out)):
        out[c] = taps[0] * wide[c]
    for k in range(1, len(taps)):
        tap = taps[k]
        for c in range(len(out)):
            out[c] += tap * wide[c + k]


@inlined(fastmath=FAST)
def _combine(lines, first, taps, out):
    """Write the weighted sum of lines, which begin with one of them and go around, into a padded row."""
    for c in range(lines.shape[1]):
        out[c + 1] = taps[0] * lines[first, c]
    for k in range(1, len(taps)):
        tap, line = taps[k], lines[(first + k) % len(taps)]
        for c in range(len(line)):
            out[c + 1] += tap * line[c]


@inlined()
def _turn(row, by, out):
    for c in range(by):
        out[c] = row[c + len(row) - by]
    for c in range(by, len(row)):
        out[c] = row[c - by]


@compiled()
def smooth(grey, taps, wraps, padded):
    """Smooth an image around the seam and over the poles, or with its edges repeated; borders are left to `edge`.

    Args:
        grey: 8 bits [H, W].
        taps: A symmetric filter of odd length, no longer than the image, float32.
        wraps: Whether the image is a full panorama.
        padded: Out: in [0, 1], float32 [H + 2, W + 2].
    """
    H, W = grey.shape
    size = len(taps)
    margin, half = size // 2, W // 2
    wide, turned, lines = np.empty(W + 2 * margin, f4), np.empty(W, f4), np.empty((size, W), f4)
    for j in range(-margin, H + margin):
        line = lines[(j + margin) % size]
        inside = j >= 0 and j < H
        if inside or not wraps:
            _scale(grey[min(max(j, 0), H - 1)], margin, wraps, wide)
            _weigh(wide, taps, line)
        else:
            # Across a pole the image goes on along the opposite meridian.
            _scale(grey[-1 - j if j < 0 else 2 * H - 1 - j], margin, wraps, wide)
            _weigh(wide, taps, turned)
            _turn(turned, half, line)
        row = j - margin
        if row >= 0:
            _combine(lines, row % size, taps, padded[row + 1])


@compiled()
def edge(padded, wraps):
    """Fill the border of one pixel from the image within, as `image.pad_image` does."""
    H, W = padded.shape[0] - 2, padded.shape[1] - 2
    half = W // 2 if wraps else 0
    for c in range(1, W + 1):
        opposite = c + half if c + half <= W else c + half - W
        padded[0, c], padded[H + 1, c] = padded[1, opposite], padded[H, opposite]
    for r in range(H + 2):
        padded[r, 0] = padded[r, W if wraps else 1]
        padded[r, W + 1] = padded[r, 1 if wraps else W]


@compiled(fastmath=FAST)
def halve(fine, padded):
    """Write the means of two by two pixels of a padded image into one of half the size; its border is left."""
    for r in range(padded.shape[0] - 2):
        upper, lower, out = fine[2 * r + 1], fine[2 * r + 2], padded[r + 1]
        for c in range(padded.shape[1] - 2):
            out[c + 1] = (upper[2 * c + 1] + upper[2 * c + 2] + lower[2 * c + 1] + lower[2 * c + 2]) * QUARTER


@compiled(fastmath=FAST)
def gradient_strength(padded, by_u, by_v, x, y, strength):
    """Measure the gradient by central differences: `sqrt(by_u g_u^2 + by_v g_v^2 + (x g_u + y g_v)^2)`.

    Args:
        padded: The image [H + 2, W + 2], float32 as all arrays here.
        by_u: Of each row [H].
        by_v: Likewise.
        x: Of each column [W].
        y: Of each row [H].
        strength: Out [H, W].
    """
    H, W = strength.shape
    for r in range(H):
        above, here, below, out = padded[r], padded[r + 1], padded[r + 2], strength[r]
        p, q, t = by_u[r], by_v[r], y[r]
        for c in range(W):
            g_u, g_v = (here[c + 2] - here[c]) * HALF, (below[c + 1] - above[c + 1]) * HALF
            radial = x[c] * g_u + t * g_v
            out[c] = math.sqrt(p * g_u * g_u + q * g_v * g_v + radial * radial)


@inlined()
def _rank(strength, usable, minimum, rank):
    """Write numbers in the order of the strengths: their bits, which compare faster; -1 where none is to be chosen."""
    for c in range(len(rank)):
        rank[c] = strength[c] if usable[c] else np.int32(-1)
    for c in range(len(rank)):
        rank[c] = rank[c] if (rank[c] >= minimum) & (rank[c] <= INFINITE) else np.int32(-1)  # a NaN is beyond


@compiled()
def strongest(strength, usable, minimum, first, cells, most, pixel):
    """Find the strongest usable pixel of each cell, of equals the first.

    Args:
        strength: The bits of numbers of at least 0, float32 as int32 [H, W].
        usable: Pixels that may be chosen [H, W].
        minimum: Least strength, likewise as int32.
        first: Number of the first cell of each row [H], int64.
        cells: How many there are in each row, of equal width [H], int64.
        most: Scratch, -1 for each cell, int32.
        pixel: Out: flat pixels, those of cells without one are left as they are; int64.
    """
    H, W = strength.shape
    rank = np.empty(W, np.int32)
    for r in range(H):
        _rank(strength[r], usable[r], minimum, rank)
        count = cells[r]
        begin = 0
        for k in range(count):
            end = ((k + 1) * W + count - 1) // count
            high = np.int32(-1)
            for c in range(begin, end):
                high = max(high, rank[c])
            cell = first[r] + k
            if high > most[cell]:
                most[cell] = high
                c = begin
                while rank[c] != high:
                    c += 1
                pixel[cell] = r * W + c
            begin = end
