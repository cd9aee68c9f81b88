"""One pass over the points, compiled by numba: warp, look up, compare, weigh and sum, block by block in the cache.

A block of points goes through short loops that each do one thing, over rows of one scratch array: that is what the
compiler turns into vector code, with one compiled function for all cameras, losses and numbers of channels. A part, a
fixed number of points of one pair, is one thread's work; its sums are float64, those of a block float32. Parts and
blocks depend on the number of points alone, and are added in their order: no thread changes a bit.

The formulas are those of `residuals.direct` and `residuals.weights`, where they are explained. Everything compiled is
in this file, for numba looks for changes in the file of what it has cached alone.
"""

import math

import numpy as np
import torch
from numba import get_num_threads, njit, prange, set_num_threads

from torchvo360.cameras.equirectangular import AXIS_SHIFT
from torchvo360.cameras.pinhole import MIN_DEPTH

SPHERE, PINHOLE = 0, 1
HUBER, STUDENT_T, SQUARE = 0, 1, 2

BLOCK = 256
"""Points of one block: its scratch fills most of a first cache of 32 KB."""

PART = 4096
"""Points of one thread's work, about 20 microseconds: several times what it costs to hand it out."""

SUMS = 47
"""The upper triangle of the 9 x 9 matrix row by row, the cost and the weight."""

f4 = np.float32
ZERO, HALF, ONE, TWO = f4(0), f4(0.5), f4(1), f4(2)
PI, HALF_PI = f4(math.pi), f4(math.pi / 2)
SHIFT, SHIFT2, NEAREST, TINY = f4(AXIS_SHIFT), f4(AXIS_SHIFT**2), f4(MIN_DEPTH), f4(1e-30)

# Rows of the scratch array. The last nine are those of the system: the Jacobian's columns and the residual.
X, Y, Z, RHO, INV, WEIGHT, U, V = (k * BLOCK for k in range(8))
RESIDUAL, GAINED, EACH, FORCE, COST, SHRINK, SLOPE = (k * BLOCK for k in range(8, 15))
T00, T01, T10, T11 = (k * BLOCK for k in range(15, 19))
GX, GY, GZ = T00, T01, T10  # the neighbours are not needed any more
S0, S1, S2, S3, S4, S5, S6, S7, S8 = (k * BLOCK for k in range(19, 28))
SCRATCH = 28 * BLOCK

# NaN and infinities stay what they are: they must not get past the comparisons that hold indices inside.
FAST = {"contract", "reassoc", "arcp", "nsz"}


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _arctan2(y, x):
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


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _warp(s, n, x, y, z, rho, weight, T):
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


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _project_sphere(s, n, fx, fy, cx, cy):
    for i in range(n):
        x, y, z = s[X + i], s[Y + i], s[Z + i]
        horizontal2 = x * x + z * z + SHIFT2
        s[INV + i] = ONE / math.sqrt(horizontal2 + y * y)
        s[U + i] = _arctan2(x, z + SHIFT) * fx + cx
        s[V + i] = cy - _arctan2(y, math.sqrt(horizontal2)) * fy


