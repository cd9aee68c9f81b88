"""SO(3), SE(3) and Sim(3) on plain tensors: hat, exp, log, adjoint, and quaternions.

Tangents are `[w]`, `[v, w]` and `[v, w, s]`: translation first, then rotation, then log-scale. `T_b_a` maps points of
frame a into frame b and updates multiply from the left, `T <- exp(xi) @ T` (mathematics.md, section 1). Every function
takes any batch shape and has finite gradients at the identity; logarithms are accurate up to and at an angle of pi.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.checks import check_shape

SMALL_ANGLE_SQUARED = 1e-4
"""Below this squared angle the Taylor series are used: their first dropped term is under 1e-16 of the value."""


def so3_hat(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the skew matrix with `so3_hat(w) @ p == cross(w, p)`."""
    check_shape("w", w, "... 3")
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def _rodrigues_coefficients(
    angle2: Float[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Return sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 for squared angles t^2, with finite gradients at 0."""
    small = angle2 < SMALL_ANGLE_SQUARED
    safe2 = torch.where(small, torch.ones_like(angle2), angle2)
    angle = safe2.sqrt()
    half = torch.sin(angle / 2)
    a = torch.where(small, 1 - angle2 / 6 * (1 - angle2 / 20 * (1 - angle2 / 42)), angle.sin() / angle)
    # 2 sin^2(t/2) instead of 1 - cos(t): no cancellation at small angles
    b = torch.where(small, 0.5 - angle2 / 24 * (1 - angle2 / 30 * (1 - angle2 / 56)), 2 * half * half / safe2)
    c = torch.where(
        small, 1 / 6 - angle2 / 120 * (1 - angle2 / 42 * (1 - angle2 / 72)), (angle - angle.sin()) / (safe2 * angle)
    )
    return a, b, c


def so3_exp(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation by `|w|` radians about `w`."""
    a, b, _ = _rodrigues_coefficients((w * w).sum(-1))
    K = so3_hat(w)
    eye = torch.eye(3, dtype=w.dtype, device=w.device)
    return eye + a[..., None, None] * K + b[..., None, None] * (K @ K)


def so3_left_jacobian(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return J_l with `exp(w + d) = exp(J_l d) exp(w)` to first order; it is also the V of the SE(3) exponential."""
    _, b, c = _rodrigues_coefficients((w * w).sum(-1))
    K = so3_hat(w)
    eye = torch.eye(3, dtype=w.dtype, device=w.device)
    return eye + b[..., None, None] * K + c[..., None, None] * (K @ K)


def quaternion_from_matrix(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Return the unit quaternion (x, y, z, w) of a rotation, with w >= 0.

    Of four equivalent quotients the one with the largest divisor is used, so that it holds at every angle.
    """
    check_shape("R", R, "... 3 3")
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = R.flatten(-2).unbind(-1)
    # Row k is 4 q_k (x, y, z, w) for k = x, y, z, w: Shepperd's four solutions.
    products = torch.stack(
        [
            torch.stack([1 + m00 - m11 - m22, m01 + m10, m02 + m20, m21 - m12], -1),
            torch.stack([m01 + m10, 1 - m00 + m11 - m22, m12 + m21, m02 - m20], -1),
            torch.stack([m02 + m20, m12 + m21, 1 - m00 - m11 + m22, m10 - m01], -1),
            torch.stack([m21 - m12, m02 - m20, m10 - m01, 1 + m00 + m11 + m22], -1),
        ],
        -2,
    )
    best = products.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = products.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    q = row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)
    return torch.where(q[..., 3:] < 0, -q, q)


def matrix_from_quaternion(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation of a quaternion (x, y, z, w) of any non-zero length."""
    check_shape("q", q, "... 4")
    x, y, z, w = (q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def so3_log(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Return the rotation vector of R, of length at most pi; at pi exactly either of the two signs."""
    q = quaternion_from_matrix(R)
    v, w = q[..., :3], q[..., 3]
    n2 = (v * v).sum(-1)
    small = n2 < SMALL_ANGLE_SQUARED
    n = torch.where(small, torch.ones_like(n2), n2).sqrt()
    safe_w = torch.where(small, w, torch.ones_like(w))
    # atan(n / w) / n as a series in n / w, whose first dropped term is (n / w)^8 / 9
    ratio2 = n2 / (safe_w * safe_w)
    series = (1 - ratio2 * (1 / 3 - ratio2 * (1 / 5 - ratio2 / 7))) / safe_w
    factor = torch.where(small, 2 * series, 2 * torch.atan2(n, w) / n)
    return factor[..., None] * v


def so3_angle(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Return the rotation angle of R in [0, pi] radians."""
    return torch.linalg.vector_norm(so3_log(R), dim=-1)


def se3(R: Float[Tensor, "*batch 3 3"], t: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the 4 x 4 matrix [R t; 0 1]; a scaled R gives a Sim(3) element."""
    check_shape("R", R, "... 3 3")
    check_shape("t", t, "... 3")
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device)
    top = torch.cat([R, t[..., None]], -1)
    return torch.cat([top, last.expand(*top.shape[:-2], 1, 4)], -2)


def se3_hat(xi: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the 4 x 4 generator of a tangent [v, w]."""
    check_shape("xi", xi, "... 6")
    top = torch.cat([so3_hat(xi[..., 3:]), xi[..., :3, None]], -1)
    return torch.cat([top, torch.zeros_like(top[..., :1, :])], -2)


def _matrix_exp(A: Float[Tensor, "*batch D D"]) -> Float[Tensor, "*batch D D"]:
    """Return the matrix exponential, the same bits for a matrix whatever batch it is in."""
    if A.shape[:-2].numel() != 1:
        return torch.linalg.matrix_exp(A)
    # A single matrix takes another path in torch, and comes out with other last digits: let it have company.
    pair = A.reshape(1, *A.shape[-2:]).expand(2, -1, -1)
    return torch.linalg.matrix_exp(pair)[0].reshape(A.shape)


def se3_exp(xi: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the rigid motion of a tangent [v, w].

    By the matrix exponential: exact everywhere, and for the few elements of a solver's step three times faster than the
    closed form's many small operations.
    """
    return _matrix_exp(se3_hat(xi))


def se3_log(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6"]:
    """Return the tangent [v, w] of a rigid motion, with |w| at most pi."""
    check_shape("T", T, "... 4 4")
    w = so3_log(T[..., :3, :3])
    v = torch.linalg.solve(so3_left_jacobian(w), T[..., :3, 3:])[..., 0]
    return torch.cat([v, w], -1)


def se3_inverse(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return T_a_b from T_b_a, without a general matrix inverse."""
    check_shape("T", T, "... 4 4")
    R_inv = T[..., :3, :3].mT
    return se3(R_inv, -(R_inv @ T[..., :3, 3:])[..., 0])


def se3_normalized(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return T with its rotation brought back to SO(3): products of products drift away from it exponentially."""
    check_shape("T", T, "... 4 4")
    return se3(matrix_from_quaternion(quaternion_from_matrix(T[..., :3, :3])), T[..., :3, 3])


def se3_adjoint(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6 6"]:
    """Return Ad with `T @ exp(xi) @ T^-1 == exp(Ad @ xi)`: [[R, hat(t) R], [0, R]] (mathematics.md, section 6)."""
    check_shape("T", T, "... 4 4")
    R, t = T[..., :3, :3], T[..., :3, 3]
    top = torch.cat([R, so3_hat(t) @ R], -1)
    return torch.cat([top, torch.cat([torch.zeros_like(R), R], -1)], -2)


def sim3_hat(xi: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the 4 x 4 generator of a Sim(3) tangent [v, w, s]."""
    check_shape("xi", xi, "... 7")
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
    block = so3_hat(xi[..., 3:6]) + xi[..., 6, None, None] * eye
    top = torch.cat([block, xi[..., :3, None]], -1)
    return torch.cat([top, torch.zeros_like(top[..., :1, :])], -2)


def sim3_exp(xi: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the similarity [e^s R, t; 0, 1] of a tangent [v, w, s], by the matrix exponential."""
    return _matrix_exp(sim3_hat(xi))


def sim3_log(S: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 7"]:
    """Return the tangent [v, w, s] of a similarity, with |w| at most pi."""
    check_shape("S", S, "... 4 4")
    sR = S[..., :3, :3]
    log_scale = torch.linalg.det(sR).log() / 3
    w = so3_log(sR * torch.exp(-log_scale)[..., None, None])
    eye = torch.eye(3, dtype=S.dtype, device=S.device).expand_as(sR)
    # W = integral over u in [0, 1] of exp(u M): the upper right block of the exponential of [[M, I], [0, 0]].
    M = so3_hat(w) + log_scale[..., None, None] * eye
    upper = torch.cat([M, eye], -1)
    W = torch.linalg.matrix_exp(torch.cat([upper, torch.zeros_like(upper)], -2))[..., :3, 3:]
    v = torch.linalg.solve(W, S[..., :3, 3:])[..., 0]
    return torch.cat([v, w, log_scale[..., None]], -1)


def sim3_inverse(S: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return S_a_b from S_b_a."""
    check_shape("S", S, "... 4 4")
    sR = S[..., :3, :3]
    scale2 = torch.linalg.det(sR).pow(2 / 3)
    inverse = sR.mT / scale2[..., None, None]
    return se3(inverse, -(inverse @ S[..., :3, 3:])[..., 0])


def sim3_adjoint(S: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 7 7"]:
    """Return Ad with `S @ exp(xi) @ S^-1 == exp(Ad @ xi)`: [[sR, hat(t) R, -t], [0, R, 0], [0, 0, 1]]."""
    check_shape("S", S, "... 4 4")
    sR, t = S[..., :3, :3], S[..., :3, 3]
    R = sR / torch.linalg.det(sR).pow(1 / 3)[..., None, None]
    zero, column = torch.zeros_like(R), torch.zeros_like(t)[..., None]
    top = torch.cat([sR, so3_hat(t) @ R, -t[..., None]], -1)
    middle = torch.cat([zero, R, column], -1)
    last = torch.tensor([0.0] * 6 + [1.0], dtype=S.dtype, device=S.device).expand(*S.shape[:-2], 1, 7)
    return torch.cat([top, middle, last], -2)


def sim3_small_adjoint(xi: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 7 7"]:
    """Return ad with `sim3_adjoint(sim3_exp(xi)) == exp(ad)`: what the bracket with a tangent [v, w, s] does."""
    check_shape("xi", xi, "... 7")
    v, w, s = xi[..., :3], xi[..., 3:6], xi[..., 6, None, None]
    turn, zero, column = so3_hat(w), torch.zeros_like(so3_hat(w)), torch.zeros_like(v)[..., None]
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
    top = torch.cat([turn + s * eye, so3_hat(v), -v[..., None]], -1)
    middle = torch.cat([zero, turn, column], -1)
    return torch.cat([top, middle, torch.zeros_like(top[..., :1, :])], -2)


def sim3_left_jacobian(xi: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 7 7"]:
    """Return J_l with `exp(xi + d) = exp(J_l d) exp(xi)` to first order.

    It is the integral of exp(u ad) over u in [0, 1]: the upper right block of the exponential of [[ad, I], [0, 0]].
    """
    ad = sim3_small_adjoint(xi)
    eye = torch.eye(7, dtype=xi.dtype, device=xi.device).expand_as(ad)
    upper = torch.cat([ad, eye], -1)
    return _matrix_exp(torch.cat([upper, torch.zeros_like(upper)], -2))[..., :7, 7:]
