"""Edges of a window: points of all keyframes as one of them sees them, in blocks of points of one host.

A block's samples lie pattern pixel by pattern pixel, so that what one pixel of the pattern adds to its points is a row
of numbers, and sums over the pattern are sums of rows. A point's sums are float32 over its pattern and float64 over the
keyframes; a host's are float32 over a block.

The formulas are those of `window.energy`, where they are explained.
"""

import math

import numpy as np

from torchvo360.backends.numba.kernels.geometry import hide_unseen, locate, project_pinhole, project_sphere, warp, wrap
from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined
from torchvo360.backends.numba.kernels.lookup import compare, doubt, gather
from torchvo360.backends.numba.kernels.prefetch import fetch_cells
from torchvo360.backends.numba.kernels.rows import add_products, build_rows
from torchvo360.backends.numba.kernels.scratch import (
    BLOCK,
    COST,
    EACH,
    FORCE,
    GX,
    GY,
    GZ,
    HALF,
    INV,
    NEAREST,
    ONE,
    PI,
    PINHOLE,
    RESIDUAL,
    RHO,
    S0,
    S7,
    S8,
    SCRATCH,
    SHIFT2,
    SPHERE,
    TWO,
    ZERO,
    X,
    Y,
    Z,
    f4,
)
from torchvo360.backends.numba.kernels.weights import weigh

POINTS, PATTERN = 32, 8
"""Points of a block, and most pixels of a pattern. Their numbers are known when this is compiled, and so is which rows
of the scratch array overlap: loops over the points become vector code, with those over the pattern unrolled in them."""

# Rows behind those of `scratch`: the residual's derivative by rho, then numbers of the block's points.
ALONG = SCRATCH
TOTAL, MEAN, PART = (SCRATCH + BLOCK + k * POINTS for k in range(3))
EDGES_SCRATCH = SCRATCH + BLOCK + 3 * POINTS

MEANS, RANGES, ALL = 0, 1, 2
"""What is asked of a pass: the edges' mean energies; sums of the points; those of the keyframes, too."""

LEAST = f4(1e-6)
"""Weights below this are none."""


@compiled()
def pack(ray, rho, value, weight, host, affine):
    """Bring points into blocks.

    Args:
        ray: [3, N, P].
        rho: [N].
        value: [N, P].
        weight: [N, P].
        host: [N], int64, ascending.
        affine: [K, 2], float64.

    Returns:
        Points for `add_target`, and how many each keyframe hosts [K]. The points are
        samples: [B, 6, BLOCK]: rays, rho, weight and the scene's intensity.
        own: [B, POINTS]: the sums of the points' weights.
        blocks: [B, 3]: host, first point and the one behind the last.
    """
    N, P = value.shape
    count = np.zeros(len(affine), np.int64)
    for i in range(N):
        count[host[i]] += 1
    number = 0
    for h in range(len(affine)):
        number += (count[h] + POINTS - 1) // POINTS
    samples, own = np.zeros((number, 6, BLOCK), f4), np.zeros((number, POINTS), f4)
    blocks = np.empty((number, 3), np.int64)
    at, first = 0, 0
    for h in range(len(affine)):
        gain, offset = f4(math.exp(-f4(affine[h, 0]))), f4(affine[h, 1])
        last = first + count[h]
        while first < last:
            n = min(POINTS, last - first)
            blocks[at, 0], blocks[at, 1], blocks[at, 2] = h, first, first + n
            block = samples[at]
            for p in range(P):
                for i in range(n):
                    k = first + i
                    block[0, p * POINTS + i] = ray[0, k, p]
                    block[1, p * POINTS + i] = ray[1, k, p]
                    block[2, p * POINTS + i] = ray[2, k, p]
                    block[3, p * POINTS + i] = rho[k]
                    block[4, p * POINTS + i] = weight[k, p]
                    block[5, p * POINTS + i] = (value[k, p] - offset) * gain
                    own[at, i] += weight[k, p]
            at += 1
            first += n
    return (samples, own, blocks), count


@compiled()
def begin_cross(K, points):
    """Return [8 K, N], zero in the rows of the points' hosts; the others are for `add_target` to write."""
    _, _, blocks = points
    cross = np.empty((8 * K, blocks[-1, 2] if len(blocks) else 0))
    for b in range(len(blocks)):
        for c in range(8 * blocks[b, 0], 8 * blocks[b, 0] + 8):
            for i in range(blocks[b, 1], blocks[b, 2]):
                cross[c, i] = 0.0
    return cross


