"""The linear Kalman filter, batched: predict, update in the Joseph form, smooth; and constant-velocity models.

A state is a Gaussian over `x` [*batch, D], float64. One step is

    predict:  mean = A mean,            covariance = A P A^T + Q
    update:   S = C P C^T + R,  K = P C^T S^-1,  mean += K (z - C mean),  P = (I - K C) P (I - K C)^T + K R K^T

(mathematics.md, section 9). The only Python loop is the smoother's, over time.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from torchvo360.checks import InputError, check_finite_number, check_shape


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A mean and a covariance for every element of a batch, float64."""

    mean: Float64[Tensor, "*batch D"]
    covariance: Float64[Tensor, "*batch D D"]

    def __post_init__(self) -> None:
        check_shape("mean", self.mean, "... D")
        size = self.mean.shape[-1]
        check_shape("covariance", self.covariance, f"... {size} {size}")
        for name in ("mean", "covariance"):
            if getattr(self, name).dtype != torch.float64:
                raise InputError(f"{name}: expected float64, got {getattr(self, name).dtype}.")


class Innovation(NamedTuple):
    """What a measurement said beyond its prediction."""

    residual: Float64[Tensor, "*batch M"]
    """Measured minus predicted; zero where not ok."""
    covariance: Float64[Tensor, "*batch M M"]
    """S = C P C^T + R; the identity where it is not finite."""
    mahalanobis2: Float64[Tensor, "*batch"]
    """residual^T S^-1 residual, chi-square with M degrees of freedom if the model holds; infinite where not ok."""
    ok: Bool[Tensor, "*batch"]
    """False where the measurement is not finite or S not positive definite: that element kept its prediction."""


def symmetrized(P: Float64[Tensor, "*batch D D"]) -> Float64[Tensor, "*batch D D"]:
    """Return the symmetric part: rounding leaves products of three matrices a little askew."""
    return (P + P.mT) / 2


def predict(state: Gaussian, A: Float64[Tensor, "*batch D D"], Q: Float64[Tensor, "*batch D D"]) -> Gaussian:
    """Move a state by the transition A with process noise Q."""
    size = state.mean.shape[-1]
    check_shape("A", A, f"... {size} {size}")
    check_shape("Q", Q, f"... {size} {size}")
    return Gaussian((A @ state.mean[..., None])[..., 0], symmetrized(A @ state.covariance @ A.mT + Q))


def update(
    state: Gaussian, z: Float64[Tensor, "*batch M"], C: Float64[Tensor, "*batch M D"], R: Float64[Tensor, "*batch M M"]
) -> tuple[Gaussian, Innovation]:
    """Correct a state by a measurement `z = C x + noise`, noise of covariance R.

    A measurement that is missing may be given as NaN: its element keeps its prediction, and `ok` says so.
    """
    check_shape("C", C, f"... M {state.mean.shape[-1]}")
    check_shape("z", z, f"... {C.shape[-2]}")
    return correct(state, z - (C @ state.mean[..., None])[..., 0], C, R)


def correct(
    state: Gaussian,
    residual: Float64[Tensor, "*batch M"],
    C: Float64[Tensor, "*batch M D"],
    R: Float64[Tensor, "*batch M M"],
) -> tuple[Gaussian, Innovation]:
    """Correct a state by the difference of measured and predicted, taken by the caller: angles and poses need care.

    Returns:
        The state, in the Joseph form: it stays symmetric and positive where `(I - K C) P` does not.
        The innovation; a failed element keeps its prediction and leaves its neighbours untouched.
    """
    D, M = state.mean.shape[-1], residual.shape[-1]
    check_shape("C", C, f"... {M} {D}")
    check_shape("R", R, f"... {M} {M}")
    PCt = state.covariance @ C.mT
    S = symmetrized(C @ PCt + R)
    eye = torch.eye(M, dtype=S.dtype, device=S.device)
    finite = torch.isfinite(S).flatten(-2).all(-1)
    S = torch.where(finite[..., None, None], S, eye)
    factor, info = torch.linalg.cholesky_ex(S)
    ok = finite & (info == 0) & torch.isfinite(residual).all(-1)
    # Before the solves, so that gradients stay finite.
    factor, R = (torch.where(ok[..., None, None], value, eye) for value in (factor, R))
    residual = torch.where(ok[..., None], residual, 0.0)
    whitened = torch.linalg.solve_triangular(factor, residual[..., None], upper=False)[..., 0]
    K = torch.cholesky_solve(PCt.mT, factor).mT
    keep = torch.eye(D, dtype=S.dtype, device=S.device) - K @ C
    covariance = symmetrized(keep @ state.covariance @ keep.mT + K @ R @ K.mT)
    corrected = Gaussian(
        torch.where(ok[..., None], state.mean + (K @ residual[..., None])[..., 0], state.mean),
        torch.where(ok[..., None, None], covariance, state.covariance),
    )
    return corrected, Innovation(residual, S, torch.where(ok, whitened.square().sum(-1), torch.inf), ok)


