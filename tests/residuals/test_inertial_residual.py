"""The inertial residual: its Jacobians against automatic differentiation, its invariances, and its weights."""

import math

import pytest
import torch
from torch import Tensor
from torch.func import jacfwd

from torchvo360 import lie
from torchvo360.residuals.inertial import (
    ImuNoise,
    Preintegrated,
    gravity_basis,
    inertial_residual,
    linearize_inertial,
    turn_gravity,
)

B = 4
NOISE = ImuNoise()


def normal(*shape: int, seed: int, scale: float = 1.0) -> Tensor:
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def poses(seed: int, angle: float | None = None) -> Tensor:
    """Random T_cam_world, turned by any angle or by a given one."""
    w = normal(B, 3, seed=seed)
    if angle is not None:
        w = w * (angle / w.norm(dim=-1, keepdim=True))
    return lie.se3(lie.so3_exp(w), normal(B, 3, seed=seed + 1))


def segments(seed: int = 0, turn: float = 0.4) -> Preintegrated:
    w = normal(B, 3, seed=seed)
    root = normal(B, 9, 9, seed=seed + 5, scale=1e-3)
    J_bias = normal(B, 9, 6, seed=seed + 3, scale=0.3)
    J_bias[:, :3, 3:] = 0  # forces do not turn it
    return Preintegrated(
        dt=torch.linspace(0.05, 1.0, B, dtype=torch.float64),
        dR=lie.so3_exp(turn * w / w.norm(dim=-1, keepdim=True)),
        dv=normal(B, 3, seed=seed + 1),
        dp=normal(B, 3, seed=seed + 2),
        J_bias=J_bias,
        covariance=root @ root.mT + 1e-6 * torch.eye(9, dtype=torch.float64),
        bias_gyro=normal(B, 3, seed=seed + 4, scale=0.01),
        bias_accel=normal(B, 3, seed=seed + 6, scale=0.1),
        ok=torch.ones(B, dtype=torch.bool),
    )


def arguments(case: str) -> tuple:
    """Segments, poses, motions, log-scale, gravity and extrinsics of one hard point."""
    pre, T_i, T_j = segments(), poses(10), poses(12)
    motion_i, motion_j = normal(B, 9, seed=20, scale=0.5), normal(B, 9, seed=21, scale=0.5)
    gravity = torch.tensor([0.3, -9.7, 1.2], dtype=torch.float64)
    log_scale = torch.tensor(0.7, dtype=torch.float64)
    T_cam_imu = lie.se3(lie.so3_exp(normal(3, seed=30)), torch.tensor([0.1, -0.3, 0.2], dtype=torch.float64))
    if case == "nothing moves":
        T_j, motion_j = T_i, motion_i
        pre = pre._replace(dR=torch.eye(3, dtype=torch.float64).expand(B, 3, 3))
        motion_i = motion_j = torch.cat([motion_i[:, :3], pre.bias_gyro, pre.bias_accel], -1)
    elif case == "nearly pi":
        # E is the IMU's turn between the poses but for dR and the bias: make both nothing.
        pre = pre._replace(dR=torch.eye(3, dtype=torch.float64).expand(B, 3, 3), J_bias=pre.J_bias * 0)
        axis = normal(B, 3, seed=33)
        T_j = lie.se3(lie.so3_exp(3.12 * axis / axis.norm(dim=-1, keepdim=True)) @ T_i[:, :3, :3], T_j[:, :3, 3])
    elif case == "gravity on an axis":
        gravity = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
    elif case == "far bias":
        motion_i = motion_i + 1.0
    elif case == "tiny map":
        log_scale = torch.tensor(-6.0, dtype=torch.float64)
    return pre, T_i, T_j, motion_i, motion_j, log_scale, gravity, T_cam_imu


CASES = ("anywhere", "nothing moves", "nearly pi", "gravity on an axis", "far bias", "tiny map")


