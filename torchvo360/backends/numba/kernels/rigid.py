"""Rigid motions: exponential and logarithm of `lie` on arrays, by closed forms with series near the identity."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import inlined

SMALL = 0.25
"""Below this squared angle series are used: their first dropped term is below the rounding of float64."""


@inlined()
def rodrigues(angle2):
    """Return sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 of a squared angle t^2."""
    if angle2 >= SMALL:
        angle = math.sqrt(angle2)
        half = math.sin(0.5 * angle)
        sine = math.sin(angle)
        return sine / angle, 2.0 * half * half / angle2, (angle - sine) / (angle2 * angle)
    a, b, c = 1.0, 1.0, 1.0
    for k in range(16, 0, -2):
        a = 1.0 - angle2 / (k * (k + 1)) * a
        b = 1.0 - angle2 / ((k + 1) * (k + 2)) * b
        c = 1.0 - angle2 / ((k + 2) * (k + 3)) * c
    return a, 0.5 * b, c / 6.0


@inlined()
def identity():
    """Return the identity [4, 4]."""
    M = np.empty((4, 4))
    for i in range(4):
        for j in range(4):
            M[i, j] = 1.0 if i == j else 0.0
    return M


@inlined()
def add_skew(w, skew, square, M):
    """Add `skew * hat(w) + square * hat(w)^2` to the upper left 3 x 3 of M."""
    x, y, z = w[0], w[1], w[2]
    M[0, 0] -= square * (y * y + z * z)
    M[1, 1] -= square * (x * x + z * z)
    M[2, 2] -= square * (x * x + y * y)
    M[0, 1] += square * x * y - skew * z
    M[1, 0] += square * x * y + skew * z
    M[0, 2] += square * x * z + skew * y
    M[2, 0] += square * x * z - skew * y
    M[1, 2] += square * y * z - skew * x
    M[2, 1] += square * y * z + skew * x


@inlined()
def se3_exp(xi):
    """Return the rigid motion [4, 4] of a tangent (v, w)."""
    w = xi[3:6]
    a, b, c = rodrigues(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    T, V = identity(), identity()
    add_skew(w, a, b, T)
    add_skew(w, b, c, V)
    for i in range(3):
        T[i, 3] = V[i, 0] * xi[0] + V[i, 1] * xi[1] + V[i, 2] * xi[2]
    return T


@inlined()
def so3_log(R, w):
    """Write the rotation vector of R, of length at most pi."""
    # Of Shepperd's four solutions the one with the largest divisor.
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    i = 0 if R[0, 0] >= R[1, 1] else 1
    i = i if R[i, i] >= R[2, 2] else 2
    q = np.empty(4)
    if trace >= R[i, i]:
        q[0], q[1], q[2], q[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[j], q[k], q[3] = R[i, j] + R[j, i], R[i, k] + R[k, i], R[k, j] - R[j, k]
    if q[3] < 0.0:
        for i in range(4):
            q[i] = -q[i]
    n = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    # atan(n / w) / n, whose limit is 1 / w
    factor = 2.0 * math.atan2(n, q[3]) / n if n > 1e-9 * q[3] else 2.0 / q[3]
    for i in range(3):
        w[i] = factor * q[i]


@inlined()
def se3_log(T):
    """Return the tangent (v, w) of a rigid motion."""
    xi = np.empty(6)
    w = xi[3:]
    so3_log(T, w)
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    half = 0.5 * math.sqrt(angle2)
    if angle2 < 0.01:
        square = 1.0 / 12.0 + angle2 * (1.0 / 720.0 + angle2 * (1.0 / 30240.0 + angle2 / 1209600.0))
    else:
        square = (1.0 - half * math.cos(half) / math.sin(half)) / angle2
    inverse = identity()  # of the left Jacobian
    add_skew(w, -0.5, square, inverse)
    for i in range(3):
        xi[i] = inverse[i, 0] * T[0, 3] + inverse[i, 1] * T[1, 3] + inverse[i, 2] * T[2, 3]
    return xi


@inlined()
def multiply(A, B, out):
    """Write the product of two rigid motions."""
    for i in range(4):
        for j in range(4):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j] + A[i, 3] * B[3, j]


@inlined()
def times_inverse(A, B):
    """Return `A B^-1` of rigid motions."""
    inverse, out = identity(), np.empty((4, 4))
    for i in range(3):
        for j in range(3):
            inverse[i, j] = B[j, i]
            inverse[i, 3] -= B[j, i] * B[j, 3]
    multiply(A, inverse, out)
    return out
