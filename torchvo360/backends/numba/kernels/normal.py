"""Normal equations of a window: from sums of edges to keyframes' unknowns, and the points out of them."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.edges import relate
from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined

CHUNK = 128
"""Points of one product: their rows fill part of a second cache, those of one tile little of a first."""


@compiled()
def assemble(M, T_first, affine):
    """Bring the sums of all edges to the keyframes' unknowns.

    Args:
        M: [K, K, 9, 9]: S S^T of the edges of a target and a host, by the target's unknowns; its upper triangle.
        T_first: [K, 4, 4], where derivatives were taken.
        affine: [K, 2].

    Returns:
        H [8 K, 8 K] and g [8 K].
    """
    K = len(T_first)
    H, g = np.zeros((8 * K, 8 * K)), np.zeros(8 * K)
    T, L, m, right = np.empty((4, 4)), np.zeros((8, 8)), np.empty((8, 8)), np.empty((8, 8))
    for j in range(K):
        for i in range(K):
            if i == j:
                continue
            relate(T_first[j], T_first[i], T)
            for c in range(3):
                r0, r1, r2 = T[0, c], T[1, c], T[2, c]
                for r in range(3):
                    L[r, c] = L[3 + r, 3 + c] = -T[r, c]
                L[0, 3 + c] = T[2, 3] * r1 - T[1, 3] * r2
                L[1, 3 + c] = T[0, 3] * r2 - T[2, 3] * r0
                L[2, 3 + c] = T[1, 3] * r0 - T[0, 3] * r1
            L[6, 6], L[7, 7] = -1.0, -math.exp(affine[j, 0] - affine[i, 0])
            at, to = 8 * j, 8 * i
            for p in range(8):
                for q in range(8):
                    m[p, q] = M[j, i, min(p, q), max(p, q)]
                    H[at + p, at + q] += m[p, q]
            for p in range(8):
                for q in range(8):
                    total = 0.0
                    for r in range(8):
                        total += m[p, r] * L[r, q]
                    right[p, q] = total
                    H[at + p, to + q] += total
                    H[to + q, at + p] += total
            for p in range(8):
                by_host = 0.0
                for r in range(8):
                    by_host += L[r, p] * M[j, i, r, 8]
                g[at + p] += M[j, i, p, 8]
                g[to + p] += by_host
                for q in range(8):
                    total = 0.0
                    for r in range(8):
                        total += L[r, p] * right[r, q]
                    H[to + p, to + q] += total
    return H, g


@inlined(fastmath=FAST)
def add_tile(rows, p, q, n, A):
    """Add the products of four rows with four others, in registers."""
    a0, a1, a2, a3 = rows[p], rows[p + 1], rows[p + 2], rows[p + 3]
    b0, b1, b2, b3 = rows[q], rows[q + 1], rows[q + 2], rows[q + 3]
    m00, m01, m02, m03, m10, m11, m12, m13 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    m20, m21, m22, m23, m30, m31, m32, m33 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        x0, x1, x2, x3 = a0[i], a1[i], a2[i], a3[i]
        y0, y1, y2, y3 = b0[i], b1[i], b2[i], b3[i]
        m00 += x0 * y0
        m01 += x0 * y1
        m02 += x0 * y2
        m03 += x0 * y3
        m10 += x1 * y0
        m11 += x1 * y1
        m12 += x1 * y2
        m13 += x1 * y3
        m20 += x2 * y0
        m21 += x2 * y1
        m22 += x2 * y2
        m23 += x2 * y3
        m30 += x3 * y0
        m31 += x3 * y1
        m32 += x3 * y2
        m33 += x3 * y3
    A[p, q] += m00
    A[p, q + 1] += m01
    A[p, q + 2] += m02
    A[p, q + 3] += m03
    A[p + 1, q] += m10
    A[p + 1, q + 1] += m11
    A[p + 1, q + 2] += m12
    A[p + 1, q + 3] += m13
    A[p + 2, q] += m20
    A[p + 2, q + 1] += m21
    A[p + 2, q + 2] += m22
    A[p + 2, q + 3] += m23
    A[p + 3, q] += m30
    A[p + 3, q + 1] += m31
    A[p + 3, q + 2] += m32
    A[p + 3, q + 3] += m33


@inlined(fastmath=FAST)
def scale_rows(cross, root, rows, first, n):
    """Copy some points of all rows, scaled."""
    for p in range(len(cross)):
        own, row = cross[p, first : first + n], rows[p]
        for i in range(n):
            row[i] = own[i] * root[i]
        for i in range(n, CHUNK):
            row[i] = 0.0


@inlined(fastmath=FAST)
def dot(x, y, n):
    """Return the sum of products."""
    total = 0.0
    for i in range(n):
        total += x[i] * y[i]
    return total


@compiled()
def eliminate_points(cross, diagonal, slope):
    """Sum what the elimination of the points takes from the keyframes' equations.

    Args:
        cross: [D, N], mixed second derivatives; D a multiple of 4.
        diagonal: [N], the points' second derivatives, positive.
        slope: [N], their first derivatives.

    Returns:
        cross diag^-1 cross^T [D, D], and cross diag^-1 slope [D].
    """
    D, N = cross.shape
    A, b = np.zeros((D, D)), np.zeros(D)
    rows, root, pull = np.empty((D, CHUNK)), np.empty(CHUNK), np.empty(CHUNK)
    for first in range(0, N, CHUNK):
        n = min(CHUNK, N - first)
        for i in range(n):
            root[i] = 1.0 / math.sqrt(diagonal[first + i])
            pull[i] = slope[first + i] * root[i]
        scale_rows(cross, root, rows, first, n)
        for p in range(0, D, 4):
            for q in range(p, D, 4):
                add_tile(rows, p, q, CHUNK, A)
        for p in range(D):
            b[p] += dot(rows[p], pull, n)
    for p in range(D):
        for q in range(p):
            A[p, q] = A[q, p]
    return A, b


@compiled(fastmath=FAST)
def step_points(x, cross, diagonal, slope):
    """Return the points' steps, -(slope + x . cross) / diagonal."""
    D, N = cross.shape
    step = np.empty(N)
    for first in range(0, N, CHUNK):
        last = min(first + CHUNK, N)
        part = step[first:last]
        part[:] = slope[first:last]
        for p in range(D):
            row, own = cross[p, first:last], x[p]
            for i in range(len(part)):
                part[i] += row[i] * own
        for i in range(len(part)):
            part[i] /= -diagonal[first + i]
    return step