def smoothing_gain(
    covariance: Float64[Tensor, "*batch D D"], A: Float64[Tensor, "*batch D D"], Q: Float64[Tensor, "*batch D D"]
) -> tuple[Float64[Tensor, "*batch D D"], Bool[Tensor, "*batch"]]:
    """Return G = P A^T (A P A^T + Q)^-1, by which the next state corrects this one; zero and False where singular."""
    AP = A @ covariance
    predicted = symmetrized(AP @ A.mT + Q)
    factor, info = torch.linalg.cholesky_ex(predicted)
    ok = info == 0
    eye = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
    gain = torch.cholesky_solve(AP, torch.where(ok[..., None, None], factor, eye)).mT
    return torch.where(ok[..., None, None], gain, 0.0), ok


def smoothed_covariance(
    covariance: Float64[Tensor, "*batch D D"],
    following: Float64[Tensor, "*batch D D"],
    gain: Float64[Tensor, "*batch D D"],
    A: Float64[Tensor, "*batch D D"],
    Q: Float64[Tensor, "*batch D D"],
) -> Float64[Tensor, "*batch D D"]:
    """Return `P + G (P_next - A P A^T - Q) G^T` as a sum of positive terms, so that it stays positive.

    Args:
        covariance: P of the filter at this time.
        following: P_next, smoothed, at the next time.
        gain: G of `smoothing_gain`.
        A: Transition between the two.
        Q: Its process noise.
    """
    keep = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device) - gain @ A
    return symmetrized(keep @ covariance @ keep.mT + gain @ (following + Q) @ gain.mT)


def smooth(
    filtered: Gaussian, A: Float64[Tensor, "*steps D D"], Q: Float64[Tensor, "*steps D D"]
) -> tuple[Gaussian, Bool[Tensor, "*batch"]]:
    """Give every state of a filtered sequence the measurements after it as well, backwards (Rauch, Tung and Striebel).

    Args:
        filtered: Updated states, [N, *batch, D] with time first.
        A: Transitions from each time to the next, [N-1, *batch, D, D] or what expands to it.
        Q: Their process noise, likewise.

    Returns:
        The smoothed states, and where it held throughout: a step whose prediction is singular corrects nothing.

    Source: Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8), 1965.
    """
    mean, covariance = filtered.mean, filtered.covariance
    if mean.ndim < 2:
        raise InputError(f"filtered: expected states with time as the first axis, got a mean of {list(mean.shape)}.")
    A, Q = A.expand_as(covariance[1:]), Q.expand_as(covariance[1:])
    gain, ok = smoothing_gain(covariance[:-1], A, Q)
    ahead = (A @ mean[:-1, ..., None])[..., 0]
    means, covariances = [mean[-1]], [covariance[-1]]
    for k in range(len(mean) - 2, -1, -1):
        means.append(mean[k] + (gain[k] @ (means[-1] - ahead[k])[..., None])[..., 0])
        covariances.append(smoothed_covariance(covariance[k], covariances[-1], gain[k], A[k], Q[k]))
    return Gaussian(torch.stack(means[::-1]), torch.stack(covariances[::-1])), ok.all(0)


def constant_velocity(
    dt_s: Float64[Tensor, "*batch"], acceleration: Float64[Tensor, "axes"]
) -> tuple[Float64[Tensor, "*batch D D"], Float64[Tensor, "*batch D D"]]:
    """Return A and Q of axes that keep their velocity but for a random acceleration, constant over each step.

    Args:
        dt_s: Time of the step T, seconds.
        acceleration: Standard deviation k of each axis' acceleration, units of the axis per s^2.

    Returns:
        A and Q of the state (x1, x1', x2, x2', ...): per axis [[1, T], [0, 1]] and
        k^2 [[T^4/4, T^3/2], [T^3/2, T^2]]. Q depends on how time is cut into steps.

    Source: mathematics.md, section 9.
    """
    check_shape("acceleration", acceleration, "axes")
    one, zero = torch.ones_like(dt_s), torch.zeros_like(dt_s)
    A = torch.stack([one, dt_s, zero, one], -1).unflatten(-1, (2, 2))
    reach = torch.stack([dt_s * dt_s / 2, dt_s], -1)
    Q = reach[..., :, None] * reach[..., None, :]
    each = torch.eye(len(acceleration), dtype=A.dtype, device=A.device)
    return _per_axis(each, A), _per_axis(each * acceleration.square(), Q)


def _per_axis(
    scale: Float64[Tensor, "axes axes"], block: Float64[Tensor, "*batch 2 2"]
) -> Float64[Tensor, "*batch D D"]:
    """Return the Kronecker product of a diagonal matrix and the block of one axis."""
    return (scale[:, None, :, None] * block[..., None, :, None, :]).flatten(-4, -3).flatten(-2, -1)


