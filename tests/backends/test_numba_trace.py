"""Compiled look-ups, traces and searches mean what the eager ones mean: at hard points, masked, out of view, empty."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.backends import backend
from torchvo360.backends.numba.images import can_see, look_up_usable, look_up_value
from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.depth import EpipolarConfig, search_great_circles
from torchvo360.residuals import direct
from torchvo360.residuals.direct import Target, make_target
from torchvo360.window import TraceConfig, View, WindowConfig, WindowFrame, make_points, project_points, trace

pytest.importorskip("numba")

FULL = Equirectangular(128, 64)
ROLLED = Equirectangular(128, 64, cx=20.0)
PARTIAL = Equirectangular(96, 40, 128 / math.tau, -64 / math.pi, 40.0, 21.0)
PLANE = Pinhole(96, 72, 80.0, 84.0, 47.1, 36.4)
EVERY = {"full": FULL, "rolled": ROLLED, "partial": PARTIAL, "pinhole": PLANE}
CAMERAS = pytest.mark.parametrize("camera", list(EVERY.values()), ids=list(EVERY))
NONE = torch.zeros(2, dtype=torch.float64)


def pictured(camera: Camera, seed: int = 0, *, masked: bool = False) -> Target:
    """Waves on the sphere, a part of them clipped and a part, if asked, masked."""
    generator = torch.Generator().manual_seed(seed)
    ray = torch.nn.functional.normalize(camera.ray_grid(dtype=torch.float64), dim=-1)
    waves = 9 * torch.randn(12, 3, generator=generator, dtype=torch.float64)
    value = 0.5 + 0.12 * (torch.einsum("hwc,bc->bhw", ray, waves) + torch.arange(12)[:, None, None]).sin().sum(0)
    confidence = (ray[..., 0] < 0.6).float()[None] if masked else None
    return make_target(value.clamp(0, 1).float()[None, None], camera, confidence, 0.9)


def hard_rays(camera: Camera) -> Tensor:
    """Axes, the poles and beside them, both sides of the seam, the image's border, behind the camera."""
    small = torch.tensor([1e-7, -1e-7, 1e-12, -1e-12])
    beside = [torch.stack([x, torch.ones(4), x.flip(0)], -1) for x in (small, -small)]
    seam = torch.stack([small, 0.3 * torch.ones(4), -torch.ones(4)], -1)
    edges = [0.1, 0.49, 0.501, 0.51, 1.0, 1.5]
    u = torch.tensor([*edges, *(camera.width - x for x in edges), -3.0, camera.width + 3.0])
    v = torch.tensor([*edges, *(camera.height - x for x in edges), camera.height / 2])
    border = camera.ray(torch.cartesian_prod(u, v))
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    many = torch.randn(700, 3, generator=torch.Generator().manual_seed(1))
    return torch.cat([axes, *beside, -beside[0], seam, border, -border, 1e9 * border, 1e-9 * border, many]).T


@CAMERAS
@pytest.mark.parametrize("masked", [False, True])
def test_look_ups_mean_what_the_eager_ones_mean(camera, masked):
    target, ray = pictured(camera, masked=masked), hard_rays(camera)
    assert can_see(target, also=(ray,))
    for compiled, eager in ((look_up_usable, direct.look_up_usable), (look_up_value, direct.look_up_value)):
        found, truth = compiled(target, ray), eager(target, ray)
        # Within rounding of what is clipped either is right.
        alike = torch.isnan(found) == torch.isnan(truth)
        assert float(alike.float().mean()) > 0.998
        torch.testing.assert_close(found[alike], truth[alike], rtol=0, atol=5e-6, equal_nan=True)


