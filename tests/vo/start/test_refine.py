"""The joint refinement of a start: it comes back from a perturbed one, holds its unit, and its gradient is right."""

import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Equirectangular
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.residuals.direct import Target
from torchvo360.residuals.weights import LossConfig
from torchvo360.vo import OdometryConfig
from torchvo360.vo.frame import FrameBuilder
from torchvo360.vo.keyframes.keyframe import make_keyframe
from torchvo360.vo.start.refine import JointState, _linearize, refine_jointly
from torchvo360.window import PATTERN, pattern_rays

CAMERA = Equirectangular(256, 128)
LOSS = LossConfig(scale=7.4 / 255, cutoff=34 / 255)


class Problem(NamedTuple):
    ray: Tensor
    rho: Tensor
    value: Tensor
    targets: Target
    T_tgt_ref: Tensor


def problem(seed: int, *, gain: float = 1.0) -> Problem:
    """A host frame with true inverse ranges, and three targets with true poses."""
    sequence = SyntheticSequence(SyntheticConfig(width=256, height=128, frames=9, seed=seed))
    builder = FrameBuilder(CAMERA, 1, 0.7, None, 252 / 255)
    frames = []
    for index in (0, 2, 5, 8):
        image = sequence.frame(index).image
        assert image is not None
        image = image if index == 0 else (image * gain).astype("uint8")
        frames.append(builder.build(image, index, index))
    key = make_keyframe(frames[0], torch.eye(4, dtype=torch.float64), builder, OdometryConfig().map)
    rays = pattern_rays(key.ray, CAMERA.pixel_angle)
    poses = torch.stack([lie.se3_inverse(sequence.pose(index)) @ sequence.pose(0) for index in (2, 5, 8)])
    first = frames[1].targets[0]
    targets = Target(CAMERA, torch.cat([frame.targets[0].padded for frame in frames[1:]]), None, first.saturation)
    return Problem(rays, 1 / sequence.range(0).flatten()[key.pixel], frames[0].value(rays), targets, poses)


@pytest.fixture(scope="module")
def exact() -> Problem:
    return problem(1)


def direction_deg(t: Tensor, true: Tensor) -> float:
    return math.degrees(math.acos(float((t @ true / t.norm() / true.norm()).clamp(-1, 1))))


def perturbed(p: Problem, seed: int) -> tuple[Tensor, Tensor]:
    """Turn the directions of motion by 3 deg, the cameras by 0.3 deg, and spoil the inverse ranges by 20 %."""
    g = torch.Generator().manual_seed(seed)
    last = p.T_tgt_ref[-1, :3, 3]
    side = torch.linalg.cross(last, torch.randn(3, generator=g, dtype=torch.float64))
    turn = lie.so3_exp(side / side.norm() * math.radians(3.0))
    axis = torch.randn(3, 3, generator=g, dtype=torch.float64)
    error = lie.so3_exp(axis / axis.norm(dim=-1, keepdim=True) * math.radians(0.3))
    T = lie.se3(error @ p.T_tgt_ref[:, :3, :3], p.T_tgt_ref[:, :3, 3] @ turn.mT)
    noise = torch.randn(p.rho.shape, generator=g)
    return T, (p.rho * (1 + 0.2 * noise)).clamp_min(0.05)


def solve(p: Problem, T: Tensor, rho: Tensor) -> JointState:
    return refine_jointly(p.ray, rho, p.value, p.targets, T, torch.zeros(3, 2, dtype=torch.float64), LOSS)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_perturbed_start_comes_back(seed):
    p = problem(seed)
    T, rho = perturbed(p, seed)
    assert direction_deg(T[-1, :3, 3], p.T_tgt_ref[-1, :3, 3]) == pytest.approx(3.0, abs=0.01)
    out = solve(p, T, rho)
    assert direction_deg(out.T_tgt_ref[-1, :3, 3], p.T_tgt_ref[-1, :3, 3]) < 0.5
    rotation = lie.so3_angle(out.T_tgt_ref[:, :3, :3] @ p.T_tgt_ref[:, :3, :3].mT).rad2deg()
    assert float(rotation.max()) < 0.1
    error, before = (((r - p.rho) / p.rho).abs().median() for r in (out.rho, rho))
    assert float(error) < 0.5 * float(before)
    # the lengths of the others, in units of the last, come back as well
    length = out.T_tgt_ref[:, :3, 3].norm(dim=-1)
    torch.testing.assert_close(length, p.T_tgt_ref[:, :3, 3].norm(dim=-1), rtol=0.03, atol=0)


def test_the_unit_is_held_exactly(exact):
    T, rho = perturbed(exact, 3)
    out = solve(exact, T, rho)
    torch.testing.assert_close(out.T_tgt_ref[-1, :3, 3].norm(), T[-1, :3, 3].norm(), rtol=1e-12, atol=0)
    doubled = solve(exact, lie.se3(T[:, :3, :3], 2 * T[:, :3, 3]), rho / 2)
    torch.testing.assert_close(doubled.T_tgt_ref[:, :3, 3] / 2, out.T_tgt_ref[:, :3, 3], rtol=0, atol=2e-3)


