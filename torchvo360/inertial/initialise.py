"""Scale, gravity, velocities and biases at the start, from the poses of a monocular map and the IMU beside the camera.

Three steps, each the start of the next:

1. the gyro's bias from the rotations between poses (a Gauss-Newton of three unknowns);
2. velocities, scale and gravity, in which position and velocity increments are linear, over poses at least a quarter
   of a second apart and without the accelerometer's bias;
3. everything at once by Levenberg-Marquardt on the inertial residual, gravity's length held: velocities, biases,
   log-scale, the two angles of gravity, and the poses themselves within the uncertainty of the images. Were the poses
   held, their noise would draw the scale to zero as noise in any regressor does.

The uncertainty of the images is found on the way, as variance components: the poses' residuals over their redundancy.
Source: Mur-Artal and Tardos, "Visual-Inertial Monocular SLAM with Map Reuse", RA-L 2017 (steps 1 and 2); Campos et al.,
"Inertial-Only Optimization for Visual-Inertial Initialization", ICRA 2020 (step 3, there with the poses held).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_finite_number, check_pose, check_shape
from torchvo360.inertial.joint import (
    MAX_LOG_SCALE,
    Poses,
    Priors,
    State,
    covariance,
    image_rows,
    minimise,
)
from torchvo360.inertial.linear import FEWEST, fit_gyro_bias, solve_linear
from torchvo360.inertial.samples import GRAVITY, ImuSensor

ROUNDS = 6
"""Most times that the images' uncertainty is fitted and the samples are integrated again."""
SETTLED = 0.05
"""Relative change of the images' uncertainty at which the rounds end."""
FREE = 0.02
"""Least share of the poses' errors that counts as not fitted away."""


@dataclass(kw_only=True)
class InertialStartConfig:
    """Settings of the inertial start."""

    position: float = 3e-4
    """Least standard deviation of a pose's position, in the map's unit."""
    rotation: float = 3e-4
    """Least standard deviation of a pose's rotation, radians."""
    bias_gyro: float = 0.1
    """Standard deviation of the gyro's bias about zero, rad/s."""
    bias_accel: float = 0.2
    """Standard deviation of the accelerometer's bias about zero, m/s^2."""
    max_scale_deviation: float = 0.05
    """Standard deviation of the log-scale above which the motion does not tell the scale."""
    max_gap_s: float = 0.1
    """Longest time without a sample that is integrated over, seconds."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_finite_number(name, value, above=0)


@dataclass(frozen=True, eq=False)
class InertialStart:
    """What the IMU told of the start; where not `ok` it is the best guess, and finite."""

    ok: bool
    reason: str
    """Empty, or a sentence why it is not `ok`."""
    log_scale: Float64[Tensor, ""]
    """Logarithm of the metres in one unit of the map."""
    gravity: Float64[Tensor, "3"]
    """In the map's axes, m/s^2, downwards."""
    motions: Float64[Tensor, "N 9"]
    """Of every pose: velocity of the IMU in the map's axes (m/s), gyro bias (rad/s), accelerometer bias (m/s^2)."""
    covariance: Float64[Tensor, "3 3"]
    """Of the log-scale and the two angles of gravity (`residuals.inertial.turn_gravity`), radians."""
    position_deviation: float
    """Standard deviation of a pose's position, in the map's unit, as found."""
    rotation_deviation: float
    """Of a pose's rotation, radians."""