@inlined()
def relate(T_target, T_host, out):
    """Write T_target inv(T_host)."""
    for r in range(3):
        t = T_target[r, 3]
        for c in range(3):
            R = 0.0
            for m in range(3):
                R += T_target[r, m] * T_host[c, m]
            out[r, c] = R
            t -= R * T_host[c, 3]
        out[r, 3] = t
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@inlined()
def aim(s, index, n, block, T, image, k, optics):
    """Find where a block's samples lie in the image, and ask for its pixels there."""
    padded, confidence = image
    kind, wraps, wrap_again, _ = optics
    fx, fy, cx, cy = k[0], k[1], k[2], k[3]
    height, width = padded.shape[0] - 2, padded.shape[1] - 2
    warp(s, n, block[0], block[1], block[2], block[3], block[4], T)
    if kind == SPHERE:
        project_sphere(s, n, fx, fy, cx, cy)
        if wrap_again:
            wrap(s, n, f4(width) if wraps else abs(fx) * (TWO * PI))
    else:
        project_pinhole(s, n, fx, fy, cx, cy)
    if not wraps:
        nearest = NEAREST if kind == PINHOLE else f4(-np.inf)
        hide_unseen(s, n, f4(width - 0.5), f4(height - 0.5), nearest)
    locate(s, index, n, height, width)
    fetch_cells(index, n, padded.reshape(-1), width + 2)
    if confidence.size:
        fetch_cells(index, n, confidence.reshape(-1), width + 2)


@inlined()
def look(s, index, n, block, image, k, optics, loss, gain, offset):
    """Look samples up, compare them and weigh what comes out."""
    padded, confidence = image
    loss_kind, scale, freedom, cutoff, most, saturation, _ = loss
    pitch = padded.shape[1]
    if confidence.size:
        gather(s, index, n, confidence.reshape(-1), pitch)
        doubt(s, n)
    gather(s, index, n, padded.reshape(-1), pitch)
    compare(s, n, optics[0], block[5], gain, offset, saturation, k[0], k[1], optics[3])
    weigh(s, n, loss_kind, scale, freedom, cutoff, most, False)


@inlined(fastmath=FAST)
def average(s, own):
    """Find the points' weights in view and their mean energies, -1 where too little of the pattern is seen."""
    for i in range(POINTS):
        total, cost = ZERO, ZERO
        for p in range(PATTERN):
            each = s[EACH + p * POINTS + i]
            total += each
            cost += each * s[COST + p * POINTS + i]
        seen = total > HALF * max(own[i], LEAST)
        s[TOTAL + i] = total
        s[MEAN + i] = cost / max(total, LEAST) if seen else -ONE


@inlined(fastmath=FAST)
def refuse(s, limit):
    """Let samples of points that are outliers or hardly seen weigh nothing."""
    for i in range(POINTS):
        mean = s[MEAN + i]
        good = ONE if (mean >= ZERO) & (mean < limit) else ZERO
        for p in range(PATTERN):
            s[EACH + p * POINTS + i] *= good


@inlined(fastmath=FAST)
def place(s, n, kind, block, T):
    """Move the samples' rays and inverse ranges to where another pose sees them."""
    warp(s, n, block[0], block[1], block[2], block[3], block[4], T)
    if kind == SPHERE:
        for i in range(n):
            x, y, z = s[X + i], s[Y + i], s[Z + i]
            s[INV + i] = ONE / math.sqrt(x * x + y * y + z * z + SHIFT2)
    else:
        for i in range(n):
            s[INV + i] = ONE / max(s[Z + i], NEAREST)
    for i in range(n):
        inv = s[INV + i]
        s[X + i] *= inv
        s[Y + i] *= inv
        s[Z + i] *= inv
        s[RHO + i] *= inv


@inlined(fastmath=FAST)
def weigh_residuals(s, n):
    """Write the last two rows of the system alone: roots of the weights, negative, and weighted residuals."""
    for i in range(n):
        root = math.sqrt(s[EACH + i] * s[FORCE + i])
        s[S7 + i] = -root
        s[S8 + i] = root * s[RESIDUAL + i]


@inlined(fastmath=FAST)
def derive_by_rho(s, n, T):
    """Write the weighted derivatives by rho, G . t / s."""
    t0, t1, t2 = f4(T[0, 3]), f4(T[1, 3]), f4(T[2, 3])
    for i in range(n):
        s[ALONG + i] = -(s[GX + i] * t0 + s[GY + i] * t1 + s[GZ + i] * t2) * s[INV + i] * s[S7 + i]


@inlined(fastmath=FAST)
def sum_pattern(s, row):
    """Sum a row times the derivative by rho over the pattern."""
    for i in range(POINTS):
        total = ZERO
        for p in range(PATTERN):
            total += s[row + p * POINTS + i] * s[ALONG + p * POINTS + i]
        s[PART + i] = total


@inlined(fastmath=FAST)
def add_part(s, n, total):
    """Add the last sums to the points'."""
    for i in range(n):
        total[i] += s[PART + i]


@inlined(fastmath=FAST)
def count_edges(s, n, limit, energy, inliers):
    """Add the points' energies, those of outliers up to the limit; return how many are seen."""
    seen = 0
    for i in range(n):
        mean = s[MEAN + i]
        if mean >= ZERO:
            seen += 1
            energy[i] += min(mean, limit) * s[TOTAL + i]
            inliers[i] += mean < limit
    return seen


