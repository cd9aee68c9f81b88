"""`linearize` equals float64 sums of textbook rows, for every pair alone, whatever the batch, the chunks and the input.

The oracle forms each pixel's Jacobian by the chain rule through pixels (mathematics.md, section 4 for the sphere), not
by the covector, and sums in float64 at the pixels that the float32 kernel looked up.
"""

import math
from dataclasses import replace

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360 import lie
from torchvo360.backends import compiled, eager, numba
from torchvo360.backends.eager import linearize
from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.image import pad_image
from torchvo360.residuals.direct import Reference, Target, by_rho, look_up, make_target
from torchvo360.residuals.weights import LossConfig, depth_variance_weight, robust

SPHERE = Equirectangular(128, 64)
PLANE = Pinhole(96, 72, 80.0, 84.0, 47.1, 36.4)
CAMERAS = pytest.mark.parametrize("camera", [SPHERE, PLANE], ids=["sphere", "pinhole"])
CHANNELS = pytest.mark.parametrize("channels", [1, 3])
HUBER = LossConfig(scale=0.05)
BACKENDS = pytest.mark.parametrize("backend", [eager, numba, compiled], ids=["eager", "numba", "compiled"])

COMPILED = {(True, 1, False), (False, 3, True)}
"""Panorama or not, channels and variance of what is compiled to be compared."""


def texture(camera: Camera, *batch: int, seed: int = 0) -> Float[Tensor, "*batch H W"]:
    """Smooth functions on the sphere, float64, about 0.15 around 0.5."""
    generator = torch.Generator().manual_seed(seed)
    ray = torch.nn.functional.normalize(camera.ray_grid(dtype=torch.float64), dim=-1)
    count = math.prod(batch)
    frequency = torch.logspace(0, 0.9, 16, dtype=torch.float64)
    waves = torch.randn(count, 16, 3, generator=generator, dtype=torch.float64) * frequency[:, None]
    phase = math.tau * torch.rand(count, 16, 1, 1, generator=generator, dtype=torch.float64)
    value = (torch.einsum("bkc,hwc->bkhw", waves, ray) + phase).sin() / frequency[:, None, None]
    return (0.5 + 0.06 * value.sum(1)).view(*batch, camera.height, camera.width)


def problem(
    camera: Camera, B: int = 1, C: int = 1, *, variance: bool = False, dtype: torch.dtype = torch.float32
) -> tuple[Reference, Target, Tensor, Tensor]:
    """Random pairs: points, targets, poses and brightness, in float32 numbers whatever the dtype."""
    generator = torch.Generator().manual_seed(4)
    area = camera.solid_angle(camera.pixel_grid(dtype=torch.float64))
    rho = (0.6 + 2 * (texture(camera, B, seed=1) - 0.5)).clamp_min(0.05).flatten(1)
    rho[:, ::7] = 0.0
    reference = Reference(
        camera.ray_grid(dtype=torch.float64).permute(2, 0, 1).flatten(1)[None],
        rho,
        texture(camera, B, C, seed=2).flatten(2),
        (area / area.mean()).flatten().expand(B, -1).contiguous(),
        0.02 * texture(camera, B, seed=3).flatten(1) if variance else None,
    )
    image = texture(camera, B, C, seed=2) + 0.3 * (texture(camera, B, C, seed=5) - 0.5)
    xi = torch.randn(B, 6, generator=generator, dtype=torch.float64) * torch.tensor([0.1] * 3 + [0.05] * 3)
    affine = 0.05 * torch.randn(B, 2, generator=generator, dtype=torch.float64)
    target = make_target(image.float().to(dtype), camera)
    return converted(reference, torch.float32, dtype), target, lie.se3_exp(xi), affine


def converted(reference: Reference, *dtypes: torch.dtype) -> Reference:
    def convert(value: Tensor) -> Tensor:
        for dtype in dtypes:
            value = value.to(dtype)
        return value

    variance = None if reference.variance is None else convert(reference.variance)
    ray, rho, value, weight = (convert(v) for v in (reference.ray, reference.rho, reference.value, reference.weight))
    return Reference(ray, rho, value, weight, variance)


def in_float64(reference: Reference, target: Target) -> tuple[Reference, Target]:
    confidence = None if target.confidence is None else target.confidence.double()
    return converted(reference, torch.float64), replace(target, padded=target.padded.double(), confidence=confidence)


