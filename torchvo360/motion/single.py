"""The filter's two steps for one state in NumPy: every frame takes them, and in torch hundreds of calls cost it all.

The formulas are those of `pose_filter`, by the same names, without batches and derivatives. The transition needs no
exponential of a large matrix: every power of ad(twist) from the fifth on is made of the four below, so that a series in
it is five matrices and five sums of numbers.

Source: Barfoot, State Estimation for Robotics (2017), section 7.1: ad^5 + 2 t^2 ad^3 + t^4 ad = 0, t the angle.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

MOST_TURN = math.pi
"""Angle of a step up to which `TERMS` terms of the series are exact."""
TERMS = 28
"""At pi the first that is dropped is 1e-15 of the first."""
SMALL_ANGLE_SQUARED = 1e-4
"""As in `lie`."""

_K = np.arange(TERMS)
_FACTORIAL = np.array([float(math.factorial(k)) for k in range(TERMS + 2)])
_SERIES = np.stack([1 / _FACTORIAL[_K], 1 / _FACTORIAL[_K + 1], 1 / _FACTORIAL[_K + 2]])
"""Of exp, of the left Jacobian, and of its integral."""
_PRODUCTS = _SERIES[1][:, None] * _SERIES[1] / (_K[:, None] + _K + 3)
"""Of the integral over s in [0, 1] of s^2 J_l(s) J_l(s)^T."""
_M = np.arange(TERMS // 2)
_ONE = np.eye(12)

Matrix4 = Float64[np.ndarray, "4 4"]
Matrix6 = Float64[np.ndarray, "6 6"]
Matrix12 = Float64[np.ndarray, "12 12"]


class Corrected(NamedTuple):
    """One state after a measured pose, and what that said beyond the prediction, as in `kalman.Innovation`."""

    T: Matrix4
    twist: Float64[np.ndarray, "6"]
    covariance: Matrix12
    residual: Float64[np.ndarray, "6"]
    S: Matrix6
    mahalanobis2: float
    ok: bool


def predicted(
    T: Matrix4, twist: Float64[np.ndarray, "6"], P: Matrix12, dt_s: float, density2: Float64[np.ndarray, "6"]
) -> tuple[Matrix4, Matrix12]:
    """Return pose and covariance after a step that turns by at most `MOST_TURN`, as `PoseFilter.predict` does."""
    F, Q = transition(twist, dt_s, density2)
    return normalized(exp(twist * dt_s) @ T), _symmetrized(F @ P @ F.T + Q)


def updated(T: Matrix4, twist: Float64[np.ndarray, "6"], P: Matrix12, T_measured: Matrix4, R: Matrix6) -> Corrected:
    """Return the state with a measured pose, as `PoseFilter.update` does."""
    S = _symmetrized(P[:6, :6] + R)
    finite = bool(np.isfinite(S).all())
    failed = Corrected(T, twist, P, np.zeros(6), S if finite else np.eye(6), math.inf, False)
    if not (finite and is_pose(T_measured)):
        return failed
    try:
        np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return failed
    residual = log(T_measured @ inverse(T))
    solved = np.linalg.solve(S, np.concatenate([P[:6], residual[:, None]], 1))
    K = solved[:, :12].T
    mean = K @ residual
    keep = _ONE.copy()
    keep[:, :6] -= K
    # The covariance stays about the moved pose: its errors are the camera's own.
    carried = _ONE.copy()
    carried[:6, :6] = left_jacobian(mean[:6])
    covariance = carried @ _symmetrized(keep @ P @ keep.T + K @ R @ K.T) @ carried.T
    moved = normalized(exp(mean[:6]) @ T)
    return Corrected(
        moved, twist + mean[6:], _symmetrized(covariance), residual, S, float(residual @ solved[:, 12]), True
    )


def transition(
    twist: Float64[np.ndarray, "6"], dt_s: float, density2: Float64[np.ndarray, "6"]
) -> tuple[Matrix12, Matrix12]:
    """Return F and Q of a step, as `pose_filter.transition` does."""
    powers, weights = _powers(twist * dt_s)
    flat = powers.reshape(5, 36)
    turned, jacobian, integral = (_SERIES @ weights @ flat).reshape(3, 6, 6)
    F, Q = _ONE.copy(), np.zeros((12, 12))
    F[:6, :6] = turned
    F[:6, 6:] = dt_s * jacobian
    spread = (weights.T @ _PRODUCTS @ weights @ flat).reshape(5, 6, 6)
    left, right = (side.transpose(1, 0, 2).reshape(6, 30) for side in (powers * density2, spread))
    Q[:6, :6] = dt_s**3 * _symmetrized(left @ right.T)
    Q[:6, 6:] = dt_s**2 * integral * density2
    Q[6:, :6] = Q[:6, 6:].T
    Q[6:, 6:] = np.diag(dt_s * density2)
    return F, Q


def left_jacobian(xi: Float64[np.ndarray, "6"]) -> Matrix6:
    """Return J_l with `exp(xi + d) = exp(J_l d) exp(xi)` to first order, for turns of at most `MOST_TURN`."""
    powers, weights = _powers(xi)
    return (_SERIES[1] @ weights @ powers.reshape(5, 36)).reshape(6, 6)


def _powers(xi: Float64[np.ndarray, "6"]) -> tuple[Float64[np.ndarray, "5 6 6"], Float64[np.ndarray, "TERMS 5"]]:
    """Return ad(xi)^0 to ad(xi)^4, and every power of it as a sum of these."""
    powers = np.zeros((5, 6, 6))
    powers[0] = _ONE[:6, :6]
    ad = powers[1]
    ad[:3, :3] = ad[3:, 3:] = hat(xi[3:])
    ad[:3, 3:] = hat(xi[:3])
    np.matmul(ad, ad, out=powers[2])
    np.matmul(powers[2], powers[1:3], out=powers[3:])
    # ad^(2m+1) = x^(m-1) (m ad^3 - (m-1) x ad) with x = -t^2, and one power more for ad^(2m+2).
    x = -float(xi[3:] @ xi[3:])
    high = np.power(x, _M)
    low, third = (1 - _M) * high, np.zeros(len(_M))
    third[1:] = _M[1:] * high[:-1]
    weights = np.zeros((TERMS, 5))
    weights[0, 0] = 1.0
    weights[1::2, 1], weights[1::2, 3] = low, third
    weights[2::2, 2], weights[2::2, 4] = low[:-1], third[:-1]
    return powers, weights


def angle(twist: Float64[np.ndarray, "6"]) -> float:
    """Return the length of the rotation of a tangent [v, w]."""
    return math.hypot(*twist[3:].tolist())


def hat(w: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the skew matrix of the cross product."""
    x, y, z = w.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(xi: Float64[np.ndarray, "6"]) -> Matrix4:
    """Return the rigid motion of a tangent [v, w]."""
    t2 = float(xi[3:] @ xi[3:])
    if t2 < SMALL_ANGLE_SQUARED:
        a = 1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42))
        b = 0.5 - t2 / 24 * (1 - t2 / 30 * (1 - t2 / 56))
        c = 1 / 6 - t2 / 120 * (1 - t2 / 42 * (1 - t2 / 72))
    else:
        t = math.sqrt(t2)
        a, b, c = math.sin(t) / t, 2 * math.sin(t / 2) ** 2 / t2, (t - math.sin(t)) / (t2 * t)
    turn = hat(xi[3:])
    twice = turn @ turn
    T = np.eye(4)
    T[:3, :3] += a * turn + b * twice
    T[:3, 3] = xi[:3] + (b * turn + c * twice) @ xi[:3]
    return T


