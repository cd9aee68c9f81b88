"""An IMU in the window: its normal equations, what it tells of scale and gravity, and what it leaves behind."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from window_scenes import scene

from torchvo360 import lie
from torchvo360.checks import InputError
from torchvo360.data.synthetic import SyntheticSequence
from torchvo360.inertial import ImuSensor, Preintegrated, preintegrate
from torchvo360.residuals.inertial import inertial_residual, turn_gravity
from torchvo360.solve.schur import reduce
from torchvo360.window import Coupling, Metric, Window, WindowConfig, WindowFrame
from torchvo360.window.inertial import linearize_coupling
from torchvo360.window.layout import Layout
from torchvo360.window.state import Estimate
from torchvo360.window.system import LEAST_CURVATURE

PLACES = (0, 8, 16, 24)
IMU = {"imu_rate": 200.0, "imu_noise": 0.0, "imu_bias": 0.0, "seed": 3}
CONFIG = WindowConfig(steps=30, tolerance=1e-9)
WEIGHT = 0.05**2
LOOSE = torch.tensor([1.0] * 3 + [0.01] * 3 + [0.1] * 3 + [0.5] * 3, dtype=torch.float64)
"""Standard deviations of a prior that says little."""


def truth(sequence: SyntheticSequence) -> tuple[ImuSensor, Tensor, Tensor]:
    """The sensor, gravity in the axes of the first keyframe, and the velocity of the IMU there at every place."""
    sensor = sequence.imu
    assert sensor is not None
    R_first_world = sequence.pose(PLACES[0])[:3, :3].mT
    around = torch.stack(
        [sequence.pose(at) @ sensor.T_cam_imu for place in PLACES for at in (max(place - 1, 0), place + 1)]
    )
    steps = torch.tensor([(place + 1 - max(place - 1, 0)) / 30 for place in PLACES], dtype=torch.float64)
    velocity = around[:, :3, 3].view(-1, 2, 3).diff(dim=1)[:, 0] / steps[:, None]
    gravity = R_first_world @ torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
    return sensor, gravity, velocity @ R_first_world.mT


def segments(sequence: SyntheticSequence, places: tuple[int, ...] = PLACES) -> Preintegrated:
    sensor = sequence.imu
    assert sensor is not None
    t = sequence.truth.t_ns[list(places)]
    none = torch.zeros(3, dtype=torch.float64)
    return preintegrate(sensor.samples, t[:-1], t[1:], none, none, sensor.noise)


def coupled(unit: float = 1.0, off_scale: float = 0.0, off_turn: float = 0.0) -> Window:
    """A window whose unit is `unit` metres, with what the IMU is to find out given wrongly."""
    made = scene(*PLACES, frames=30, **IMU)
    window = made.window(CONFIG)
    sensor, gravity, velocity = truth(made.sequence)
    window.frames = [
        replace(f, T_cam_world=lie.se3(f.T_cam_world[:3, :3], f.T_cam_world[:3, 3] / unit)) for f in window.frames
    ]
    assert window.points is not None
    window.points.rho = window.points.rho * unit
    window.hold_scale(3)
    turned = turn_gravity(gravity, torch.tensor([off_turn, -off_turn], dtype=torch.float64))
    log_scale = torch.tensor(unit, dtype=torch.float64).log() + off_scale
    window.couple(
        Coupling(sensor.T_cam_imu, sensor.noise, WEIGHT, segments(made.sequence)),
        Metric(log_scale, torch.zeros(2, dtype=torch.float64), turned),
        torch.cat([velocity, torch.zeros(len(PLACES), 6, dtype=torch.float64)], 1),
        1 / LOOSE.square(),
    )
    return window


def test_the_normal_equations_are_those_of_the_residuals_by_all_unknowns():
    window = coupled(2.5)
    assert window.coupling is not None
    assert window.points is not None
    estimate, coupling, layout = window.estimate(window.points), window.coupling, window.layout
    generator = torch.Generator().manual_seed(1)
    estimate = estimate.moved(
        0.05 * torch.randn(layout.size, generator=generator, dtype=torch.float64), torch.zeros(())
    )
    pre = coupling.segments
    information = torch.linalg.inv(pre.covariance)

    def residual(step: Tensor) -> Tensor:
        there: Estimate = estimate.moved(step, torch.zeros(()))
        assert there.motion is not None
        assert there.metric is not None
        T, motion, metric = there.T_cam_world, there.motion, there.metric
        return inertial_residual(
            pre, T[:-1], T[1:], motion[:-1], motion[1:], metric.log_scale, metric.gravity, coupling.T_cam_imu
        )

    none = torch.zeros(layout.size, dtype=torch.float64)
    J, r = torch.func.jacfwd(residual)(none), residual(none)
    walk = coupling.noise.gyro_walk**2 * pre.dt[:, None].expand(-1, 3), coupling.noise.accel_walk**2 * pre.dt[:, None]
    whole = torch.zeros(len(pre.dt), 15, 15, dtype=torch.float64)
    whole[:, :9, :9] = information
    whole[:, 9:, 9:] = torch.diag_embed(1 / torch.cat([walk[0], walk[1].expand(-1, 3)], 1))
    H = WEIGHT * torch.einsum("bid,bij,bje->de", J, whole, J)
    g = WEIGHT * torch.einsum("bid,bij,bj->d", J, whole, r)
    system = linearize_coupling(coupling, estimate, layout)
    scale = H.diagonal().clamp_min(1e-12).sqrt()
    # The turn of gravity is taken from where it was first: by the square of that turn another derivative.
    torch.testing.assert_close(system.H / scale / scale[:, None], H / scale / scale[:, None], rtol=0, atol=5e-3)
    torch.testing.assert_close(system.g / scale, g / scale, rtol=2e-2, atol=1e-3 * float((g / scale).abs().max()))
    assert system.energy == pytest.approx(0.5 * WEIGHT * float(torch.einsum("bi,bij,bj->", r, whole, r)), rel=1e-6)
    parts = [linearize_coupling(coupling, estimate, layout, segment=at) for at in range(3)]
    torch.testing.assert_close(sum(part.H for part in parts), system.H)


@pytest.mark.parametrize("unit", [1.0, 3.0])
@pytest.mark.parametrize("off_scale", [-0.1, 0.1])
def test_the_window_finds_scale_and_gravity(unit, off_scale):
    window = coupled(unit, off_scale, 0.01)
    window.optimise()
    _, gravity, velocity = truth(scene(*PLACES, frames=30, **IMU).sequence)
    assert window.metric is not None
    # Within what 0.8 s tell it: the accelerometer's bias is hardly known beside them.
    assert float(window.metric.log_scale.exp()) == pytest.approx(unit, rel=0.02)
    apart = torch.linalg.vector_norm(torch.linalg.cross(window.metric.gravity, gravity)) / 9.81**2
    assert float(apart) < 6e-3  # from 0.014
    motions = torch.stack([frame.motion for frame in window.frames if frame.motion is not None])
    assert float((motions[1:, :3] - velocity[1:]).abs().max()) < 0.04
    assert float(motions[:, 3:6].abs().max()) < 3e-3


def scale_deviation(window: Window) -> float:
    """Of the log-scale, by the curvature of the window's whole energy with the points eliminated."""
    assert window.points is not None
    system = window.linearize(window.points, window.estimate(window.points), None)
    images = system.images
    A, _ = reduce(images.H, images.g, images.cross, images.curvature + LEAST_CURVATURE, images.slope)
    H = system.H.clone()
    H[: len(A), : len(A)] += A
    return float(torch.linalg.inv(H)[window.layout.metric, window.layout.metric][0, 0].sqrt())


