"""Similarities on arrays: exponential, inverse, their rigid motions, and how a step of one moves its inverse."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import inlined
from torchvo360.backends.numba.kernels.rigid import identity, multiply

TERMS = 14
"""Of the exponential's series, after the matrix has been halved to a norm below 1/2."""


@inlined()
def sim3_exp(xi):
    """Return the similarity [4, 4] of a tangent (v, w, sigma), by the series of the halved matrix, squared again."""
    M = np.zeros((4, 4))
    M[0, 1], M[0, 2], M[1, 2] = -xi[5], xi[4], -xi[3]
    M[1, 0], M[2, 0], M[2, 1] = xi[5], -xi[4], xi[3]
    norm = 0.0
    for i in range(3):
        M[i, i], M[i, 3] = xi[6], xi[i]
        for j in range(4):
            norm += abs(M[i, j])
    halvings = 0
    while norm > 0.5:
        norm *= 0.5
        halvings += 1
    S, other = identity(), np.empty((4, 4))
    # By Horner: I + M (I + M / 2 (I + M / 3 (...))), every product in place of the last.
    for term in range(TERMS, 0, -1):
        multiply(M, S, other)
        for i in range(4):
            for j in range(4):
                S[i, j] = other[i, j] / (term * 2.0**halvings) + (1.0 if i == j else 0.0)
    for _ in range(halvings):
        multiply(S, S, other)
        for i in range(4):
            for j in range(4):
                S[i, j] = other[i, j]
    return S


@inlined()
def volume(S):
    """Return the determinant of sR."""
    return (
        S[0, 0] * (S[1, 1] * S[2, 2] - S[1, 2] * S[2, 1])
        - S[0, 1] * (S[1, 0] * S[2, 2] - S[1, 2] * S[2, 0])
        + S[0, 2] * (S[1, 0] * S[2, 1] - S[1, 1] * S[2, 0])
    )


@inlined()
def split(S, S_inverse, forward, backward):
    """Write the inverse of a similarity, and both ways' rigid motions (R, t / s); return its scale."""
    scale = max(volume(S), 1e-300) ** (1.0 / 3.0)
    for i in range(4):
        for j in range(4):
            S_inverse[i, j] = forward[i, j] = backward[i, j] = 1.0 if i == j else 0.0
    for i in range(3):
        for j in range(3):
            forward[i, j] = backward[j, i] = S[i, j] / scale
            S_inverse[j, i] = S[i, j] / (scale * scale)
        forward[i, 3] = S[i, 3] / scale
    for i in range(3):
        moved = 0.0
        for j in range(3):
            moved -= backward[i, j] * S[j, 3]
        backward[i, 3], S_inverse[i, 3] = moved, moved / scale
    return scale


@inlined()
def step_of_inverse(S_inverse, scale, J):
    """Write how a step of a similarity moves its inverse, -Ad(S^-1) [7, 7]; `scale` is the inverse's."""
    x, y, z = S_inverse[0, 3], S_inverse[1, 3], S_inverse[2, 3]
    for i in range(7):
        for j in range(7):
            J[i, j] = 0.0
    for j in range(3):
        r0, r1, r2 = S_inverse[0, j] / scale, S_inverse[1, j] / scale, S_inverse[2, j] / scale
        for i in range(3):
            J[i, j], J[3 + i, 3 + j] = -S_inverse[i, j], -S_inverse[i, j] / scale
        J[0, 3 + j] = z * r1 - y * r2
        J[1, 3 + j] = x * r2 - z * r0
        J[2, 3 + j] = y * r0 - x * r1
    J[0, 6], J[1, 6], J[2, 6], J[6, 6] = x, y, z, -1.0


@inlined()
def is_sensible(S, affine, farthest, most_scale, most_gain):
    """Return whether a state is finite, and within any scene, any ratio of scales and any exposure."""
    size = volume(S)
    sensible = size > most_scale**-3 and size < most_scale**3  # NaN is not
    for i in range(3):
        sensible = sensible and abs(S[i, 3]) < farthest
        for j in range(3):
            sensible = sensible and math.isfinite(S[i, j])
    for m in range(0, 4, 2):
        sensible = sensible and abs(affine[m]) < most_gain and math.isfinite(affine[m + 1])
    return sensible