def initialise(
    T_cam_world: Float64[Tensor, "N 4 4"],
    t_ns: Int64[Tensor, "N"],
    sensor: ImuSensor,
    config: InertialStartConfig | None = None,
) -> InertialStart:
    """Find scale, gravity, velocities and biases from poses that a monocular camera gave.

    Args:
        T_cam_world: World to camera, in any unit and any axes; up to about 60 of them, best 0.1 to 0.5 s apart.
        t_ns: Their times, increasing, in the camera's time.
        sensor: The IMU; its `offset_s` must be known to a few milliseconds.
        config: Settings.

    Returns:
        The start; not `ok` where the samples do not cover the poses or the motion does not tell the scale.

    Raises:
        InputError: The poses are none or their times do not increase.
        ShapeError: The shapes do not fit.
    """
    N = check_shape("T_cam_world", T_cam_world, "N 4 4")["N"]
    check_pose("T_cam_world", T_cam_world)
    check_shape("t_ns", t_ns, f"{N}")
    if t_ns.dtype != torch.int64 or not bool((t_ns.diff() > 0).all()):
        raise InputError("t_ns: expected increasing times in integer nanoseconds, got others.")
    config = InertialStartConfig() if config is None else config
    T_cam_world = T_cam_world.double()
    poses = Poses(T_cam_world, t_ns - round(sensor.offset_s * 1e9), sensor, config.max_gap_s)
    if N < FEWEST:
        return _failed(poses, config, f"The inertial start needs {FEWEST} poses, got {N}.")
    bias_gyro = fit_gyro_bias(poses)
    if bias_gyro is None:
        return _failed(poses, config, "The IMU's samples do not cover the time of the poses.")
    state = solve_linear(poses, bias_gyro)
    if state is None:
        return _failed(poses, config, "The motion does not tell the scale: no acceleration goes with the map's.")
    return _refined(poses, config, state)


def _failed(poses: Poses, config: InertialStartConfig, reason: str) -> InertialStart:
    """Return a start without knowledge."""
    like = poses.T_cam_world
    return InertialStart(
        False,
        reason,
        like.new_zeros(()),
        like.new_tensor([0.0, 0.0, -GRAVITY]),
        like.new_zeros(len(like), 9),
        torch.eye(3).to(like) * MAX_LOG_SCALE**2,
        config.position,
        config.rotation,
    )


def _refined(poses: Poses, config: InertialStartConfig, state: State) -> InertialStart:
    """Minimise over everything at once, fitting the images' uncertainty in rounds."""
    least = state.log_scale.new_tensor([config.position, config.rotation])
    visual = least
    state, P = _solved(poses, config, state, visual)
    for _ in range(ROUNDS):
        fitted = torch.maximum(_fit_visual(poses, state, P, visual), least)
        if bool(((fitted / visual - 1).abs() < SETTLED).all()):
            break
        visual = fitted
        state, P = _solved(poses, config, state, visual)
    shared = P[-3:, -3:]
    deviation = float(shared[0, 0].sqrt())
    reason = ""
    if not deviation <= config.max_scale_deviation:
        reason = f"The motion does not tell the scale: it is uncertain by {100 * deviation:.3g} %."
    return InertialStart(
        not reason, reason, state.log_scale, state.gravity, state.motion, shared, float(visual[0]), float(visual[1])
    )


def _solved(
    poses: Poses, config: InertialStartConfig, state: State, visual: Float64[Tensor, "2"]
) -> tuple[State, Float64[Tensor, "D D"]]:
    """Return the most likely state under the images' uncertainty, and the covariance of all unknowns."""
    pre = poses.segments(state.motion[:, 3:])
    state, system = minimise(poses, state, pre, Priors(visual, config.bias_gyro, config.bias_accel))
    return state, covariance(system.H)


def _fit_visual(
    poses: Poses, state: State, P: Float64[Tensor, "D D"], visual: Float64[Tensor, "2"]
) -> Float64[Tensor, "2"]:
    """Return the deviations of position and rotation that explain the residuals of the images.

    Of each kind the sum of squares is held against its expectation, the variance less what was fitted away.
    Source: Foerstner, "Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten", 1979.
    """
    away, J, place = image_rows(poses, state)
    fitted_away = (J @ P[place[:, :, None], place[:, None, :]] @ J.mT).diagonal(dim1=-2, dim2=-1)
    spent, seen = (value.unflatten(-1, (2, 3)).sum((0, 2)) for value in (fitted_away, away.square()))
    whole = 3 * len(away) * visual.square()
    return visual * (seen / (whole - spent).clamp_min(FREE * whole)).sqrt()