@njit(cache=True, error_model="numpy")
def _project_pinhole(s, n, fx, fy, cx, cy):
    # Rounded after every step, as elsewhere: at the identity the outermost pixels lie on the border of what is seen.
    for i in range(n):
        inv_z = ONE / max(s[Z + i], NEAREST)
        s[INV + i] = inv_z
        s[U + i] = s[X + i] * inv_z * fx + cx
        s[V + i] = s[Y + i] * inv_z * fy + cy


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _wrap(s, n, period):
    inv_period = ONE / period
    for i in range(n):
        u = s[U + i]
        u -= math.floor(u * inv_period) * period
        u = u + period if u < ZERO else u
        s[U + i] = u - period if u >= period else u


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _hide_unseen(s, n, last_u, last_v, nearest):
    """Let points out of view weigh nothing and stand in as one ahead: behind a pinhole they would be of any size."""
    for i in range(n):
        u, v = s[U + i], s[V + i]
        seen = (u >= HALF) & (u <= last_u) & (v >= HALF) & (v <= last_v) & (s[Z + i] > nearest)
        s[X + i] = s[X + i] if seen else ZERO
        s[Y + i] = s[Y + i] if seen else ZERO
        s[Z + i] = s[Z + i] if seen else ONE
        s[INV + i] = s[INV + i] if seen else ONE
        s[WEIGHT + i] = s[WEIGHT + i] if seen else ZERO


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _locate(s, index, n, height, width):
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


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _gather(s, index, n, image, pitch):
    right, below = np.uintp(1), np.uintp(pitch)
    for i in range(n):
        j = np.uintp(index[i])
        s[T00 + i] = image[j]
        s[T01 + i] = image[j + right]
        s[T10 + i] = image[j + below]
        s[T11 + i] = image[j + below + right]


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _doubt(s, n):
    """Weigh by the confidence that was gathered."""
    for i in range(n):
        across = s[U + i]
        upper = s[T00 + i] + across * (s[T01 + i] - s[T00 + i])
        lower = s[T10 + i] + across * (s[T11 + i] - s[T10 + i])
        s[WEIGHT + i] *= upper + s[V + i] * (lower - upper)


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _compare(s, n, kind, value, gain, offset, saturation, fx, fy, polar2):
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


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _shrink(s, n, variance, T, noise):
    """Find the root of the range weight, `depth_variance_weight`, and its slope."""
    t0, t1, t2 = f4(T[0, 3]), f4(T[1, 3]), f4(T[2, 3])
    floor = TWO * noise * noise
    for i in range(n):
        by_rho = (s[GX + i] * t0 + s[GY + i] * t1 + s[GZ + i] * t2) * s[INV + i]
        spread = by_rho * variance[i]
        total = floor + by_rho * spread
        s[SHRINK + i] = math.sqrt(floor / total)
        s[SLOPE + i] = spread / total


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _weigh(s, n, loss, scale, freedom, cutoff, most, uncertain):
    """Find the robust weights and costs: a loop for each loss, for the logarithm's would be slow for all."""
    for i in range(n):
        s[FORCE + i] = abs(s[RESIDUAL + i] * s[SHRINK + i]) if uncertain else abs(s[RESIDUAL + i])
    variance = scale * scale
    if loss == HUBER:
        for i in range(n):
            size = s[FORCE + i]
            capped = min(size, scale)
            s[COST + i] = min(capped * (size - HALF * capped), most)
            s[FORCE + i] = scale / max(size, scale) if size <= cutoff else ZERO
    elif loss == STUDENT_T:
        for i in range(n):
            size = s[FORCE + i]
            square = size * size / variance
            s[COST + i] = min((freedom + ONE) * HALF * variance * f4(math.log1p(square / freedom)), most)
            s[FORCE + i] = (freedom + ONE) / (freedom + square) if size <= cutoff else ZERO
    else:
        for i in range(n):
            size = s[FORCE + i]
            s[COST + i] = min(HALF * size * size, most)
            s[FORCE + i] = ONE if size <= cutoff else ZERO
    if uncertain:
        for i in range(n):
            s[FORCE + i] *= s[SHRINK + i] * s[SHRINK + i]


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _build_rows(s, n):
    cost, weight = ZERO, ZERO
    for i in range(n):
        each = s[EACH + i]
        cost += each * s[COST + i]
        weight += each
        root = math.sqrt(each * s[FORCE + i])
        x, y, z, rho = s[X + i], s[Y + i], s[Z + i], s[RHO + i]
        gx, gy, gz = s[GX + i] * root, s[GY + i] * root, s[GZ + i] * root
        s[S0 + i] = rho * gx
        s[S1 + i] = rho * gy
        s[S2 + i] = rho * gz
        s[S3 + i] = y * gz - z * gy
        s[S4 + i] = z * gx - x * gz
        s[S5 + i] = x * gy - y * gx
        s[S6 + i] = -root * s[GAINED + i]
        s[S7 + i] = -root
        s[S8 + i] = root * s[RESIDUAL + i]
    return cost, weight


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _add_slopes(s, n, T):
    """Add what the range weight's slope adds to the rows."""
    t0, t1, t2 = f4(T[0, 3]), f4(T[1, 3]), f4(T[2, 3])
    for i in range(n):
        factor = -s[SLOPE + i] * s[INV + i] * s[S8 + i]
        gx, gy, gz = s[GX + i] * factor, s[GY + i] * factor, s[GZ + i] * factor
        s[S0 + i] += gx
        s[S1 + i] += gy
        s[S2 + i] += gz
        s[S3 + i] += t1 * gz - t2 * gy
        s[S4 + i] += t2 * gx - t0 * gz
        s[S5 + i] += t0 * gy - t1 * gx


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _add_products(s, n, M):
    """Add `S S^T` in tiles of 3 x 3, whose sums stay in registers."""
    for p in range(0, 9, 3):
        a0, a1, a2 = S0 + p * BLOCK, S1 + p * BLOCK, S2 + p * BLOCK
        for q in range(p, 9, 3):
            b0, b1, b2 = S0 + q * BLOCK, S1 + q * BLOCK, S2 + q * BLOCK
            m00, m01, m02, m10, m11, m12, m20, m21, m22 = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
            for i in range(n):
                x0, x1, x2 = s[a0 + i], s[a1 + i], s[a2 + i]
                y0, y1, y2 = s[b0 + i], s[b1 + i], s[b2 + i]
                m00 += x0 * y0
                m01 += x0 * y1
                m02 += x0 * y2
                m10 += x1 * y0
                m11 += x1 * y1
                m12 += x1 * y2
                m20 += x2 * y0
                m21 += x2 * y1
                m22 += x2 * y2
            M[p, q] += m00
            M[p, q + 1] += m01
            M[p, q + 2] += m02
            M[p + 1, q] += m10
            M[p + 1, q + 1] += m11
            M[p + 1, q + 2] += m12
            M[p + 2, q] += m20
            M[p + 2, q + 1] += m21
            M[p + 2, q + 2] += m22


