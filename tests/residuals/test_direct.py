"""The tangent-form rows equal the derivative of a textbook warp, hard points included.

The oracle is written apart: points are moved by a matrix exponential, projected by the formulas of mathematics.md,
section 2, and looked up by a bilinear interpolation of its own; `jacfwd` differentiates all of it.
"""

import math
from typing import NamedTuple

import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.func import jacfwd

from torchvo360 import lie
from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.residuals.direct import (
    Reference,
    Samples,
    by_rho,
    look_up,
    look_up_usable,
    look_up_value,
    make_target,
    system_rows,
    weight_slope_rows,
)
from torchvo360.residuals.weights import depth_variance_weight

SPHERE = Equirectangular(64, 32)
PLANE = Pinhole(48, 36, 40.0, 42.0, 23.1, 17.4)
CAMERAS = pytest.mark.parametrize("camera", [SPHERE, PLANE], ids=["sphere", "pinhole"])
CHANNELS = pytest.mark.parametrize("channels", [1, 3])
MOTIONS = pytest.mark.parametrize(
    "xi",
    [
        (0.0,) * 6,
        (0.05, -0.03, 0.04, 0.02, -0.03, 0.01),
        (0.0, 0.0, 0.0, 0.01, 0.02, -0.03),
        (0.1, 0.2, -0.3, 0.0, 0.0, 0.0),
    ],
    ids=["identity", "motion", "rotation", "translation"],
)


class Problem(NamedTuple):
    reference: Reference
    image: Float[Tensor, "C H W"]
    T_tgt_ref: Float[Tensor, "4 4"]
    affine: Float[Tensor, "2"]


def hat(xi: Float[Tensor, "6"]) -> Float[Tensor, "4 4"]:
    o = torch.zeros_like(xi[0])
    vx, vy, vz, x, y, z = xi.unbind()
    return torch.stack([o, -z, y, vx, z, o, -x, vy, -y, x, o, vz, o, o, o, o]).view(4, 4)


def textbook_pixel(camera: Camera, p: Float[Tensor, "3"]) -> Float[Tensor, "2"]:
    x, y, z = p.unbind()
    fx, fy, cx, cy = camera.intrinsics
    if isinstance(camera, Pinhole):
        return torch.stack([fx * x / z + cx, fy * y / z + cy])
    return torch.stack([fx * torch.atan2(x, z) + cx, -fy * torch.atan2(y, torch.hypot(x, z)) + cy])