@inlined(fastmath=FAST)
def turn_back(d, T, gain):
    """Find the mixed derivatives of the hosts from those of the target, by -Ad^T (mathematics.md, section 6)."""
    for c in range(3):
        r0, r1, r2 = T[0, c], T[1, c], T[2, c]
        # The column of hat(t) R.
        m0, m1, m2 = T[1, 3] * r2 - T[2, 3] * r1, T[2, 3] * r0 - T[0, 3] * r2, T[0, 3] * r1 - T[1, 3] * r0
        row = c * POINTS
        for i in range(POINTS):
            x0, x1, x2 = d[i], d[POINTS + i], d[2 * POINTS + i]
            x3, x4, x5 = d[3 * POINTS + i], d[4 * POINTS + i], d[5 * POINTS + i]
            d[8 * POINTS + row + i] = -(x0 * r0 + x1 * r1 + x2 * r2)
            d[11 * POINTS + row + i] = -(x0 * m0 + x1 * m1 + x2 * m2 + x3 * r0 + x4 * r1 + x5 * r2)
    for i in range(POINTS):
        d[14 * POINTS + i] = -d[6 * POINTS + i]
        d[15 * POINTS + i] = -d[7 * POINTS + i] * gain


@inlined(fastmath=FAST)
def add_cross(s, d, T, gain, by_target, by_host, first, last):
    """Write the mixed derivatives of the target, and add those of the host."""
    for c in range(8):
        sum_pattern(s, S0 + c * BLOCK)
        for i in range(POINTS):
            d[c * POINTS + i] = s[PART + i]
    turn_back(d, T, gain)
    for c in range(8):
        target, host = by_target[c, first:last], by_host[c, first:last]
        for i in range(last - first):
            target[i] = d[c * POINTS + i]
        for i in range(last - first):
            host[i] += d[(8 + c) * POINTS + i]


@compiled()
def add_target(j, P, ask, limit, points, T, T_first, affine, image, k, optics, loss, means, sums, cross, M):
    """Compare all points with one keyframe that is not their host.

    Args:
        j: The keyframe.
        P: Pixels of the pattern.
        ask: MEANS, RANGES or ALL.
        limit: The mean energy from which an edge is an outlier.
        points: As `pack` returns them first.
        T: [K, 4, 4], T_cam_world.
        T_first: Where derivatives are taken: another [K, 4, 4], or [0, 4, 4] for the same.
        affine: [K, 2], float64.
        image: The keyframe's padded image and its confidence, [Hp, Wp] or [0, 0], float32.
        k: Its intrinsics [4], float32.
        optics: Of its camera, as `pairs.sum_pairs` takes it.
        loss: Likewise.
        means: [N], float32: written for MEANS, -1 where not seen.
        sums: [4, N], float64: curvature, slope, energy and inliers; added to for RANGES and ALL.
        cross: [8 K, N], float64: rows of the target are written, rows of the hosts are added to, for ALL.
        M: [K, 9, 9], float64: S S^T of the edges of each host; added to for ALL.

    Returns:
        The number of edges seen.
    """
    samples, own, blocks = points
    # In turn: while one block is compared, the pixels of the next are on their way.
    scratch, index = np.zeros((2, EDGES_SCRATCH), f4), np.empty((2, BLOCK), np.uint32)
    d, T_here, T_there = np.empty(16 * POINTS), np.empty((4, 4)), np.empty((4, 4))
    at = T_first if T_first.shape[0] > 0 else T
    gain, offset = f4(math.exp(f4(affine[j, 0]))), f4(affine[j, 1])
    edges, n, turn, waiting = 0, P * POINTS, 0, -1
    for b in range(len(blocks) + 1):
        if b < len(blocks):
            if blocks[b, 0] == j:
                continue
            relate(T[j], T[blocks[b, 0]], T_here)
            aim(scratch[turn], index[turn], n, samples[b], T_here, image, k, optics)
        turn = 1 - turn
        c, waiting = waiting, b
        if c < 0:
            continue
        s, i, first, last = scratch[turn], blocks[c, 0], blocks[c, 1], blocks[c, 2]
        look(s, index[turn], n, samples[c], image, k, optics, loss, gain, offset)
        average(s, own[c])
        if ask == MEANS:
            for m in range(last - first):
                means[first + m] = s[MEAN + m]
            continue
        edges += count_edges(s, last - first, limit, sums[2, first:last], sums[3, first:last])
        refuse(s, limit)
        relate(at[j], at[i], T_there)
        if T_first.shape[0] > 0:
            place(s, n, optics[0], samples[c], T_there)
        if ask == ALL:
            build_rows(s, n)
        else:
            weigh_residuals(s, n)
        derive_by_rho(s, n, T_there)
        sum_pattern(s, ALONG)
        add_part(s, last - first, sums[0, first:last])
        sum_pattern(s, S8)
        add_part(s, last - first, sums[1, first:last])
        if ask == ALL:
            gained = math.exp(affine[j, 0] - affine[i, 0])
            add_cross(s, d, T_there, gained, cross[8 * j : 8 * j + 8], cross[8 * i : 8 * i + 8], first, last)
            add_products(s, n, M[i])
    return edges