def test_the_prior_holds_what_the_samples_of_the_oldest_keyframe_said():
    window = coupled(2.0, 0.05)
    window.optimise()
    assert window.metric is not None
    knew, as_surely = float(window.metric.log_scale), scale_deviation(window)
    window.drop_frame(0)
    assert window.layout == Layout(3, inertial=True)
    assert window.prior is not None
    assert window.prior.H.shape == (3 * 17 + 3,) * 2
    assert window.coupling is not None
    assert len(window.coupling.segments.dt) == 2
    assert scale_deviation(window) < 1.3 * as_surely
    window.optimise()
    assert window.metric is not None
    assert float(window.metric.log_scale) == pytest.approx(knew, abs=0.015)
    # Without it three keyframes and two segments know little.
    H = window.prior.H.clone()
    H[window.layout.visual :], H[:, window.layout.visual :] = 0.0, 0.0
    H.diagonal()[window.layout.visual :] = 1e-6
    window.prior = replace(window.prior, H=H)
    assert scale_deviation(window) > 3 * as_surely


def test_a_keyframe_that_comes_brings_its_motion_and_its_segment():
    made = scene(*PLACES, frames=30, **IMU)
    window = coupled()
    last = window.frames[-1]
    segment = segments(made.sequence, (24, 29))
    T = lie.se3_inverse(made.sequence.pose(29)) @ made.sequence.pose(0)
    window.add_frame(WindowFrame(29, last.target, T, last.affine, motion=last.motion), segment)
    assert window.layout == Layout(5, inertial=True)
    assert window.coupling is not None
    assert len(window.coupling.segments.dt) == 4
    assert window.points is not None
    assert window.linearize(window.points, window.estimate(window.points), None).H.shape == (5 * 17 + 3,) * 2


def test_without_the_imu_the_window_goes_on_as_before():
    window = coupled(2.0)
    window.optimise()
    window.uncouple()
    assert window.layout == Layout(4)
    assert window.metric is None
    assert all(frame.motion is None for frame in window.frames)
    before = torch.stack([frame.T_cam_world for frame in window.frames])
    window.optimise()
    after = torch.stack([frame.T_cam_world for frame in window.frames])
    assert float((after - before).abs().max()) < 5e-3
    window.uncouple()
    assert window.layout == Layout(4)


def test_only_the_oldest_keyframe_leaves_a_coupled_window():
    with pytest.raises(InputError, match="place: expected 0, the oldest keyframe, with an IMU, got 1"):
        coupled().drop_frame(1)


def test_a_segment_without_samples_says_nothing_of_poses():
    window = coupled(2.0)
    assert window.coupling is not None
    assert window.points is not None
    pre = window.coupling.segments
    silent = window.coupling.with_segments(pre._replace(ok=torch.zeros_like(pre.ok)))
    system = linearize_coupling(silent, window.estimate(window.points), window.layout)
    images = slice(0, window.layout.visual)
    assert float(system.H[images].abs().max()) == 0
    assert float(system.H[window.layout.metric].abs().max()) == 0
    assert float(system.H.diagonal().max()) > 0