@dataclass(frozen=True, kw_only=True)
class PlanarMotion:
    """A camera that moves over a plane: state (X, X', Z, Z', theta, theta'), metres, radians, seconds.

    theta is the heading about the world's vertical axis y, zero along z and growing towards x, as longitude does. It
    runs on beyond pi as the camera turns; only measurements of it are cyclic.
    """

    acceleration: float = 1.0
    """Standard deviation of the accelerations of X and Z over a step, m/s^2."""
    turn_acceleration: float = 1.0
    """Standard deviation of theta's over a step, rad/s^2."""

    def __post_init__(self) -> None:
        check_finite_number("acceleration", self.acceleration, above=0)
        check_finite_number("turn_acceleration", self.turn_acceleration, above=0)

    @property
    def C(self) -> Float64[Tensor, "3 6"]:
        """Measurement matrix of (X, Z, theta)."""
        return torch.eye(6, dtype=torch.float64)[::2]

    def from_pose(self, T_world_cam: Float64[Tensor, "*batch 4 4"]) -> Float64[Tensor, "*batch 3"]:
        """Return (X, Z, theta) of a pose, theta in [-pi, pi].

        theta is the turn about y that comes nearest to the rotation, whatever its pitch or its roll; a camera that is
        upside down by half a turn about a horizontal axis has none, and gets 0.
        """
        check_shape("T_world_cam", T_world_cam, "... 4 4")
        sine, cosine = _heading(T_world_cam)
        return torch.stack([T_world_cam[..., 0, 3], T_world_cam[..., 2, 3], torch.atan2(sine, cosine)], -1)

    def measurement_covariance(
        self, T_world_cam: Float64[Tensor, "*batch 4 4"], covariance: Float64[Tensor, "*batch 6 6"]
    ) -> Float64[Tensor, "*batch 3 3"]:
        """Return the covariance of (X, Z, theta) from an alignment's own; it says nothing where there is no heading.

        Args:
            T_world_cam: The pose.
            covariance: Of the left error [v, w] of its inverse, T_cam_world <- Exp(xi) T_cam_world.
        """
        check_shape("T_world_cam", T_world_cam, "... 4 4")
        check_shape("covariance", covariance, "... 6 6")
        R = T_world_cam[..., :3, :3]
        sine, cosine = _heading(T_world_cam)
        length2 = sine.square() + cosine.square()
        tilt_x = -(cosine * R[..., 1, 0] + sine * R[..., 1, 2]) / length2
        tilt_z = (sine * R[..., 1, 0] - cosine * R[..., 1, 2]) / length2
        J_theta_turn = torch.stack([tilt_x, torch.ones_like(tilt_x), tilt_z], -1)[..., None, :]
        # T_world_cam Exp(-xi): the centre moves by -R v, the rotation turns by -R w in the world.
        J = torch.cat([-R[..., ::2, :], torch.zeros_like(R[..., ::2, :])], -1)
        J_theta = torch.cat([torch.zeros_like(J_theta_turn), -J_theta_turn @ R], -1)
        J = torch.cat([J, J_theta], -2)
        return symmetrized(J @ covariance @ J.mT)

    def predict(self, state: Gaussian, dt_s: Float64[Tensor, "*batch"]) -> Gaussian:
        """Move a state by `dt_s` seconds."""
        k = dt_s.new_tensor([self.acceleration, self.acceleration, self.turn_acceleration])
        return predict(state, *constant_velocity(dt_s, k))

    def update(
        self, state: Gaussian, z: Float64[Tensor, "*batch 3"], R: Float64[Tensor, "*batch 3 3"]
    ) -> tuple[Gaussian, Innovation]:
        """Correct a state by a measured (X, Z, theta) of covariance R; theta counts modulo a whole turn."""
        check_shape("z", z, "... 3")
        residual = z - state.mean[..., ::2]
        turn = torch.remainder(residual[..., 2] + torch.pi, 2 * torch.pi) - torch.pi
        return correct(state, torch.cat([residual[..., :2], turn[..., None]], -1), self.C.to(z), R)


def _heading(T: Float64[Tensor, "*batch 4 4"]) -> tuple[Float64[Tensor, "*batch"], Float64[Tensor, "*batch"]]:
    """Return sine and cosine, up to one factor, of the turn about y nearest to a rotation; (0, 1) where none is."""
    sine, cosine = T[..., 0, 2] - T[..., 2, 0], T[..., 0, 0] + T[..., 2, 2]
    # Rounding of the four entries: below it the direction means nothing.
    none = sine.square() + cosine.square() < 1e-24
    return torch.where(none, 0.0, sine), torch.where(none, 1.0, cosine)