@pytest.mark.parametrize("case", CASES)
def test_the_jacobians_are_those_of_automatic_differentiation(case):
    pre, T_i, T_j, motion_i, motion_j, log_scale, gravity, T_cam_imu = arguments(case)
    rows = linearize_inertial(pre, T_i, T_j, motion_i, motion_j, log_scale, gravity, T_cam_imu, NOISE)

    def residual(step: Tensor) -> Tensor:
        """Residuals after a step [33] that all segments make alike."""
        by_i, by_j, shared = step.split([15, 15, 3])
        return inertial_residual(
            pre,
            lie.se3_exp(by_i[:6]) @ T_i,
            lie.se3_exp(by_j[:6]) @ T_j,
            motion_i + by_i[6:],
            motion_j + by_j[6:],
            log_scale + shared[0],
            turn_gravity(gravity, shared[1:]),
            T_cam_imu,
        )

    expected = jacfwd(residual)(torch.zeros(33, dtype=torch.float64))
    assert float(expected.abs().max()) > 0.5
    torch.testing.assert_close(torch.cat([rows.by_i, rows.by_j, rows.by_shared], -1), expected, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(rows.residual, residual(torch.zeros(33, dtype=torch.float64)))


def test_a_motion_that_the_imu_measured_leaves_no_residual():
    """The increments are made from two states by Newton's laws; the scale of the map and its axes are any."""
    pre, T_i, T_j, motion_i, motion_j, log_scale, gravity, T_cam_imu = arguments("anywhere")
    motion_j = torch.cat([motion_j[:, :3], motion_i[:, 3:]], -1)
    pre = pre._replace(bias_gyro=motion_i[:, 3:6], bias_accel=motion_i[:, 6:])
    T_world_imu = []
    for T in (T_i, T_j):
        T_world_cam = lie.se3_inverse(T)
        T_world_cam[:, :3, 3] *= log_scale.exp()
        T_world_imu.append(T_world_cam @ T_cam_imu)
    R_imu_world, dt = T_world_imu[0][:, :3, :3].mT, pre.dt[:, None]
    gained = motion_j[:, :3] - motion_i[:, :3] - gravity * dt
    gone = T_world_imu[1][:, :3, 3] - T_world_imu[0][:, :3, 3] - motion_i[:, :3] * dt - gravity * dt**2 / 2
    pre = pre._replace(
        dR=R_imu_world @ T_world_imu[1][:, :3, :3],
        dv=(R_imu_world @ gained[..., None])[..., 0],
        dp=(R_imu_world @ gone[..., None])[..., 0],
    )
    residual = inertial_residual(pre, T_i, T_j, motion_i, motion_j, log_scale, gravity, T_cam_imu)
    torch.testing.assert_close(residual, torch.zeros(B, 15, dtype=torch.float64), rtol=0, atol=1e-12)


def test_turning_and_moving_the_world_changes_nothing():
    pre, T_i, T_j, motion_i, motion_j, log_scale, gravity, T_cam_imu = arguments("anywhere")
    turn = lie.se3_exp(normal(6, seed=40))
    R = turn[:3, :3]
    before = inertial_residual(pre, T_i, T_j, motion_i, motion_j, log_scale, gravity, T_cam_imu)
    moved = [T @ lie.se3_inverse(turn) for T in (T_i, T_j)]
    turned = [torch.cat([m[:, :3] @ R.mT, m[:, 3:]], -1) for m in (motion_i, motion_j)]
    after = inertial_residual(pre, *moved, *turned, log_scale, R @ gravity, T_cam_imu)
    torch.testing.assert_close(after, before, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (9.81, 0.0, 0.0), (0.1, -9.8, 0.2), (5.66, 5.66, 5.66)])
def test_gravity_turns_and_keeps_its_length(gravity):
    g = torch.tensor(gravity, dtype=torch.float64)
    basis = gravity_basis(g)
    torch.testing.assert_close(basis.mT @ basis, torch.eye(2, dtype=torch.float64) * (g @ g))
    torch.testing.assert_close(g @ basis, torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-12)
    step = torch.tensor([0.3, -0.4], dtype=torch.float64)
    turned = turn_gravity(g, step)
    torch.testing.assert_close(turned.norm(), g.norm())
    assert math.degrees(math.acos(float(turned @ g / (g @ g)))) == pytest.approx(math.degrees(0.5))
    torch.testing.assert_close(
        jacfwd(lambda s: turn_gravity(g, s))(torch.zeros(2, dtype=torch.float64)), basis, rtol=1e-12, atol=1e-12
    )


def test_the_information_is_the_inverse_covariance_and_the_walk():
    case = arguments("anywhere")
    information = linearize_inertial(*case, NOISE).information
    pre = case[0]
    torch.testing.assert_close(information[:, :9, :9], torch.linalg.inv(pre.covariance), rtol=1e-7, atol=1e-3)
    torch.testing.assert_close(1 / information[:, 9, 9], NOISE.gyro_walk**2 * pre.dt)
    torch.testing.assert_close(1 / information[:, 14, 14], NOISE.accel_walk**2 * pre.dt)
    assert float(information[:, :9, 9:].abs().max()) == 0


def test_an_unmeasured_segment_weighs_nothing_but_for_the_walk_of_its_biases():
    pre, *rest = arguments("anywhere")
    ok = torch.tensor([True, False, True, True])
    spoiled = pre._replace(
        ok=ok, covariance=torch.where(ok[:, None, None], pre.covariance, torch.zeros_like(pre.covariance))
    )
    whole, part = linearize_inertial(pre, *rest, NOISE), linearize_inertial(spoiled, *rest, NOISE)
    assert float(part.information[1, :9].abs().max()) == 0
    torch.testing.assert_close(part.information[1, 9:, 9:], whole.information[1, 9:, 9:])
    assert torch.equal(part.information[ok], whole.information[ok])
    for value in part:
        assert bool(value.isfinite().all())


def test_a_segment_gives_the_same_rows_alone_and_among_others():
    pre, T_i, T_j, motion_i, motion_j, *shared = arguments("anywhere")
    together = linearize_inertial(pre, T_i, T_j, motion_i, motion_j, *shared, NOISE)
    alone = linearize_inertial(pre.take(slice(2, 3)), T_i[2:3], T_j[2:3], motion_i[2:3], motion_j[2:3], *shared, NOISE)
    for name, whole, one in zip(together._fields, together, alone, strict=True):
        torch.testing.assert_close(one[0], whole[2], rtol=1e-9, atol=1e-9, msg=name)