def textbook_value(camera: Camera, image: Float[Tensor, "C H W"], uv: Float[Tensor, "2"]) -> Float[Tensor, "C"]:
    """Bilinear interpolation; neighbours across the seam and the poles are found on the sphere."""
    height, width = image.shape[-2:]
    corner = (uv.detach() - 0.5).floor()
    across, down = (uv - 0.5 - corner).unbind()
    value = torch.zeros_like(image[:, 0, 0])
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        column, row = (corner + torch.tensor([j, i])).long().unbind()
        if camera.wraps:
            over = (row < 0) | (row >= height)
            row = torch.where(row < 0, -1 - row, torch.where(row >= height, 2 * height - 1 - row, row))
            column = (column + torch.where(over, width // 2, 0)) % width
        weight = (across if j else 1 - across) * (down if i else 1 - down)
        value = value + weight * image[:, row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return value


def textbook_residual(
    camera: Camera, problem: Problem, n: int, xi: Tensor, ab: Tensor, d_rho: Tensor
) -> Float[Tensor, "C"]:
    """r of one point for a step (xi, ab) and a change of its inverse range."""
    reference, image, T_tgt_ref, affine = problem
    T = torch.linalg.matrix_exp(hat(xi)) @ T_tgt_ref
    Y = T[:3, :3] @ reference.ray[0, :, n] + (reference.rho[0, n] + d_rho) * T[:3, 3]
    a, b = affine + ab
    return textbook_value(camera, image, textbook_pixel(camera, Y)) - (a.exp() * reference.value[0, :, n] + b)


def hard_rays(camera: Camera) -> Float[Tensor, "N 3"]:
    """Rays all over the image, and on a sphere beside the seam and both poles."""
    generator = torch.Generator().manual_seed(11)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    uv = size * (0.15 + 0.7 * torch.rand(40, 2, generator=generator, dtype=torch.float64))
    if camera.wraps:
        # The fractions keep these points off the edges of the interpolant's cells, at the identity too.
        beside = [(0.1, 9.3), (0.4, 20.2), (63.7, 9.3), (63.9, 25.8), (31.9, 16.1)]
        poles = [(5.2, 0.7), (40.3, 0.8), (12.7, 1.3), (20.1, 31.2), (60.4, 31.3), (33.8, 30.6)]
        uv = torch.cat([uv, torch.tensor(beside + poles, dtype=torch.float64)])
    return camera.ray(uv)


def problem_of(camera: Camera, channels: int, xi: tuple[float, ...], *, variance: bool = False) -> Problem:
    generator = torch.Generator().manual_seed(2)
    rays = hard_rays(camera)
    N = len(rays)
    rho = torch.rand(1, N, generator=generator, dtype=torch.float64)
    rho[:, ::4] = 0.0
    reference = Reference(
        rays.T[None],
        rho,
        torch.rand(1, channels, N, generator=generator, dtype=torch.float64),
        torch.ones(1, N, dtype=torch.float64),
        0.01 * torch.rand(1, N, generator=generator, dtype=torch.float64) if variance else None,
    )
    image = torch.rand(channels, camera.height, camera.width, generator=generator, dtype=torch.float64)
    T = torch.linalg.matrix_exp(hat(torch.tensor(xi, dtype=torch.float64)))
    return Problem(reference, image, T, torch.tensor([0.2, -0.05], dtype=torch.float64))


def samples_of(camera: Camera, problem: Problem) -> Samples:
    target = make_target(problem.image[None], camera)
    return look_up(problem.reference, target, problem.T_tgt_ref[None], problem.affine[None])


def regular_points(camera: Camera, samples: Samples) -> Bool[Tensor, "N"]:
    """Points in view and farther from a pole than the first row's centre, where the covector's bound does not act."""
    if not camera.wraps:
        return samples.weight[0, 0] > 0
    return torch.hypot(samples.ray[0], samples.ray[2])[0, 0] > math.sin(0.5 * math.pi / camera.height)


@CAMERAS
@CHANNELS
@MOTIONS
def test_the_rows_are_the_derivative_of_the_textbook_residual(camera, channels, xi):
    problem = problem_of(camera, channels, xi)
    samples = samples_of(camera, problem)
    one = torch.ones_like(samples.residual)
    rows = system_rows(samples, one).view(9, channels, -1)
    zero6, zero2, zero = (torch.zeros(size, dtype=torch.float64) for size in (6, 2, ()))
    regular = regular_points(camera, samples)
    assert regular.sum() >= (48 if camera.wraps else 30)
    for n in range(rows.shape[-1]):
        if camera.wraps or regular[n]:
            r = textbook_residual(camera, problem, n, zero6, zero2, zero)
            torch.testing.assert_close(rows[8, :, n], r, atol=1e-11, rtol=0)
        if not regular[n]:
            continue
        J_r_xi, J_r_ab = jacfwd(lambda x, y, n=n: textbook_residual(camera, problem, n, x, y, zero), (0, 1))(
            zero6, zero2
        )
        scale = J_r_xi.abs().max().clamp_min(1.0)
        torch.testing.assert_close(rows[:6, :, n].T / scale, J_r_xi / scale, atol=1e-10, rtol=0)
        torch.testing.assert_close(rows[6:8, :, n].T, J_r_ab, atol=1e-12, rtol=0)


@CAMERAS
@CHANNELS
@MOTIONS
def test_by_rho_is_the_derivative_by_the_inverse_range(camera, channels, xi):
    problem = problem_of(camera, channels, xi)
    samples = samples_of(camera, problem)
    actual = by_rho(samples, problem.T_tgt_ref[None, :3, 3])[0]
    zero6, zero2, zero = (torch.zeros(size, dtype=torch.float64) for size in (6, 2, ()))
    for n in regular_points(camera, samples).nonzero()[:, 0].tolist():
        J_r_rho = jacfwd(lambda d, n=n: textbook_residual(camera, problem, n, zero6, zero2, d))(zero)
        torch.testing.assert_close(actual[:, n], J_r_rho, atol=1e-10, rtol=1e-10)


@CAMERAS
@CHANNELS
def test_slope_rows_complete_the_derivative_of_the_normalised_residual(camera, channels):
    # Oracle: r sqrt(W(G . t / s)) with G and s held at their values, t moved by the step.
    problem = problem_of(camera, channels, (0.05, -0.03, 0.04, 0.02, -0.03, 0.01), variance=True)
    samples, noise = samples_of(camera, problem), 4 / 255
    t = problem.T_tgt_ref[:3, 3]
    assert problem.reference.variance is not None
    variance = problem.reference.variance[0]
    W, slope = depth_variance_weight(by_rho(samples, t[None]), variance[None, None], noise)
    root = W.sqrt()
    rows = system_rows(samples, root)[:, :6] + weight_slope_rows(samples, slope * samples.residual * root, t[None])
    rows = rows.view(6, channels, -1)
    G = torch.stack([g[0] for g in samples.G], -1)
    zero2, zero = torch.zeros(2, dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    for n in regular_points(camera, samples).nonzero()[:, 0].tolist():

        def normalised(xi, n=n):
            moved = (torch.linalg.matrix_exp(hat(xi)) @ problem.T_tgt_ref)[:3, 3]
            dI_drho = (G[:, n] @ moved) * samples.inv_scale[0, 0, n]
            weight = 2 * noise**2 / (2 * noise**2 + dI_drho**2 * variance[n])
            return textbook_residual(camera, problem, n, xi, zero2, zero) * weight.sqrt()

        J = jacfwd(normalised)(torch.zeros(6, dtype=torch.float64))
        scale = J.abs().max().clamp_min(1.0)
        torch.testing.assert_close(rows[:, :, n].T / scale, J / scale, atol=1e-10, rtol=0)


@CAMERAS
def test_autograd_through_the_samples_gives_the_rows(camera):
    problem = problem_of(camera, 1, (0.05, -0.03, 0.04, 0.02, -0.03, 0.01))
    target = make_target(problem.image[None], camera)

    def residual(xi):
        T = lie.se3_exp(xi)[None] @ problem.T_tgt_ref
        return look_up(problem.reference, target, T, problem.affine[None]).residual[0, 0]

    samples = samples_of(camera, problem)
    regular = regular_points(camera, samples)
    J = torch.autograd.functional.jacobian(residual, torch.zeros(6, dtype=torch.float64))
    rows = system_rows(samples, torch.ones_like(samples.residual))[0, :6].T
    torch.testing.assert_close(rows[regular], J[regular], atol=1e-8, rtol=1e-8)


def test_at_the_poles_rows_are_finite_and_bounded():
    towards = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1e-9, 1.0, 0.0], [0.0, -1.0, 1e-30]])
    for dtype in (torch.float32, torch.float64):
        image = torch.rand(1, 1, 32, 64, generator=torch.Generator().manual_seed(0)).to(dtype)
        reference = Reference(
            towards.T[None].to(dtype),
            torch.zeros(1, 4, dtype=dtype),
            torch.zeros(1, 1, 4, dtype=dtype),
            torch.ones(1, 4),
        )
        T, ab = torch.eye(4, dtype=dtype)[None], torch.zeros(1, 2, dtype=dtype)
        samples = look_up(reference, make_target(image, SPHERE), T, ab)
        rows = system_rows(samples, torch.ones_like(samples.residual))
        assert torch.isfinite(rows).all()
        # |G| is at most the steepest gradient of the image over the angle of half a row: sin(0.5 / fy).
        assert rows[:, 3:6].abs().max() < 2 * abs(SPHERE.intrinsics[0]) / math.sin(0.5 * math.pi / 32)


@CAMERAS
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_points_out_of_view_weigh_nothing_and_stay_finite(camera, dtype):
    rays = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.3, 0.1, -1e-14], [0.0, 0.0, 0.0], [5.0, 0.0, 1.0]])
    reference = Reference(
        rays.T[None].to(dtype),
        torch.full((1, 5), 2.0, dtype=dtype),
        torch.zeros(1, 1, 5, dtype=dtype),
        torch.ones(1, 5),
    )
    image = torch.rand(1, 1, camera.height, camera.width, generator=torch.Generator().manual_seed(0)).to(dtype)
    T, ab = torch.eye(4, dtype=dtype)[None], torch.zeros(1, 2, dtype=dtype)
    samples = look_up(reference, make_target(image, camera), T, ab)
    if not camera.wraps:
        assert samples.weight[0, 0].tolist() == [1, 0, 0, 0, 0]
    rows = system_rows(samples, samples.weight.sqrt().to(dtype))
    assert torch.isfinite(rows).all()
    assert torch.isfinite(by_rho(samples, T[:, :3, 3])).all()


