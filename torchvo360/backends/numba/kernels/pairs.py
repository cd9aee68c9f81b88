"""One pass over the points of pairs: warp, look up, compare, weigh and sum, block by block in the cache.

A part, a fixed number of points of one pair, is one thread's work; its sums are float64, those of a block float32.
Parts and blocks depend on the number of points alone, and are added in their order: no thread changes a bit.

The formulas are those of `residuals.direct` and `residuals.weights`, where they are explained.
"""

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numba import get_num_threads, prange, set_num_threads

from torchvo360.backends.numba.kernels.geometry import hide_unseen, locate, project_pinhole, project_sphere, warp, wrap
from torchvo360.backends.numba.kernels.jit import compiled, inlined
from torchvo360.backends.numba.kernels.lookup import compare, doubt, gather
from torchvo360.backends.numba.kernels.rows import add_products, add_slopes, build_rows
from torchvo360.backends.numba.kernels.scratch import BLOCK, NEAREST, PI, PINHOLE, SCRATCH, SPHERE, TWO, f4
from torchvo360.backends.numba.kernels.weights import shrink, weigh

_STARTING = threading.Lock()

PART = 4096
"""Points of one thread's work, about 20 microseconds: several times what it costs to hand it out."""

SUMS = 47
"""The upper triangle of the 9 x 9 matrix row by row, the cost and the weight."""


@inlined()
def element(array, b):
    """Return the b-th of a batch, or the one that all share."""
    return array[b if array.shape[0] > 1 else 0]


@inlined()
def place_block(s, index, at, end, ray, rho, weight, images, b, T, k, optics):
    """Warp the points from at to end, find their cells, and weigh them by what the image is sure of there."""
    padded, confidence = images
    kind, wraps, wrap_again, _ = optics
    fx, fy, cx, cy = k[0], k[1], k[2], k[3]
    height, width = padded.shape[2] - 2, padded.shape[3] - 2
    n = end - at
    warp(s, n, ray[0, at:end], ray[1, at:end], ray[2, at:end], rho[at:end], weight[at:end], T)
    if kind == SPHERE:
        project_sphere(s, n, fx, fy, cx, cy)
        if wrap_again:
            wrap(s, n, f4(width) if wraps else abs(fx) * (TWO * PI))
    else:
        project_pinhole(s, n, fx, fy, cx, cy)
    if not wraps:
        hide_unseen(s, n, f4(width - 0.5), f4(height - 0.5), NEAREST if kind == PINHOLE else f4(-np.inf))
    locate(s, index, n, height, width)
    if confidence.size:
        gather(s, index, n, element(confidence, b)[0].reshape(-1), width + 2)
        doubt(s, n)


@inlined()
def sum_part(s, index, b, first, last, points, images, T, affine, k, optics, loss, sums):
    """Sum the points from first to last of pair b."""
    ray, rho, value, weight, variance = points
    padded, _ = images
    kind, _, _, polar2 = optics
    loss_kind, scale, freedom, cutoff, most, saturation, noise = loss
    ray, rho, value, weight = element(ray, b), element(rho, b), element(value, b), element(weight, b)
    image, T, k = element(padded, b), T[b], element(k, b)
    C, pitch = image.shape[0], image.shape[2]
    gain, offset = f4(math.exp(f4(affine[b, 0]))), f4(affine[b, 1])
    M, total_cost, total_weight = np.zeros((9, 9)), 0.0, 0.0
    for at in range(first, last, BLOCK):
        end = min(at + BLOCK, last)
        n = end - at
        place_block(s, index, at, end, ray, rho, weight, images, b, T, k, optics)
        for c in range(C):
            gather(s, index, n, image[c].reshape(-1), pitch)
            compare(s, n, kind, value[c, at:end], gain, offset, saturation, k[0], k[1], polar2)
            if variance.size:
                shrink(s, n, element(variance, b)[at:end], T, noise)
            weigh(s, n, loss_kind, scale, freedom, cutoff, most, variance.size > 0)
            block_cost, block_weight = build_rows(s, n)
            if variance.size:
                add_slopes(s, n, T)
            add_products(s, n, M)
            total_cost += block_cost
            total_weight += block_weight
    m = 0
    for p in range(9):
        for q in range(p, 9):
            sums[m] = M[p, q]
            m += 1
    sums[45], sums[46] = total_cost, total_weight


@compiled()
def _sum_parts(worker, workers, parts, places, points, images, T, affine, k, optics, loss, sums):
    """Sum every so many of some pairs' parts, in one scratch array: newly given memory costs at every page."""
    s, index = np.empty(SCRATCH, f4), np.empty(BLOCK, np.uint32)
    N = points[1].shape[1]
    for task in range(worker, len(sums), workers):
        b, first = places[task // parts], task % parts * PART
        sum_part(s, index, b, first, min(first + PART, N), points, images, T, affine, k, optics, loss, sums[task])


@compiled(parallel=True)
def sum_in_threads(workers, parts, places, points, images, T, affine, k, optics, loss, sums):
    """Sum the parts of the pairs at some places of a batch, one pair's after the other's."""
    # Nothing else here: numba hands an innocent np.zeros out to all threads, and waits for them.
    for worker in prange(workers):
        _sum_parts(worker, workers, parts, places, points, images, T, affine, k, optics, loss, sums)


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
    arguments = parts, np.arange(B), points, images, T, affine, k, optics, loss, sums
    workers = min(threads, B * parts)
    if workers <= 1:
        # Without the threading layer, which takes its time and dies in a process forked from one that has used it.
        _sum_parts(0, 1, *arguments)
    else:
        with in_threads(workers):
            sum_in_threads(workers, *arguments)
    return sums.reshape(B, parts, SUMS).sum(1)


@contextmanager
def in_threads(workers: int) -> Iterator[None]:
    """Let numba use some threads, at most as many as it is allowed, and one caller at a time.

    The simplest of its threading layers ends the process where two threads of Python start theirs at once.
    """
    with _STARTING:
        before = get_num_threads()
        set_num_threads(min(workers, before))
        try:
            yield
        finally:
            set_num_threads(before)


def _start_threads() -> None:
    """Start numba's threads, which sets OpenMP's number of them, torch's too if both share it, and put that back."""
    threads = torch.get_num_threads()
    get_num_threads()
    torch.set_num_threads(threads)


_start_threads()