def pixel_slopes(camera: Camera, Y: Float[Tensor, "N 3"], rho: Float[Tensor, "N"]) -> Float[Tensor, "N 2 6"]:
    """d(u, v) / d(v, w) as written out in mathematics.md, section 4, and S2's pinhole counterpart."""
    fx, fy, _, _ = camera.intrinsics
    o = torch.zeros_like(rho)
    if isinstance(camera, Pinhole):
        x, y = (Y[:, :2] / Y[:, 2:]).unbind(-1)
        s = rho / Y[:, 2]
        du = torch.stack([s, o, -s * x, -x * y, 1 + x * x, -y], -1) * fx
        dv = torch.stack([o, s, -s * y, -1 - y * y, x * y, x], -1) * fy
        return torch.stack([du, dv], -2)
    length = Y.norm(dim=-1)
    x, y, z = (Y / length[:, None]).unbind(-1)
    s, q = rho / length, x * x + z * z
    c = q.sqrt()
    du = torch.stack([s * z / q, o, -s * x / q, -x * y / q, torch.ones_like(x), -y * z / q], -1) * fx
    dv = torch.stack([s * x * y / c, -s * c, s * y * z / c, z / c, o, -x / c], -1) * fy
    return torch.stack([du, dv], -2)


def textbook(
    camera: Camera, reference: Reference, target: Target, T: Tensor, affine: Tensor, loss: LossConfig
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """H, g, cost and weight of the first pair in float64, by the chain rule through pixels."""
    T, (a, b) = T[0], affine[0]
    rho, weight = reference.rho[0], reference.weight[0]
    Y = reference.ray[0].T @ T[:3, :3].T + rho[:, None] * T[:3, 3]
    fx, fy, cx, cy = camera.intrinsics
    x, y, z = Y.unbind(-1)
    if isinstance(camera, Pinhole):
        u, v = fx * x / z + cx, fy * y / z + cy
        inside = (u >= 0.5) & (u <= camera.width - 0.5) & (v >= 0.5) & (v <= camera.height - 0.5) & (z > 0)
        weight = weight * inside
        u, v = u.clamp(0.5, camera.width - 0.5), v.clamp(0.5, camera.height - 0.5)
    else:
        u, v = fx * torch.atan2(x, z) + cx, -fy * torch.atan2(y, torch.hypot(x, z)) + cy
    left, top = (u + 0.5).floor(), (v + 0.5).floor()
    across, down = u + 0.5 - left, v + 0.5 - top
    at = target.padded[0][:, top.long()[None], left.long()[None]][:, 0]
    right = target.padded[0][:, top.long(), left.long() + 1]
    under = target.padded[0][:, top.long() + 1, left.long()]
    last = target.padded[0][:, top.long() + 1, left.long() + 1]
    value = (at * (1 - across) + right * across) * (1 - down) + (under * (1 - across) + last * across) * down
    g_u = (right - at) * (1 - down) + (last - under) * down
    g_v = (under - at) * (1 - across) + (last - right) * across
    if camera.wraps:
        # The kernel's bound at the poles: longitude's slope is held from half a row on.
        near = (torch.hypot(x, z) / Y.norm(dim=-1)).square() / math.sin(0.5 / fy) ** 2
        g_u = g_u * near.clamp(max=1)
        g_v_scale = near.clamp(max=1).sqrt()
        g_v = g_v * g_v_scale
    slopes = pixel_slopes(camera, Y, rho)
    J_xi = g_u[..., None] * slopes[:, 0] + g_v[..., None] * slopes[:, 1]
    gained = a.exp() * reference.value[0]
    J = torch.cat([J_xi, -gained[..., None], -torch.ones_like(gained)[..., None]], -1)
    r = value - gained - b
    robust_weight, cost = robust(r, loss)
    W = robust_weight * weight
    H = torch.einsum("cn,cni,cnj->ij", W, J, J)
    return H, torch.einsum("cn,cni,cn->i", W, J, r), (cost * weight).sum(), weight.sum() * len(r)


def off_cell_borders(camera: Camera, reference: Reference, T: Tensor) -> Reference:
    """Take the weight of points whose pixel lies on the border of two of the interpolant's cells.

    The slope jumps there, and rounding decides on which side a float32 pixel falls: beside a pole, where a pixel's
    slope counts fifty times as much as at the equator, one such pixel alone changes H by 3e-6.
    """
    Y = T[:, :3, :3] @ reference.ray.double() + reference.rho[:, None] * T[:, :3, 3:]
    uv = torch.stack(camera.pixel_of(*Y.unbind(1)), -1)
    inside = ((uv + 0.5) % 1 - 0.5).abs().amax(-1) < 0.5 - 1e-4
    assert inside.double().mean() > 0.99
    return replace(reference, weight=reference.weight * inside)


def relative(actual: Tensor, expected: Tensor) -> float:
    return float((actual - expected).norm() / expected.norm())


@CAMERAS
@CHANNELS
@pytest.mark.parametrize("loss", [HUBER, LossConfig(name="student_t"), LossConfig(name="none")], ids=lambda x: x.name)
def test_float64_equals_the_textbook(camera, channels, loss):
    args = problem(camera, 1, channels, dtype=torch.float64)
    found = linearize(*args, loss)
    H, g, cost, weight = textbook(camera, *args, loss)
    assert relative(found.H[0], H) < 1e-10
    assert relative(found.g[0], g) < 1e-10
    torch.testing.assert_close(found.cost[0], cost, rtol=1e-12, atol=0)
    torch.testing.assert_close(found.weight[0], weight, rtol=1e-12, atol=0)


@BACKENDS
@CAMERAS
@CHANNELS
@pytest.mark.parametrize("variance", [False, True], ids=["exact depth", "uncertain depth"])
def test_float32_equals_float64_truth(backend, camera, channels, variance):
    if backend is numba:
        pytest.importorskip("numba")
    if backend is compiled and (not compiled.has_compiler() or (camera.wraps, channels, variance) not in COMPILED):
        pytest.skip("half a minute of compiling for each: two stand for all")
    reference, target, T, affine = problem(camera, 4, channels, variance=variance)
    reference = off_cell_borders(camera, reference, T)
    found = backend.linearize(reference, target, T, affine, HUBER)
    truth = linearize(*in_float64(reference, target), T.float().double(), affine.float().double(), HUBER)
    for k in range(4):
        assert relative(found.H[k], truth.H[k]) < 1e-6
        assert relative(found.g[k], truth.g[k]) < 2e-5
    torch.testing.assert_close(found.cost, truth.cost, rtol=1e-5, atol=0)
    torch.testing.assert_close(found.weight, truth.weight, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.square, truth.square, rtol=1e-5, atol=0)
    assert found.H.dtype == found.g.dtype == found.cost.dtype == torch.float64


@CAMERAS
def test_the_gradient_is_the_costs_derivative(camera):
    reference, target, T, affine = problem(camera, 1, 1, dtype=torch.float64)
    found = linearize(reference, target, T, affine, HUBER)
    polar = torch.zeros_like(reference.rho, dtype=torch.bool)
    if camera.wraps:
        # At the poles the bound on G departs from the derivative on purpose.
        samples = look_up(reference, target, T, affine)
        polar = torch.hypot(samples.ray[0], samples.ray[2])[:, 0] < 1.5 * math.sin(0.5 * math.pi / camera.height)
        assert polar.any()
    reference = replace(reference, weight=reference.weight * ~polar)
    found = linearize(reference, target, T, affine, HUBER)
    xi = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
    ab = affine.clone().requires_grad_()
    cost = linearize(reference, target, lie.se3_exp(xi) @ T, ab, HUBER).cost
    by_xi, by_ab = torch.autograd.grad(cost.sum(), (xi, ab))
    torch.testing.assert_close(torch.cat([by_xi, by_ab], -1), found.g, rtol=1e-8, atol=1e-8)


@CAMERAS
def test_uncertain_depth_gives_the_gradient_of_the_normalised_residuals(camera):
    # Squares of r sqrt(W): with G and s held, g is half the derivative of their weighted sum.
    reference, target, T, affine = problem(camera, 1, 1, variance=True, dtype=torch.float64)
    loss, noise = LossConfig(name="none"), 0.02
    found = linearize(reference, target, T, affine, loss, noise=noise)
    held = look_up(reference, target, T, affine)
    rows = [h.detach() for h in held.G]
    assert reference.variance is not None
    variance = reference.variance[:, None]

    def normalised(xi):
        moved = lie.se3_exp(xi) @ T
        samples = look_up(reference, target, moved, affine)
        dI_drho = by_rho(held._replace(G=(rows[0], rows[1], rows[2])), moved[:, :3, 3])
        return samples.residual * depth_variance_weight(dI_drho, variance, noise)[0].sqrt()

    xi = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
    if camera.wraps:
        polar = torch.hypot(held.ray[0], held.ray[2])[:, 0] < 1.5 * math.sin(0.5 * math.pi / camera.height)
        reference = replace(reference, weight=reference.weight * ~polar)
        held = look_up(reference, target, T, affine)
        found = linearize(reference, target, T, affine, loss, noise=noise)
    half = 0.5 * (held.weight * normalised(xi) ** 2).sum()
    torch.testing.assert_close(found.cost.sum(), half.detach())
    (by_xi,) = torch.autograd.grad(half, xi)
    torch.testing.assert_close(by_xi[0], found.g[0, :6], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("chunk", [256, 1000, 5000])
def test_chunks_change_nothing(monkeypatch, chunk):
    args = problem(SPHERE, 2, 1, variance=True)
    whole = linearize(*args, HUBER)
    monkeypatch.setattr(eager, "CHUNK_SAMPLES", chunk)
    parts = linearize(*args, HUBER)
    torch.testing.assert_close(parts.H, whole.H, rtol=1e-5, atol=1e-5 * float(whole.H.abs().max()))
    torch.testing.assert_close(parts.g, whole.g, rtol=1e-5, atol=1e-5 * float(whole.g.abs().max()))
    for name in ("cost", "weight", "square"):
        torch.testing.assert_close(getattr(parts, name), getattr(whole, name), rtol=1e-6, atol=0)
    exact = linearize(*in_float64(*args[:2]), *args[2:], HUBER)
    monkeypatch.undo()
    torch.testing.assert_close(linearize(*in_float64(*args[:2]), *args[2:], HUBER).H, exact.H, rtol=1e-9, atol=1e-9)


@CAMERAS
@CHANNELS
@pytest.mark.parametrize("B", [2, 5])
def test_a_batch_equals_its_pairs_alone(camera, channels, B):
    reference, target, T, affine = problem(camera, B, channels, variance=True)
    reference = off_cell_borders(camera, reference, T)
    together = linearize(reference, target, T, affine, HUBER)
    for k in range(B):
        at = torch.tensor([k])
        alone = linearize(reference.take(at), target.take(at), T[at], affine[at], HUBER)
        assert relative(together.H[k], alone.H[0]) < 1e-6
        assert relative(together.g[k], alone.g[0]) < 2e-5
        torch.testing.assert_close(together.cost[k], alone.cost[0], rtol=1e-6, atol=0)


@CAMERAS
def test_weights_select_and_scale(camera):
    reference, target, T, affine = problem(camera, 1, 1, dtype=torch.float64)
    keep = torch.rand(reference.rho.shape, generator=torch.Generator().manual_seed(0)) > 0.5
    masked = linearize(replace(reference, weight=reference.weight * keep), target, T, affine, HUBER)
    index = keep[0].nonzero()[:, 0]
    chosen = Reference(
        reference.ray[..., index], reference.rho[:, index], reference.value[..., index], reference.weight[:, index]
    )
    for one, other in zip(masked, linearize(chosen, target, T, affine, HUBER), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)
    doubled = linearize(replace(reference, weight=2 * reference.weight), target, T, affine, HUBER)
    for one, other in zip(doubled, linearize(reference, target, T, affine, HUBER), strict=True):
        torch.testing.assert_close(one, 2 * other, rtol=1e-12, atol=1e-12)


@CHANNELS
def test_saturated_and_doubtful_pixels_count_as_documented(channels):
    reference, target, T, affine = problem(SPHERE, 2, channels, dtype=torch.float64)
    inside = target.padded[..., 1:-1, 1:-1]
    half = make_target(inside, SPHERE, torch.full((2, 64, 128), 0.5, dtype=torch.float64))
    plain = linearize(reference, target, T, affine, HUBER)
    for one, other in zip(linearize(reference, half, T, affine, HUBER), plain, strict=True):
        torch.testing.assert_close(one, 0.5 * other, rtol=1e-10, atol=1e-10)
    nowhere = linearize(reference, replace(target, saturation=0.0), T, affine, HUBER)
    assert all(not part.any() for part in nowhere)
    everywhere = linearize(reference, replace(target, saturation=9.0), T, affine, HUBER)
    for one, other in zip(everywhere, plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
    some = linearize(reference, replace(target, saturation=0.5), T, affine, HUBER)
    assert (some.weight < plain.weight).all()
    samples = look_up(reference, replace(target, saturation=0.5), T, affine)
    expected = ((samples.residual + samples.gained + affine[:, 1:, None] < 0.5) * reference.weight[:, None]).sum((1, 2))
    torch.testing.assert_close(some.weight, expected, rtol=1e-9, atol=0)


@CAMERAS
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("variance", [False, True], ids=["exact depth", "uncertain depth"])
@pytest.mark.parametrize("loss", [HUBER, LossConfig(name="student_t", cutoff=0.1)], ids=lambda x: x.name)
@pytest.mark.parametrize(
    ("rho", "xi"),
    [
        (0.0, (0.0,) * 6),
        (0.5, (0.0,) * 6),
        (0.5, (0.1, 0.2, -3.0, 0.0, 3.1, 0.0)),
        (1e9, (0.1, 0.2, -3.0, 0.0, 3.1, 0.0)),
        (1e9, (0.0, 0.0, 0.0, 0.01, 0.0, 0.0)),
        (1.0, (0.0, 0.0, -1.0, 0.0, 0.0, 0.0)),
    ],
    ids=["infinity, identity", "identity", "backwards", "touching", "touching, rotation", "onto the forward ray"],
)
def test_nothing_hostile_makes_a_nan_forward_or_backward(camera, dtype, variance, loss, rho, xi):
    reference, target, _, affine = problem(camera, 2, 1, variance=variance, dtype=dtype)
    weight = reference.weight * (torch.rand(reference.weight.shape, generator=torch.Generator().manual_seed(0)) > 0.3)
    weight[1] = 0.0
    reference = replace(reference, rho=torch.full_like(reference.rho, rho), weight=weight)
    step = torch.tensor([xi, xi], dtype=torch.float64, requires_grad=True)
    found = linearize(reference, target, lie.se3_exp(step), affine, loss)
    for part in found:
        assert torch.isfinite(part).all()
        assert not part[1].any()
    (gradient,) = torch.autograd.grad(found.H.sum() + found.g.sum() + found.cost.sum(), step)
    assert torch.isfinite(gradient).all()
    assert not gradient[1].any()


def test_a_value_that_is_constant_gives_no_motion():
    reference, target, T, affine = problem(SPHERE, 1, 1)
    flat = replace(target, padded=torch.full_like(target.padded, 0.4))
    found = linearize(reference, flat, T, affine, HUBER)
    assert not found.H[0, :6].any()
    assert not found.g[0, :6].any()
    assert (found.H[0, 6:, 6:].diagonal() > 0).all()


def test_targets_of_panoramas_are_padded_around_the_sphere():
    # Turning both images and the pose's frames by a roll of columns leaves cost, and H up to the rotation, as they are.
    reference, target, T, affine = problem(SPHERE, 1, 1, dtype=torch.float64)
    k = 37
    angle = torch.tensor([0.0, k * math.tau / 128, 0.0], dtype=torch.float64)
    Y = lie.se3(lie.so3_exp(angle), torch.zeros(3, dtype=torch.float64))

    def rolled(value: Tensor) -> Tensor:
        return value.unflatten(-1, (64, 128)).roll(k, -1).flatten(-2)

    turned = Reference(reference.ray, rolled(reference.rho), rolled(reference.value), rolled(reference.weight))
    image = target.padded[..., 1:-1, 1:-1].roll(k, -1)
    plain = linearize(reference, target, T, affine, HUBER)
    found = linearize(turned, make_target(image, SPHERE), Y @ T @ lie.se3_inverse(Y), affine, HUBER)
    torch.testing.assert_close(found.cost, plain.cost, rtol=1e-10, atol=0)
    Ad = torch.eye(8, dtype=torch.float64)
    Ad[:6, :6] = lie.se3_adjoint(Y)
    torch.testing.assert_close(found.g[0], Ad @ plain.g[0], rtol=1e-8, atol=1e-8 * float(plain.g.abs().max()))
    expected = Ad @ plain.H[0] @ Ad.T
    torch.testing.assert_close(found.H[0], expected, rtol=1e-8, atol=1e-8 * float(expected.abs().max()))
    assert torch.equal(make_target(image, SPHERE).padded, pad_image(image, SPHERE, 1))
