"""Steps of several poses, and what lies between them."""

import numpy as np

from torchvo360.backends.numba.kernels.jit import compiled
from torchvo360.backends.numba.kernels.rigid import multiply, se3_exp, se3_log, times_inverse


@compiled()
def move_poses(T, xi):
    """Return `exp(xi) T` of poses [K, 4, 4] and tangents (v, w) [K, 6]."""
    moved = np.empty_like(T)
    for k in range(len(T)):
        multiply(se3_exp(xi[k]), T[k], moved[k])
    return moved


@compiled()
def steps_between(T, T_first):
    """Return the tangents `log(T T_first^-1)` [K, 6] of poses [K, 4, 4]."""
    xi = np.empty((len(T), 6))
    for k in range(len(T)):
        xi[k] = se3_log(times_inverse(T[k], T_first[k]))
    return xi