def log(T: Matrix4) -> Float64[np.ndarray, "6"]:
    """Return the tangent [v, w] of a rigid motion, with |w| at most pi."""
    x, y, z, w = _quaternion(T)
    n2 = x * x + y * y + z * z
    if n2 < SMALL_ANGLE_SQUARED:
        r2 = n2 / (w * w)
        factor = 2 * (1 - r2 * (1 / 3 - r2 * (1 / 5 - r2 / 7))) / w
    else:
        n = math.sqrt(n2)
        factor = 2 * math.atan2(n, w) / n
    turn = factor * np.array([x, y, z])
    t2 = float(turn @ turn)
    if t2 < SMALL_ANGLE_SQUARED:
        c = 1 / 12 + t2 / 720 * (1 + t2 / 42)
    else:
        half = math.sqrt(t2) / 2
        c = (1 - half * math.cos(half) / math.sin(half)) / t2
    K, t = hat(turn), T[:3, 3]
    return np.concatenate([t - 0.5 * (K @ t) + c * (K @ (K @ t)), turn])


def inverse(T: Matrix4) -> Matrix4:
    """Return T_a_b from T_b_a."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -(T[:3, :3].T @ T[:3, 3])
    return out


def normalized(T: Matrix4) -> Matrix4:
    """Return T with its rotation brought back to SO(3)."""
    x, y, z, w = _quaternion(T)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), T[0, 3]],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), T[1, 3]],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), T[2, 3]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def is_pose(T: Matrix4, tolerance: float = 1e-3) -> bool:
    """Return whether a matrix is a rigid motion, as `checks.is_pose` does."""
    if not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    apart = max(np.abs(R @ R.T - _ONE[:3, :3]).max(), np.abs(T[3] - _ONE[3, :4]).max())
    return bool(apart < tolerance and np.dot(np.cross(R[0], R[1]), R[2]) > 0)


def _quaternion(T: Matrix4) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w), w >= 0, of a rotation, by the quotient with the largest divisor."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _), _ = T.tolist()
    rows = (
        (1 + a - e - i, b + d, c + g, h - f),
        (b + d, 1 - a + e - i, f + h, c - g),
        (c + g, f + h, 1 - a - e + i, d - b),
        (h - f, c - g, d - b, 1 + a + e + i),
    )
    row = max(enumerate(rows), key=lambda pair: pair[1][pair[0]])[1]
    length = math.sqrt(sum(q * q for q in row))
    x, y, z, w = (q / (length if row[3] >= 0 else -length) for q in row)
    return x, y, z, w


def _symmetrized(P: np.ndarray) -> np.ndarray:
    return (P + P.T) / 2
