"""Log-ranges of moved points beside those of their nearest neighbours: `loop.ranges` on arrays."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import FAST, inlined
from torchvo360.backends.numba.kernels.scratch import f4


@inlined()
def first_above(values, limit):
    """Return the place of the first of ascending values that is not below a limit."""
    low, high = 0, len(values)
    while low < high:
        middle = (low + high) // 2
        if values[middle] < limit:
            low = middle + 1
        else:
            high = middle
    return low


@inlined(fastmath=FAST)
def find_nearest(ray, first, last, x, y, z):
    """Return which of some rays has the largest product with another, or -1."""
    best, at = f4(-2), -1
    for j in range(first, last):
        product = ray[0, j] * x + ray[1, j] * y + ray[2, j] * z
        if product > best:
            best, at = product, j
    return at


@inlined()
def compare_point(S, ray, rho, near_ray, limit):
    """Move a point; return its ray, its inverse range, the nearest of the others within a chord or -1, and the chord.

    Rays no farther apart than that differ by less in their heights: only a band of the others is searched.
    """
    x = S[0, 0] * ray[0] + S[0, 1] * ray[1] + S[0, 2] * ray[2] + S[0, 3] * rho
    y = S[1, 0] * ray[0] + S[1, 1] * ray[1] + S[1, 2] * ray[2] + S[1, 3] * rho
    z = S[2, 0] * ray[0] + S[2, 1] * ray[1] + S[2, 2] * ray[2] + S[2, 3] * rho
    length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    x, y, z = x / length, y / length, z / length
    first, last = first_above(near_ray[1], y - 1.01 * limit), first_above(near_ray[1], y + 1.01 * limit)
    at, chord = find_nearest(near_ray, first, last, f4(x), f4(y), f4(z)), 2.0
    if at >= 0:
        chord = math.sqrt((x - near_ray[0, at]) ** 2 + (y - near_ray[1, at]) ** 2 + (z - near_ray[2, at]) ** 2)
    return x, y, z, rho / length, at if chord < limit else -1, chord


@inlined()
def sum_ranges(S, points, near, settings, M):
    """Sum the comparisons of points with those of another frame; return cost and number of those that have neighbours.

    Args:
        S: The similarity into the other frame.
        points: Rays [3, N], inverse ranges [N] and their relative variances [N].
        near: The other frame's in the order of their rays' y.
        settings: Largest chord of neighbours, slope of surfaces, least variance, degrees of freedom of the loss.
        M: [5, 5], for the products of rows by (v, sigma) and the difference; overwritten.
    """
    ray, rho, relative = points
    near_ray, near_rho, near_relative = near
    limit, slope, least, freedom = settings
    row, cost, count = np.empty(5), 0.0, 0
    for p in range(5):
        for q in range(5):
            M[p, q] = 0.0
    for i in range(len(rho)):
        x, y, z, moved_rho, at, chord = compare_point(S, ray[:, i], rho[i], near_ray, limit)
        if at < 0:
            continue
        difference = math.log(moved_rho / near_rho[at])
        trust = 1.0 / (relative[i] + near_relative[at] + (slope * chord) ** 2 + least)
        square = trust * difference * difference
        cost += 0.5 * (freedom + 1.0) * math.log1p(square / freedom)
        total = trust * (freedom + 1.0) / (freedom + square)
        row[0], row[1], row[2], row[3], row[4] = -moved_rho * x, -moved_rho * y, -moved_rho * z, -1.0, difference
        for p in range(5):
            weighted = total * row[p]
            for q in range(5):
                M[p, q] += weighted * row[q]
        count += 1
    return cost, count