def test_rays_of_any_shape_none_and_nan_are_looked_up():
    target = pictured(FULL)
    ray = torch.randn(3, 4, 5, 6, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(
        look_up_usable(target, ray), direct.look_up_usable(target, ray), rtol=0, atol=5e-6, equal_nan=True
    )
    assert look_up_usable(target, ray[:, :0]).shape == (0, 5, 6)
    look_up_usable(target, torch.full((3, 9), torch.nan))


def test_other_types_and_what_asks_for_gradients_stay_eager():
    target, ray = pictured(FULL), torch.randn(3, 5)
    assert not can_see(target, also=(ray.double(),))
    assert not can_see(target, also=(ray.requires_grad_(),))
    with backend("eager"):
        assert not can_see(target)


def moved(t: tuple[float, float, float] = (0.12, -0.05, 0.08)) -> Tensor:
    turn = lie.so3_exp(torch.tensor([0.1, -0.3, 0.05], dtype=torch.float64))
    return lie.se3(turn, torch.tensor(t, dtype=torch.float64))


@CAMERAS
@pytest.mark.parametrize("masked", [False, True])
def test_points_are_traced_to_the_same_places(camera, masked):
    host = pictured(camera)
    pixel = torch.arange(0, camera.width * camera.height, 7)
    ray = torch.nn.functional.normalize(camera.ray_grid().view(-1, 3)[pixel], dim=-1).T.contiguous()
    points = make_points(host, pixel, ray, torch.ones(len(pixel)), WindowConfig())
    affine = torch.tensor([0.05, -0.02], dtype=torch.float64)
    views = [
        View(pictured(camera, masked=masked), moved(), affine),
        View(pictured(camera), moved((-0.1, 0, 0.1)), NONE),
    ]
    config = TraceConfig(max_energy=1, min_distinction=1.0)
    found = trace(points, host, views, config)
    with backend("eager"):
        truth = trace(points, host, views, config)
    assert int(truth.found.sum()) > 50
    # Where two places are as good as each other rounding chooses.
    assert float((found.found == truth.found).float().mean()) > 0.99
    both = found.found & truth.found
    off = (found.rho / truth.rho - 1).abs()[both]
    assert float((off > 1e-3).float().mean()) < 0.02
    assert float(off.median()) < 1e-5


def test_nothing_to_trace_and_no_way_to_go_are_no_mistake():
    host = pictured(FULL)
    ray = torch.nn.functional.normalize(FULL.ray_grid().view(-1, 3), dim=-1).T.contiguous()
    points = make_points(host, torch.arange(ray.shape[1]), ray, torch.ones(ray.shape[1]), WindowConfig())
    still = View(host, torch.eye(4, dtype=torch.float64), NONE)
    assert not bool(trace(points, host, [still], TraceConfig()).found.any())
    none = points.take(torch.zeros(0, dtype=torch.int64))
    assert trace(none, host, [still], TraceConfig()).rho.shape == (0,)


@CAMERAS
@pytest.mark.parametrize("masked", [False, True])
def test_searches_find_what_float64_finds(camera, masked):
    reference, target = pictured(camera), pictured(camera, masked=masked)
    ray = torch.nn.functional.normalize(camera.ray_grid().view(-1, 3)[::5], dim=-1).T.contiguous()
    N = ray.shape[1]
    generator = torch.Generator().manual_seed(3)
    rho = torch.rand(N, generator=generator)
    rho[::9] = 0
    variance = (0.02 + 0.4 * torch.rand(N, generator=generator)) ** 2
    slope = 0.1 * torch.rand(N, generator=generator)
    affine = torch.tensor([0.03, -0.01], dtype=torch.float64)
    config = EpipolarConfig(max_ssd=1.0, min_distinction=1.0, max_half_width_px=30)
    points = ray, rho, variance, slope
    found = search_great_circles(reference, target, *points, moved(), affine, config)
    exact = [replace(image, padded=image.padded.double()) for image in (reference, target)]
    if masked:
        exact[1] = replace(exact[1], confidence=target.confidence.double())
    truth = search_great_circles(*exact, *(part.double() for part in points), moved(), affine, config)
    assert int(truth.found.sum()) > 50
    for name in ("searched", "found"):
        assert float((getattr(found, name) == getattr(truth, name)).float().mean()) > 0.99
    same = found.found == truth.found
    close = (found.rho - truth.rho).abs() < 1e-4 * (0.1 + truth.rho)
    assert float(close[same].float().mean()) > 0.98
    both = found.found & truth.found & close
    torch.testing.assert_close(found.variance[both].double(), truth.variance[both], rtol=2e-2, atol=0)
    assert bool(torch.isinf(found.variance[~found.found]).all())


def test_points_that_are_not_numbers_and_no_points_are_searched_without_harm():
    image = pictured(FULL)
    ray = torch.nn.functional.normalize(torch.randn(3, 6, generator=torch.Generator().manual_seed(4)), dim=0)
    bad = torch.tensor([torch.nan, torch.inf, 0.0, -1.0, 1e30, 1.0])
    ones = torch.ones(6)
    for rho, variance in ((bad, ones), (ones, bad)):
        search_great_circles(image, image, ray, rho, variance, ones, moved(), NONE, EpipolarConfig())
    nowhere = torch.full((4, 4), torch.nan, dtype=torch.float64)
    assert not bool(
        search_great_circles(image, image, ray, ones, ones, ones, nowhere, NONE, EpipolarConfig()).found.any()
    )
    none = ones[:0]
    found = search_great_circles(image, image, ray[:, :0], none, none, none, moved(), NONE, EpipolarConfig())
    assert found.rho.shape == (0,)


@CAMERAS
@pytest.mark.parametrize("masked", [False, True])
def test_a_keyframe_sees_the_windows_points_alike(camera, masked):
    generator = torch.Generator().manual_seed(5)
    affine = 0.05 * torch.randn(3, 2, generator=generator, dtype=torch.float64)
    poses = [torch.eye(4, dtype=torch.float64), moved(), moved((-0.2, 0.1, 0))]
    frames = [
        WindowFrame(k, pictured(camera, masked=masked), T, ab)
        for k, (T, ab) in enumerate(zip(poses, affine, strict=True))
    ]
    ray = torch.nn.functional.normalize(camera.ray_grid().view(-1, 3)[::3], dim=-1).T.contiguous()
    rho = torch.rand(ray.shape[1], generator=generator)
    rho[::5] = 0
    points = make_points(frames[0].target, torch.arange(ray.shape[1]), ray, rho, WindowConfig())
    points.host = torch.randint(3, points.host.shape, generator=generator)
    for place in range(3):
        found = project_points(points, frames, place, 0.2)
        with backend("eager"):
            truth = project_points(points, frames, place, 0.2)
        assert 0.05 < float(truth.shown.float().mean()) < 0.98
        assert float((found.shown == truth.shown).float().mean()) > 0.995
        assert float((found.pixel == truth.pixel)[truth.shown].float().mean()) > 0.99
        torch.testing.assert_close(found.ray, truth.ray, rtol=0, atol=1e-6)
        torch.testing.assert_close(found.rho, truth.rho, rtol=1e-5, atol=1e-7)
    none = project_points(points.take(torch.zeros(0, dtype=torch.int64)), frames, 1, 0.2)
    assert none.pixel.shape == (0,)