@njit(cache=True)
def _element(array, b):
    """Return the b-th of a batch, or the one that all share."""
    return array[b if array.shape[0] > 1 else 0]


@njit(cache=True)
def _sum_part(s, index, b, first, last, points, images, T, affine, k, optics, loss, sums):
    """Sum the points from first to last of pair b."""
    ray, rho, value, weight, variance = points
    padded, confidence = images
    kind, wraps, wrap_again, polar2 = optics
    loss_kind, scale, freedom, cutoff, most, saturation, noise = loss
    ray, rho, value, weight = _element(ray, b), _element(rho, b), _element(value, b), _element(weight, b)
    image, T, k = _element(padded, b), T[b], _element(k, b)
    fx, fy, cx, cy = k[0], k[1], k[2], k[3]
    C, height, width = image.shape[0], image.shape[1] - 2, image.shape[2] - 2
    pitch = width + 2
    gain, offset = f4(math.exp(f4(affine[b, 0]))), f4(affine[b, 1])
    period = f4(width) if wraps else abs(fx) * (TWO * PI)
    nearest = NEAREST if kind == PINHOLE else f4(-np.inf)
    M, total_cost, total_weight = np.zeros((9, 9)), 0.0, 0.0
    for at in range(first, last, BLOCK):
        end = min(at + BLOCK, last)
        n = end - at
        _warp(s, n, ray[0, at:end], ray[1, at:end], ray[2, at:end], rho[at:end], weight[at:end], T)
        if kind == SPHERE:
            _project_sphere(s, n, fx, fy, cx, cy)
            if wrap_again:
                _wrap(s, n, period)
        else:
            _project_pinhole(s, n, fx, fy, cx, cy)
        if not wraps:
            _hide_unseen(s, n, f4(width - 0.5), f4(height - 0.5), nearest)
        _locate(s, index, n, height, width)
        if confidence.size:
            _gather(s, index, n, _element(confidence, b)[0].reshape(-1), pitch)
            _doubt(s, n)
        for c in range(C):
            _gather(s, index, n, image[c].reshape(-1), pitch)
            _compare(s, n, kind, value[c, at:end], gain, offset, saturation, fx, fy, polar2)
            if variance.size:
                _shrink(s, n, _element(variance, b)[at:end], T, noise)
            _weigh(s, n, loss_kind, scale, freedom, cutoff, most, variance.size > 0)
            block_cost, block_weight = _build_rows(s, n)
            if variance.size:
                _add_slopes(s, n, T)
            _add_products(s, n, M)
            total_cost += block_cost
            total_weight += block_weight
    m = 0
    for p in range(9):
        for q in range(p, 9):
            sums[m] = M[p, q]
            m += 1
    sums[45], sums[46] = total_cost, total_weight


