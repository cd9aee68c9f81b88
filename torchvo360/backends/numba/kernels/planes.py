"""Pyramids: smooth planes, shrink them, and extend them beyond the edge as `image.pad_image` does.

Planes are [P, H, W], flat and C-contiguous. Rows go through short loops over flat arrays: these become vector code, and
compile several times faster than views of rows.
"""

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined
from torchvo360.backends.numba.kernels.scratch import ONE, ZERO, f4

QUARTER = f4(0.25)

u = np.uintp  # where an index might be negative, numba asks at every access, and no vector code comes of it


@inlined(fastmath=FAST)
def scale(into, at, source, first, n, factor):
    """Write part of a row times a factor."""
    at, first = u(at), u(first)
    for x in range(u(n)):
        into[at + x] = factor * source[first + x]


@inlined(fastmath=FAST)
def add(into, at, source, first, n, factor):
    """Add part of a row times a factor."""
    at, first = u(at), u(first)
    for x in range(u(n)):
        into[at + x] += factor * source[first + x]


@inlined(fastmath=FAST)
def convolve_five(into, at, source, first, pitch, n, t0, t1, t2, t3, t4):
    """Write a weighted sum of five rows, or of one row at five places."""
    at, a, b, c = u(at), u(first), u(first + pitch), u(first + 2 * pitch)
    d, e = u(first + 3 * pitch), u(first + 4 * pitch)
    for x in range(u(n)):
        into[at + x] = (
            t0 * source[a + x] + t1 * source[b + x] + t2 * source[c + x] + t3 * source[d + x] + t4 * source[e + x]
        )


@inlined()
def convolve(into, at, source, first, pitch, n, taps):
    """Write a weighted sum of rows, or of one row at several places."""
    if len(taps) == 5:
        convolve_five(into, at, source, first, pitch, n, taps[0], taps[1], taps[2], taps[3], taps[4])
        return
    scale(into, at, source, first, n, taps[0])
    for j in range(1, len(taps)):
        add(into, at, source, first + j * pitch, n, taps[j])


@inlined()
def extend(row, at, margin, W, wraps):
    """Fill both ends of a row whose middle is there."""
    middle, end = at + margin, at + margin + W
    for x in range(margin):
        row[at + x] = row[at + W + x] if wraps else row[middle]
        row[end + x] = row[middle + x] if wraps else row[end - 1]


@inlined()
def add_beyond(row, radius, plane, at, y, H, W, factor, wraps):
    """Add the row that stands at y, above or below the image."""
    if wraps:
        beyond, half = at + W * (-1 - y if y < 0 else 2 * H - 1 - y), W // 2
        add(row, radius, plane, beyond + half, W - half, factor)
        add(row, radius + W - half, plane, beyond, half, factor)
    else:
        add(row, radius, plane, at + W * (0 if y < 0 else H - 1), W, factor)


@compiled()
def blur_planes(planes, shape, taps, wraps, out):
    """Convolve planes with taps along both axes, around the seam and over the poles."""
    P, H, W = shape
    radius = len(taps) // 2
    row = np.empty(W + 2 * radius, f4)
    for p in range(P):
        at = p * H * W
        for y in range(H):
            if radius <= y < H - radius:
                convolve(row, radius, planes, at + W * (y - radius), W, W, taps)
            else:
                row[:] = ZERO
                for j in range(len(taps)):
                    source = y + j - radius
                    if 0 <= source < H:
                        add(row, radius, planes, at + W * source, W, taps[j])
                    else:
                        add_beyond(row, radius, planes, at, source, H, W, taps[j], wraps)
            extend(row, 0, radius, W, wraps)
            convolve(out, at + W * y, row, 0, 1, W, taps)


@inlined(fastmath=FAST)
def halve(source, first, W, into, at, n):
    """Write the means of squares of 2 x 2 pixels."""
    at, upper, lower = u(at), u(first), u(first + W)
    for x in range(u(n)):
        j = u(2) * x
        into[at + x] = (
            source[upper + j] + source[upper + j + u(1)] + source[lower + j] + source[lower + j + u(1)]
        ) * QUARTER


@inlined()
def shrink(source, first, W, rows, into, at, n):
    """Write the means over the whole pixels of some rows that each new pixel of a row touches."""
    for x in range(n):
        left, right = x * W // n, ((x + 1) * W + n - 1) // n
        total = ZERO
        for i in range(rows):
            for j in range(left, right):
                total += source[first + i * W + j]
        into[at + x] = total / f4(rows * (right - left))


@compiled()
def shrink_levels(levels, P, sizes):
    """Fill all levels but the first, each from the one before by means.

    Args:
        levels: [P, h, w] of every level one after the other, flat.
        P: Planes of a level.
        sizes: (h, w) of every level, the finest first.
    """
    before = 0
    for level in range(1, len(sizes)):
        H, W, h, w = sizes[level - 1, 0], sizes[level - 1, 1], sizes[level, 0], sizes[level, 1]
        after = before + P * H * W
        for p in range(P):
            for y in range(h):
                at, plane = after + (p * h + y) * w, before + p * H * W
                if h == H and w == W:
                    scale(levels, at, levels, plane + y * W, W, ONE)
                elif 2 * h == H and 2 * w == W:
                    halve(levels, plane + 2 * y * W, W, levels, at, w)
                else:
                    top, bottom = y * H // h, ((y + 1) * H + h - 1) // h
                    shrink(levels, plane + top * W, W, bottom - top, levels, at, w)
        before = after


@compiled()
def pad_levels(levels, first, P, Q, sizes, wraps, out):
    """Extend planes of all levels by one pixel on each side.

    Args:
        levels: As `shrink_levels` has them.
        first: The first plane of a level to extend.
        P: Planes to extend.
        Q: Planes of a level.
        sizes: Likewise.
        wraps: Whether they are full panoramas.
        out: [P, h + 2, w + 2] of every level one after the other, flat.
    """
    start, at = 0, 0
    for level in range(len(sizes)):
        H, W = sizes[level, 0], sizes[level, 1]
        for p in range(P):
            for y in range(-1, H + 1):
                source = start + ((first + p) * H + min(max(y, 0), H - 1)) * W
                half = W // 2 if wraps and not 0 <= y < H else 0
                scale(out, at + 1, levels, source + half, W - half, ONE)
                scale(out, at + 1 + W - half, levels, source, half, ONE)
                extend(out, at, 1, W, wraps)
                at += W + 2
        start += Q * H * W
