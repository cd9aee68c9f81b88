"""A Kalman filter on SE(3): a camera of constant velocity, by its pose, its twist and the error of both.

The state is a pose T_cam_key and a twist [v, w] per second in the camera's axes, `T(t + dt) = Exp(twist dt) T(t)`. The
error is e = [xi, d] with `T_true = Exp(xi) T` and `twist_true = twist + d`: 12 numbers with a covariance. Between
measurements it obeys `xi' = ad(twist) xi + d`, `d' = white acceleration`, whose transition and noise are exact here:
two half steps are one step, however unevenly frames come. A measured pose corrects it in the Joseph form. Every left
error lives in the camera's axes, as the alignment's covariance does, so that a change of keyframe leaves it as it is.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.backends import are_plain
from torchvo360.checks import InputError, check_finite_number, check_pose, check_shape, is_pose
from torchvo360.motion import single
from torchvo360.motion.kalman import (
    Gaussian,
    Innovation,
    correct,
    smoothed_covariance,
    smoothing_gain,
    symmetrized,
)


@dataclass(kw_only=True)
class PoseFilterConfig:
    """Settings of the motion filter; the defaults suit a hand-held camera."""

    acceleration: float = 0.2
    """Density of the linear acceleration, median ranges of the scene / s^2 / sqrt(Hz).

    Source: successive twists of a hand-held camera (0.2 to 0.35 m over ranges of 1 to 2 m, TUM RGB-D) and of a walk
    through a furnished house (0.3 to 0.5 m over 2 to 3 m), 7 to 30 frames a second."""
    turn_acceleration: float = 1.0
    """Density of the angular acceleration, rad / s^2 / sqrt(Hz).

    Source: as above: 1.05 to 1.25 hand-held, 0.3 to 0.7 for a carried 360 camera."""
    start_speed: float = 0.5
    """Standard deviation of each component of the velocity at the start, median ranges of the scene per second."""
    start_turn_rate: float = 1.0
    """Standard deviation of each component of the angular rate at the start, rad/s."""
    gate: float = 22.46
    """Squared Mahalanobis distance within which a measured pose is plausible: 99.9 % of chi-square with 6 degrees."""

    def __post_init__(self) -> None:
        for name in ("acceleration", "turn_acceleration", "start_speed", "start_turn_rate", "gate"):
            check_finite_number(name, getattr(self, name), above=0)


class PosePrediction(NamedTuple):
    """A pose with the uncertainty of its left error."""

    T_cam_key: Float64[Tensor, "*batch 4 4"]
    covariance: Float64[Tensor, "*batch 6 6"]
    """Of xi in T_true = Exp(xi) T: in the camera's axes, as an alignment's."""


@dataclass(frozen=True, eq=False)
class PoseState:
    """Where a camera is, how it moves, and how well both are known."""

    T_cam_key: Float64[Tensor, "*batch 4 4"]
    twist: Float64[Tensor, "*batch 6"]
    """[v, w] per second in the camera's axes: T(t + dt) = Exp(twist dt) T(t)."""
    covariance: Float64[Tensor, "*batch 12 12"]
    """Of the error [xi, d]: T_true = Exp(xi) T, twist_true = twist + d."""
    median_range: float
    """Median range of the scene, in the unit of the poses: the length that accelerations are measured in."""

    @property
    def prediction(self) -> PosePrediction:
        """The pose and the covariance of its error alone."""
        return PosePrediction(self.T_cam_key, self.covariance[..., :6, :6])

    def rekeyed(self, T_new_old: Float64[Tensor, "*batch 4 4"], median_range: float | None = None) -> "PoseState":
        """Return the state against another keyframe; twist and covariance are the camera's own and stay.

        Args:
            T_new_old: The old keyframe in the new one.
            median_range: Of the scene from the new keyframe, where it has changed.
        """
        check_pose("T_new_old", T_new_old)
        T = lie.se3_normalized(self.T_cam_key @ lie.se3_inverse(T_new_old.double()))
        return PoseState(
            T, self.twist, self.covariance, self.median_range if median_range is None else _range(median_range)
        )

    def rescaled(self, factor: float) -> "PoseState":
        """Return the state in another unit of length: lengths that were 1 are now `factor`."""
        check_finite_number("factor", factor, above=0)
        scale = self.twist.new_tensor([factor] * 3 + [1.0] * 3)
        both = torch.cat([scale, scale])
        T = lie.se3(self.T_cam_key[..., :3, :3], self.T_cam_key[..., :3, 3] * factor)
        covariance = self.covariance * both[:, None] * both
        return PoseState(T, self.twist * scale, covariance, self.median_range * factor)