@njit(cache=True, nogil=True)
def _sum_parts(worker, workers, parts, points, images, T, affine, k, optics, loss, sums):
    """Sum every so many of the parts, in one scratch array: in memory newly given by the system every page costs."""
    s, index = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32)
    N = points[1].shape[1]
    for task in range(worker, len(sums), workers):
        b, first = task // parts, task % parts * PART
        _sum_part(s, index, b, first, min(first + PART, N), points, images, T, affine, k, optics, loss, sums[task])


@njit(cache=True, nogil=True, parallel=True)
def _sum_in_threads(workers, parts, points, images, T, affine, k, optics, loss, sums):
    # Nothing else here: numba hands an innocent np.zeros out to all threads, and waits for them.
    for worker in prange(workers):
        _sum_parts(worker, workers, parts, points, images, T, affine, k, optics, loss, sums)


def sum_pairs(
    points: tuple[np.ndarray, ...],
    images: tuple[np.ndarray, np.ndarray],
    T: np.ndarray,
    affine: np.ndarray,
    k: np.ndarray,
    optics: tuple[int, bool, bool, np.float32],
    loss: tuple[int, np.float32, np.float32, np.float32, np.float32, np.float32, np.float32],
    threads: int,
) -> np.ndarray:
    """Sum all pairs, each divided into parts of `PART` points. Nothing is checked: wrong shapes read foreign memory.

    Args:
        points: Rays [B, 3, N], inverse ranges [B, N], values [B, C, N], weights [B, N], and variances [B, N] or an
            empty array; C-contiguous float32, each with a batch axis of B or of 1, which all share.
        images: Padded images [B, C, Hp, Wp], and their confidences [B, 1, Hp, Wp] or an empty array; likewise.
        T: Poses [B, 4, 4], float64.
        affine: (a, b) of each pair [B, 2], float64.
        k: Intrinsics [B, 4] or [1, 4], float32.
        optics: SPHERE or PINHOLE; whether the image wraps; whether u is still to be brought into one turn; the square
            of the cosine of the latitude from which on a gradient along u is held.
        loss: HUBER, STUDENT_T or SQUARE; scale; degrees of freedom; cut-off; cost there; saturation; noise.
        threads: How many to use at most; no more than numba is allowed.

    Returns:
        [B, SUMS], float64.
    """
    B, N = len(T), points[1].shape[1]
    parts = max((N + PART - 1) // PART, 1)
    sums = np.zeros((B * parts, SUMS))
    arguments = parts, points, images, T, affine, k, optics, loss, sums
    workers = min(threads, B * parts)
    if workers <= 1:
        # Without the threading layer, which takes its time and dies in a process forked from one that has used it.
        _sum_parts(0, 1, *arguments)
    else:
        before = get_num_threads()
        set_num_threads(min(workers, before))
        try:
            _sum_in_threads(workers, *arguments)
        finally:
            set_num_threads(before)
    return sums.reshape(B, parts, SUMS).sum(1)


def _start_threads() -> None:
    """Start numba's threads, which sets OpenMP's number of them, torch's too if both share it, and put that back."""
    threads = torch.get_num_threads()
    get_num_threads()
    torch.set_num_threads(threads)


_start_threads()