def test_the_cost_falls_and_the_truth_is_hardly_left(exact):
    T, rho = perturbed(exact, 4)
    zero = torch.zeros(3, 2, dtype=torch.float64)
    start = _linearize(exact.ray, rho, exact.value, exact.targets, T, zero, LOSS).cost
    truth = _linearize(exact.ray, exact.rho, exact.value, exact.targets, exact.T_tgt_ref, zero, LOSS).cost
    assert solve(exact, T, rho).cost < 0.6 * start
    stay = solve(exact, exact.T_tgt_ref, exact.rho)
    assert stay.cost <= truth
    assert direction_deg(stay.T_tgt_ref[-1, :3, 3], exact.T_tgt_ref[-1, :3, 3]) < 0.3


def test_a_change_of_brightness_is_estimated_along(exact):
    p = problem(1, gain=0.7)
    T, rho = perturbed(p, 5)
    out = solve(p, T, rho)
    assert direction_deg(out.T_tgt_ref[-1, :3, 3], p.T_tgt_ref[-1, :3, 3]) < 0.5
    assert float((out.affine[:, 0] - math.log(0.7)).abs().max()) < 0.03


def test_the_gradient_is_that_of_the_cost():
    """Finite differences in float64, with a smooth loss, away from the poles' first rows, where G is bounded."""
    p = problem(1)
    loss = LossConfig(name="student_t", scale=7.4 / 255)
    chosen = (p.ray[1].abs().amax(-1) < 0.97).nonzero()[::40, 0]
    ray, value = p.ray[:, chosen].double(), p.value[chosen].double()
    rho = p.rho[chosen].double() * 1.02
    targets = Target(CAMERA, p.targets.padded.double(), None, None)
    T, affine = perturbed(p, 6)[0], torch.full((3, 2), 0.01, dtype=torch.float64)

    def cost(T: Tensor, affine: Tensor, rho: Tensor) -> float:
        return _linearize(ray, rho, value, targets, T, affine, loss).cost

    system = _linearize(ray, rho, value, targets, T, affine, loss)
    eps = 1e-7
    for k in range(3):
        for i in range(8):
            each = torch.zeros(3, 8, dtype=torch.float64)
            each[k, i] = eps
            up, down = (cost(lie.se3_exp(s * each[:, :6]) @ T, affine + s * each[:, 6:], rho) for s in (1, -1))
            assert (up - down) / (2 * eps) == pytest.approx(float(system.g[k, i]), rel=1e-3, abs=1e-5)
    for n in range(0, len(chosen), 7):
        nudge = torch.zeros_like(rho)
        nudge[n] = eps
        slope = (cost(T, affine, rho + nudge) - cost(T, affine, rho - nudge)) / (2 * eps)
        assert slope == pytest.approx(float(system.g_rho[n]), rel=1e-3, abs=1e-6)


def test_the_pattern_lies_in_the_tangent_plane_in_pixels_of_one_size_everywhere():
    lat = torch.tensor([0.0, 0.7, -1.3, math.pi / 2, -math.pi / 2, math.pi / 2 - 1e-4], dtype=torch.float64)
    lon = torch.tensor([0.0, 3.1, -2.0, 0.4, 1.0, -3.0], dtype=torch.float64)
    ray = torch.stack([lat.cos() * lon.sin(), -lat.sin(), lat.cos() * lon.cos()])
    step = 0.01
    rays = pattern_rays(ray, step)
    assert rays.shape == (3, 6, len(PATTERN))
    torch.testing.assert_close(rays.norm(dim=0), torch.ones(6, len(PATTERN), dtype=torch.float64))
    along = (rays * ray[..., None]).sum(0)
    size = torch.tensor(PATTERN, dtype=torch.float64).norm(dim=-1) * step
    torch.testing.assert_close(torch.acos(along.clamp(-1, 1)), size.atan().expand(6, -1), rtol=0, atol=1e-7)
    torch.testing.assert_close(rays[..., PATTERN.index((0, 0))], ray)


def test_the_pattern_points_right_and_down_in_the_image():
    uv = torch.tensor([[40.0, 64.0], [128.0, 30.0], [250.0, 100.0]], dtype=torch.float64)
    rays = pattern_rays(CAMERA.ray(uv).T, CAMERA.pixel_angle)
    seen = CAMERA.pixel(rays.permute(1, 2, 0)) - uv[:, None]
    lat = (64 - uv[:, 1]) / 128 * math.pi
    offset = torch.tensor(PATTERN, dtype=torch.float64).expand(3, -1, -1).clone()
    offset[..., 0] /= lat.cos()[:, None]
    torch.testing.assert_close(seen, offset, rtol=0, atol=0.15)
