"""Velocities, biases, scale, gravity and poses at once, by Levenberg-Marquardt on the IMU's residuals and the images'.

Unknowns are, of every pose, its tangent in metres, velocity and biases [15], and of all the log-scale and gravity's two
angles. Positions are metric: the inertial residuals, a hundred times stiffer than the images, are then nearly linear,
and the product of scale and position is in the images' residuals alone. With positions in the map's unit the steps
creep along the bend of that product.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.inertial.preintegration import preintegrate
from torchvo360.inertial.samples import ImuSensor
from torchvo360.lie import se3, se3_exp, se3_inverse, se3_log
from torchvo360.residuals.inertial import Preintegrated, linearize_inertial, turn_gravity

STEPS = 20
DECREASE = 1e-2
"""Decrease of the cost, a chi squared, at which the steps end: a tenth of a standard deviation."""
MAX_LOG_SCALE = 12.0
"""A unit of a map is between 6 micrometres and 160 km: beyond it the scale has run away."""
VELOCITY = 50.0
"""Deviation of the prior velocity, m/s: it matters only for a pose that no sample reaches."""


@dataclass(frozen=True, eq=False)
class Poses:
    """The images' poses of a start and the IMU beside them."""

    T_cam_world: Float64[Tensor, "N 4 4"]
    """In the map's unit."""
    t_ns: Int64[Tensor, "N"]
    """In the IMU's time."""
    sensor: ImuSensor
    max_gap_s: float

    def take(self, index: Int64[Tensor, "M"]) -> "Poses":
        """Return the poses of an index."""
        return Poses(self.T_cam_world[index], self.t_ns[index], self.sensor, self.max_gap_s)

    def segments(self, bias: Float64[Tensor, "*N 6"]) -> Preintegrated:
        """Integrate from each pose to the next, with one bias (gyro, accelerometer) for all or one a pose."""
        bias = bias if bias.ndim == 1 else bias[:-1]
        return preintegrate(
            self.sensor.samples,
            self.t_ns[:-1],
            self.t_ns[1:],
            bias[..., :3],
            bias[..., 3:],
            self.sensor.noise,
            max_gap_s=self.max_gap_s,
        )

    @property
    def R_world_imu(self) -> Float64[Tensor, "N 3 3"]:
        """The IMU's rotations as the images have them."""
        return self.T_cam_world[:, :3, :3].mT @ self.sensor.T_cam_imu[:3, :3]


@dataclass(frozen=True, eq=False)
class Priors:
    """Standard deviations of what is known beside the IMU's samples."""

    visual: Float64[Tensor, "2"]
    """Of the poses' positions, in the map's unit, and rotations, radians."""
    bias_gyro: float
    """Of the gyro's bias about zero, rad/s."""
    bias_accel: float
    """Of the accelerometer's bias about zero, m/s^2."""


class State(NamedTuple):
    """The unknowns."""

    T_cam_world: Float64[Tensor, "N 4 4"]
    """Metres."""
    motion: Float64[Tensor, "N 9"]
    log_scale: Float64[Tensor, ""]
    gravity: Float64[Tensor, "3"]

    def moved(self, step: Float64[Tensor, "D"]) -> "State":
        """Return the state after a step."""
        by_pose = step[:-3].view(-1, 15)
        return State(
            se3_exp(by_pose[:, :6]) @ self.T_cam_world,
            self.motion + by_pose[:, 6:],
            (self.log_scale + step[-3]).clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE),
            turn_gravity(self.gravity, step[-2:]),
        )

    def in_units(self) -> Float64[Tensor, "N 4 4"]:
        """Return T_cam_world in the map's unit."""
        return scaled(self.T_cam_world, -self.log_scale)


class System(NamedTuple):
    """Normal equations H step = -g, and the sum of all squared residuals over their variances."""

    H: Float64[Tensor, "D D"]
    g: Float64[Tensor, "D"]
    cost: float


def scaled(T: Float64[Tensor, "*batch 4 4"], log_scale: Float64[Tensor, ""]) -> Float64[Tensor, "*batch 4 4"]:
    """Return poses in another unit."""
    return se3(T[..., :3, :3], T[..., :3, 3] * log_scale.exp())