@dataclass(frozen=True)
class PoseFilter:
    """The filter; it holds settings only, and every call returns a new state."""

    config: PoseFilterConfig = field(default_factory=PoseFilterConfig)

    def start(
        self,
        T_cam_key: Float64[Tensor, "*batch 4 4"],
        covariance: Float64[Tensor, "*batch 6 6"] | None = None,
        *,
        median_range: float = 1.0,
    ) -> PoseState:
        """Return a state at rest, its velocity unknown.

        Args:
            T_cam_key: Poses.
            covariance: Of their left error; None where they are exact, as a keyframe's own pose is.
            median_range: Median range of the scene, in the unit of the poses.

        Raises:
            InputError: A pose is none, the covariance is not finite, or the range not positive.
        """
        check_pose("T_cam_key", T_cam_key)
        T = T_cam_key.double()
        full = T.new_zeros(*T.shape[:-2], 12, 12)
        if covariance is not None:
            check_shape("covariance", covariance, "... 6 6")
            if not bool(torch.isfinite(covariance).all()):
                raise InputError("covariance: expected finite numbers, got others.")
            full[..., :6, :6] = covariance
        speed, rate = self.config.start_speed * _range(median_range), self.config.start_turn_rate
        full[..., 6:, 6:] = torch.diag(T.new_tensor([speed**2] * 3 + [rate**2] * 3))
        return PoseState(T, T.new_zeros(*T.shape[:-2], 6), full, median_range)

    def predict(self, state: PoseState, dt_s: float | Float64[Tensor, "*batch"]) -> PoseState:
        """Move a state by `dt_s` seconds, one number for all or one for each; `.prediction` of it is the prior pose.

        Raises:
            InputError: A time is negative or not finite.
        """
        if isinstance(dt_s, float) and dt_s >= 0 and _is_single(state):
            T, twist, P = (value.numpy() for value in (state.T_cam_key, state.twist, state.covariance))
            if single.angle(twist) * dt_s <= single.MOST_TURN:
                moved, covariance = single.predicted(T, twist, P, dt_s, np.array(self._density2(state)))
                return PoseState(torch.from_numpy(moved), state.twist, torch.from_numpy(covariance), state.median_range)
        dt = torch.as_tensor(dt_s, dtype=state.twist.dtype, device=state.twist.device)
        if not bool((torch.isfinite(dt) & (dt >= 0)).all()):
            raise InputError(f"dt_s: expected finite numbers of at least 0, got {dt_s}.")
        F, Q = transition(state.twist, dt, state.twist.new_tensor(self._density2(state)))
        T = _moved(state.T_cam_key, state.twist * dt[..., None])
        twist = state.twist.expand(*T.shape[:-2], 6)
        return PoseState(T, twist, symmetrized(F @ state.covariance @ F.mT + Q), state.median_range)

    def update(
        self,
        state: PoseState,
        T_measured: Float64[Tensor, "*batch 4 4"],
        covariance: Float64[Tensor, "*batch 6 6"],
    ) -> tuple[PoseState, Innovation]:
        """Correct a state by measured poses T_cam_key whose left error has this covariance.

        Returns:
            The state. An element whose measurement is no pose or whose innovation covariance is not positive definite
            keeps its prediction, its neighbours untouched.
            The innovation [v, w]; `plausible` judges it. A state that is refused is simply not kept.
        """
        check_shape("T_measured", T_measured, "... 4 4")
        check_shape("covariance", covariance, "... 6 6")
        if T_measured.ndim == 2 and covariance.ndim == 2 and _is_single(state) and are_plain(T_measured, covariance):
            return _updated(state, T_measured.double(), covariance.double())
        T_measured = T_measured.double()
        valid = is_pose(T_measured)
        # The logarithm of what is no pose would leave NaN in the gradients: the element fails by its residual instead.
        T_safe = torch.where(valid[..., None, None], T_measured, state.T_cam_key)
        residual = lie.se3_log(T_safe @ lie.se3_inverse(state.T_cam_key))
        residual = torch.where(valid[..., None], residual, torch.nan)
        C = torch.eye(6, 12, dtype=residual.dtype, device=residual.device)
        error = Gaussian(residual.new_zeros(*residual.shape[:-1], 12), state.covariance)
        corrected, innovation = correct(error, residual, C, covariance.double())
        return _injected(state, corrected), innovation

    def plausible(self, innovation: Innovation) -> Bool[Tensor, "*batch"]:
        """Return which measurements the motion so far makes credible: those within the gate."""
        return innovation.ok & (innovation.mahalanobis2 <= self.config.gate)

    def _density2(self, state: PoseState) -> list[float]:
        linear = (self.config.acceleration * state.median_range) ** 2
        return [linear] * 3 + [self.config.turn_acceleration**2] * 3