@pytest.mark.parametrize("batch", [1, 3])
def test_confidence_and_saturation_take_weight_away(batch):
    image = torch.rand(batch, 2, 32, 64, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    confidence = torch.rand(batch, 32, 64, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    N = 32 * 64
    reference = Reference(
        SPHERE.ray_grid(dtype=torch.float64).permute(2, 0, 1).reshape(1, 3, N),
        torch.zeros(batch, N, dtype=torch.float64),
        torch.zeros(batch, 2, N, dtype=torch.float64),
        torch.full((batch, N), 3.0, dtype=torch.float64),
    )
    T, ab = torch.eye(4, dtype=torch.float64).expand(batch, 4, 4), torch.zeros(batch, 2, dtype=torch.float64)
    # At the identity every look-up meets a pixel's centre.
    plain = look_up(reference, make_target(image, SPHERE, confidence), T, ab)
    torch.testing.assert_close(plain.weight[:, 0], 3 * confidence.flatten(1), atol=1e-9, rtol=0)
    clipped = look_up(reference, make_target(image, SPHERE, confidence, 0.7), T, ab)
    expected = 3 * confidence.flatten(1)[:, None] * (image.flatten(2) < 0.7)
    assert ((clipped.weight - expected).abs() > 1e-9).double().mean() < 1e-3


@CAMERAS
def test_values_are_looked_up_everywhere_and_usable_ones_where_they_are_seen_unmasked_and_unclipped(camera):
    image = torch.rand(
        1, 1, camera.height, camera.width, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    rays = camera.ray_grid(dtype=torch.float64).permute(2, 0, 1)
    target = make_target(image, camera)
    for look in (look_up_value, look_up_usable):
        torch.testing.assert_close(look(target, rays), image[0, 0], atol=1e-9, rtol=0)
    assert torch.isfinite(look_up_value(target, -rays)).all()
    behind = look_up_usable(target, -rays)
    assert behind.isnan().all() if not camera.wraps else torch.isfinite(behind).all()
    confidence = torch.ones_like(image[:, 0])
    confidence[:, : camera.height // 2] = 0
    usable = look_up_usable(make_target(image, camera, confidence, 0.7), rays)
    assert usable[: camera.height // 2].isnan().all()
    below = image[0, 0, camera.height // 2 :]
    assert torch.equal(usable[camera.height // 2 :].isnan(), below >= 0.7)


def test_parts_of_a_reference_and_a_target_are_its_parts():
    problem = problem_of(SPHERE, 3, (0.0,) * 6, variance=True)
    reference = problem.reference
    doubled = Reference(
        reference.ray, *(torch.cat([v, 2 * v]) for v in (reference.rho, reference.value, reference.weight))
    )
    index = torch.tensor([1])
    assert torch.equal(doubled.take(index).rho, 2 * reference.rho)
    assert doubled.take(index).ray is reference.ray
    part = reference.chunk(3, 9)
    assert part.variance is not None
    assert reference.variance is not None
    assert torch.equal(part.variance, reference.variance[:, 3:9])
    assert torch.equal(part.ray, reference.ray[..., 3:9])
    assert torch.equal(part.value, reference.value[..., 3:9])
    image = torch.stack([problem.image, 2 * problem.image])
    target = make_target(image, SPHERE, torch.rand(2, 32, 64, dtype=torch.float64), 0.9).take(index)
    torch.testing.assert_close(target.padded[..., 1:-1, 1:-1], 2 * problem.image[None])
    assert target.confidence is not None
    assert target.confidence.shape == (1, 1, 34, 66)
    assert target.saturation == 0.9
