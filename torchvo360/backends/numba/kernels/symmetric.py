"""Small symmetric positive definite systems: `solve.solve_ldl` on arrays."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import inlined

LEAST = np.finfo(np.float64).tiny


@inlined()
def solve_ldl(A, x, tolerance):
    """Solve by LDL^T of the matrix scaled to a unit diagonal, without pivoting, which needs none where it succeeds.

    Args:
        A: [D, D], of which the lower triangle is read; overwritten.
        x: [D], the right side; overwritten by the solution, by zeros where there is none.
        tolerance: Pivots below this are zero.

    Returns:
        Whether A is positive definite, and all is finite.
    """
    D = len(x)
    scale = np.empty(D)
    ok = True
    for i in range(D):
        scale[i] = 1.0 / math.sqrt(max(A[i, i], LEAST))
        ok = ok and math.isfinite(x[i])
        x[i] *= scale[i]
    for i in range(D):
        for j in range(i):
            total = A[i, j] * scale[i] * scale[j]
            for m in range(j):
                total -= A[i, m] * A[j, m]
            A[i, j] = total  # L times D, until its row is complete
        pivot = A[i, i] * scale[i] * scale[i]
        for j in range(i):
            factor = A[i, j] / A[j, j]
            pivot -= factor * A[i, j]
            A[i, j] = factor
        A[i, i] = pivot
        ok = ok and pivot > tolerance and math.isfinite(pivot)  # NaN is not
        for j in range(i):
            x[i] -= A[i, j] * x[j]
    if not ok:
        for i in range(D):
            x[i] = 0.0
        return False
    for i in range(D - 1, -1, -1):
        x[i] /= A[i, i]
        for j in range(i + 1, D):
            x[i] -= A[j, i] * x[j]
    for i in range(D):
        x[i] *= scale[i]
    return True