def minimise(poses: Poses, state: State, pre: Preintegrated, priors: Priors) -> tuple[State, System]:
    """Minimise from a state; return the lowest with its normal equations."""
    system = _system(poses, state, pre, priors)
    damping = 1e-6
    for _ in range(STEPS):
        damped = system.H + damping * torch.diag(system.H.diagonal())
        L, failed = torch.linalg.cholesky_ex(damped)
        trial = state
        if int(failed) == 0:
            trial = state.moved(-torch.cholesky_solve(system.g[:, None], L)[:, 0])
        tried = _system(poses, trial, pre, priors)
        if int(failed) == 0 and tried.cost < system.cost:
            done = system.cost - tried.cost < DECREASE
            state, system, damping = trial, tried, damping / 10
            if done:
                break
        else:
            damping *= 100
    return state, system


def image_rows(
    poses: Poses, state: State
) -> tuple[Float64[Tensor, "N 6"], Float64[Tensor, "N 6 7"], Int64[Tensor, "N 7"]]:
    """Return how far poses are from the images' (xi of T = Exp(xi) T_images), its Jacobians, and by which unknowns.

    The Jacobian of the logarithm is taken as one: xi is a few milliradians.
    """
    T = state.in_units()
    away = se3_log(T @ se3_inverse(poses.T_cam_world))
    N, k = len(T), torch.arange(len(T))
    J = torch.eye(6, 7).to(T).repeat(N, 1, 1)
    J[:, :3, :3] *= (-state.log_scale).exp()
    J[:, :3, 6] = -T[:, :3, 3]
    place = torch.cat([15 * k[:, None] + torch.arange(6), torch.full((N, 1), 15 * N)], -1)
    return away, J, place


def _system(poses: Poses, state: State, pre: Preintegrated, priors: Priors) -> System:
    """Linearise the inertial residuals and the priors of poses, velocities and the first biases."""
    T, motion = state.T_cam_world, state.motion
    N = len(T)
    rows = linearize_inertial(
        pre,
        T[:-1],
        T[1:],
        motion[:-1],
        motion[1:],
        torch.zeros_like(state.log_scale),
        state.gravity,
        poses.sensor.T_cam_imu,
        poses.sensor.noise,
    )
    H, g = T.new_zeros(15 * N + 3, 15 * N + 3), T.new_zeros(15 * N + 3)
    k = torch.arange(N - 1)
    J = torch.cat([rows.by_i, rows.by_j, rows.by_shared[..., 1:]], -1)
    place = 15 * k[:, None] + torch.arange(30)
    place = torch.cat([place, (15 * N + torch.arange(1, 3)).expand(N - 1, 2)], -1)
    cost = _add(H, g, place, J, rows.information, rows.residual)
    away, J, place = image_rows(poses, state)
    precision = torch.diag(priors.visual.repeat_interleave(3).square().reciprocal()).expand(N, 6, 6)
    cost += _add(H, g, place, J, precision, away)
    # Priors of all velocities and of the first biases, about zero.
    weight = torch.full_like(motion, 1 / VELOCITY**2)
    weight[:, 3:] = 0
    weight[0, 3:6] = 1 / priors.bias_gyro**2
    weight[0, 6:] = 1 / priors.bias_accel**2
    H.diagonal()[:-3].view(N, 15)[:, 6:] += weight
    g[:-3].view(N, 15)[:, 6:] += weight * motion
    return System(H, g, cost + float((weight * motion.square()).sum()))


def _add(
    H: Float64[Tensor, "D D"],
    g: Float64[Tensor, "D"],
    place: Int64[Tensor, "B P"],
    J: Float64[Tensor, "B R P"],
    information: Float64[Tensor, "B R R"],
    residual: Float64[Tensor, "B R"],
) -> float:
    """Add the rows of residuals to the normal equations and return their cost."""
    JW, r = J.mT @ information, residual[..., None]
    H.index_put_((place[:, :, None], place[:, None, :]), JW @ J, accumulate=True)
    g.index_put_((place,), (JW @ r)[..., 0], accumulate=True)
    return float((r.mT @ information @ r).sum())


def covariance(H: Float64[Tensor, "D D"]) -> Float64[Tensor, "D D"]:
    """Return the covariance of normal equations; a large one where there is none."""
    size = H.diagonal().clamp_min(torch.finfo(H.dtype).tiny).rsqrt()
    L, failed = torch.linalg.cholesky_ex(H * size[:, None] * size)
    if int(failed) != 0:
        return torch.eye(len(H)).to(H) * MAX_LOG_SCALE**2
    return torch.cholesky_inverse(L) * size[:, None] * size