class SmoothTrajectory(NamedTuple):
    """A trajectory after smoothing."""

    T_world_cam: Float64[Tensor, "N 4 4"]
    covariance: Float64[Tensor, "N 6 6"]
    """Of the left error of T_cam_world, in the camera's axes."""
    twist: Float64[Tensor, "N 6"]
    """[v, w] per second of T_cam_world, in the camera's axes; the camera itself moves by -v."""


def smooth_trajectory(
    t_ns: Int64[Tensor, "N"],
    T_world_cam: Float64[Tensor, "N 4 4"],
    covariance: Float64[Tensor, "N 6 6"] | Float64[Tensor, "6 6"],
    config: PoseFilterConfig | None = None,
    *,
    median_range: float = 1.0,
) -> SmoothTrajectory:
    """Smooth a finished trajectory: the filter forwards, then Rauch, Tung and Striebel backwards.

    Args:
        t_ns: Times, strictly increasing.
        T_world_cam: Poses.
        covariance: Of the left error of T_cam_world: one for all, or one for each pose. A pose after the first whose
            covariance is not finite is not believed at all, and comes out interpolated.
        config: Settings of the motion.
        median_range: Median range of the scene in the unit of the poses; 1 if accelerations are in that unit.

    Raises:
        InputError: Fewer than two poses, times that do not increase, or a pose that is none.
    """
    N = check_shape("t_ns", t_ns, "N")["N"]
    check_shape("T_world_cam", T_world_cam, f"{N} 4 4")
    check_pose("T_world_cam", T_world_cam)
    if N < 2:
        raise InputError(f"T_world_cam: expected at least two poses, got {N}.")
    if not bool((t_ns.diff() > 0).all()):
        raise InputError("t_ns: expected strictly increasing times, got repeated or unordered ones.")
    covariance = covariance.expand(N, 6, 6)
    motion = PoseFilter(PoseFilterConfig() if config is None else config)
    dt_s = (t_ns.diff().double() * 1e-9).to(T_world_cam.device)
    measured = lie.se3_inverse(T_world_cam.double())
    filtered = [motion.start(measured[0], covariance[0], median_range=median_range)]
    predicted = []
    for k in range(1, N):
        predicted.append(motion.predict(filtered[-1], dt_s[k - 1]))
        filtered.append(motion.update(predicted[-1], measured[k], covariance[k])[0])
    P = torch.stack([state.covariance for state in filtered[:-1]])
    twist, density2 = torch.stack([state.twist for state in filtered[:-1]]), motion._density2(filtered[0])
    F, Q = transition(twist, dt_s, P.new_tensor(density2))
    gain, _ = smoothing_gain(P, F, Q)
    states = [filtered[-1]]
    for k in range(N - 2, -1, -1):
        later = states[-1]
        xi = lie.se3_log(later.T_cam_key @ lie.se3_inverse(predicted[k].T_cam_key))
        error = torch.cat([xi, later.twist - predicted[k].twist])
        spread = _carried(later.covariance, xi, back=True)
        smoothed = smoothed_covariance(P[k], spread, gain[k], F[k], Q[k])
        states.append(_injected(filtered[k], Gaussian(gain[k] @ error, smoothed)))
    states.reverse()
    return SmoothTrajectory(
        lie.se3_inverse(torch.stack([state.T_cam_key for state in states])),
        torch.stack([state.covariance[:6, :6] for state in states]),
        torch.stack([state.twist for state in states]),
    )


def transition(
    twist: Float64[Tensor, "*batch 6"], dt_s: Float64[Tensor, "*batch"], density2: Float64[Tensor, "6"]
) -> tuple[Float64[Tensor, "*batch 12 12"], Float64[Tensor, "*batch 12 12"]]:
    """Return how the error [xi, d] of a pose and its twist moves in a step, and what noise it gathers.

    Args:
        twist: [v, w] per second.
        dt_s: Time of the step, seconds.
        density2: Squared densities of the acceleration [v, w]: the noise of a twist grows by density2 dt.

    Returns:
        F = exp(G dt) with G = [[ad(twist), I], [0, 0]], that is [[Ad(Exp(twist dt)), dt J_l(twist dt)], [0, I]].
        Q, the integral of exp(G s) diag(0, density2) exp(G s)^T over s in [0, dt].

    Source: Van Loan, Computing integrals involving the matrix exponential, IEEE TAC 23(3), 1978.
    """
    shape = torch.broadcast_shapes(twist.shape[:-1], dt_s.shape)
    G = twist.new_zeros(*shape, 12, 12)
    G[..., :6, :6] = _small_adjoint(twist)
    G[..., :6, 6:] = torch.eye(6, dtype=twist.dtype, device=twist.device)
    W = torch.zeros_like(G)
    W[..., 6:, 6:] = torch.diag(density2)
    block = torch.cat([torch.cat([-G, W], -1), torch.cat([torch.zeros_like(G), G.mT], -1)], -2)
    power = torch.linalg.matrix_exp(block * dt_s[..., None, None])
    F = power[..., 12:, 12:].mT
    return F, symmetrized(F @ power[..., :12, 12:])


def _small_adjoint(xi: Float64[Tensor, "*batch 6"]) -> Float64[Tensor, "*batch 6 6"]:
    """Return ad with `se3_adjoint(se3_exp(xi)) == exp(ad)`."""
    turn = lie.so3_hat(xi[..., 3:])
    top = torch.cat([turn, lie.so3_hat(xi[..., :3])], -1)
    return torch.cat([top, torch.cat([torch.zeros_like(turn), turn], -1)], -2)


def _left_jacobian(xi: Float64[Tensor, "*batch 6"]) -> Float64[Tensor, "*batch 6 6"]:
    """Return J_l with `exp(xi + d) = exp(J_l d) exp(xi)` to first order."""
    return lie.sim3_left_jacobian(torch.nn.functional.pad(xi, (0, 1)))[..., :6, :6]


def _moved(T: Float64[Tensor, "*batch 4 4"], xi: Float64[Tensor, "*batch 6"]) -> Float64[Tensor, "*batch 4 4"]:
    return lie.se3_normalized(lie.se3_exp(xi) @ T)


def _carried(
    covariance: Float64[Tensor, "*batch 12 12"], xi: Float64[Tensor, "*batch 6"], *, back: bool = False
) -> Float64[Tensor, "*batch 12 12"]:
    """Return a covariance about T, written in errors about Exp(xi) T; or the other way with `back`."""
    J = _left_jacobian(xi)
    both = torch.eye(12, dtype=xi.dtype, device=xi.device).repeat(*xi.shape[:-1], 1, 1)
    both[..., :6, :6] = torch.linalg.inv(J) if back else J
    return symmetrized(both @ covariance @ both.mT)


def _injected(state: PoseState, error: Gaussian) -> PoseState:
    """Move a state by the mean of its error; what is left has mean zero about the moved state."""
    xi = error.mean[..., :6]
    return PoseState(
        _moved(state.T_cam_key, xi),
        state.twist + error.mean[..., 6:],
        _carried(error.covariance, xi),
        state.median_range,
    )


def _is_single(state: PoseState) -> bool:
    """Return whether NumPy may take a step of a state: there is one alone, and nobody asks for its derivatives."""
    return state.twist.ndim == 1 and are_plain(state.T_cam_key, state.twist, state.covariance)


def _updated(
    state: PoseState, T_measured: Float64[Tensor, "4 4"], covariance: Float64[Tensor, "6 6"]
) -> tuple[PoseState, Innovation]:
    """Correct one state in NumPy."""
    given = (state.T_cam_key, state.twist, state.covariance, T_measured, covariance)
    new = single.updated(*(value.numpy() for value in given))
    T, twist, P, residual, S = (torch.from_numpy(value) for value in new[:5])
    distance = torch.tensor(new.mahalanobis2, dtype=torch.float64)
    return PoseState(T, twist, P, state.median_range), Innovation(residual, S, distance, torch.tensor(new.ok))


def _range(median_range: float) -> float:
    check_finite_number("median_range", median_range, above=0)
    return median_range
