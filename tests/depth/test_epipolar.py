"""The epipolar search: angles against ranges, honest variances, and everything that must not be found."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.data.synthetic import make_world
from torchvo360.data.synthetic.motion import trajectory
from torchvo360.depth.epipolar import EpipolarConfig, EpipolarMatch, great_circles, search_great_circles
from torchvo360.image import blur, gradient_magnitude, select_pixels
from torchvo360.residuals.direct import make_target

NO_CHANGE = torch.zeros(2, dtype=torch.float64)


def random_directions(count: int, seed: int) -> Tensor:
    p = torch.randn(3, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return p / p.norm(dim=0)


def motion(t: tuple[float, float, float], w: tuple[float, float, float] = (0.1, -0.2, 0.05)) -> Tensor:
    return lie.se3(lie.so3_exp(torch.tensor(w, dtype=torch.float64)), torch.tensor(t, dtype=torch.float64))


# Angles and inverse ranges


@pytest.mark.parametrize("t", [(0.3, -0.1, 0.2), (0.0, 0.5, 0.0), (0.0, 0.0, -0.02), (4.0, 1.0, 2.0)])
def test_the_angle_of_an_inverse_range_is_where_the_point_is_seen(t):
    """Oracle: the angle between the point's direction and that of infinity, from the point itself in numpy."""
    ray, T = random_directions(500, 0), motion(t)
    rho = 10 ** torch.linspace(-3, 1, 500, dtype=torch.float64)
    point = (T[:3, :3].numpy() @ (ray / rho).numpy()) + np.array(t)[:, None]
    at_infinity = T[:3, :3].numpy() @ ray.numpy()
    cross = np.linalg.norm(np.cross(at_infinity, point, axis=0), axis=0)
    expected = np.arctan2(cross, (at_infinity * point).sum(0))
    circles = great_circles(ray, T)
    np.testing.assert_allclose(circles.angle(rho).numpy(), expected, atol=1e-12)
    on_circle = circles.start * circles.angle(rho).cos() + circles.towards * circles.angle(rho).sin()
    np.testing.assert_allclose(on_circle.numpy(), point / np.linalg.norm(point, axis=0), atol=1e-9)


def test_angle_and_inverse_range_are_each_other_s_inverse_with_the_right_slope():
    circles = great_circles(random_directions(400, 1), motion((0.3, -0.1, 0.2)))
    rho = torch.linspace(0, 3, 400, dtype=torch.float64)
    theta = circles.angle(rho)
    kept = (circles.sine > 0.1) & (theta < circles.phi - 0.01)
    assert kept.double().mean() > 0.9
    torch.testing.assert_close(circles.rho(theta)[kept], rho[kept], rtol=1e-9, atol=1e-12)
    assert circles.angle(torch.zeros(400, dtype=torch.float64)).abs().max() == 0, "rho = 0 is the start of the circle"
    eps = 1e-7
    slope = (circles.rho(theta + eps) - circles.rho(theta - eps)) / (2 * eps)
    torch.testing.assert_close(circles.rho_by_angle(theta)[kept], slope[kept], rtol=1e-5, atol=1e-7)


# Search on a rendered pair with known motion


class Pair:
    """Two views of a rendered room with exact ranges, and points with gradient in the first.

    As the search's settings expect it, the images have noise of 4 / 255, and the known motion is a quarter of a pixel
    off.
    """

    def __init__(self, camera: Camera, *, gap: int = 8, noise: float = 4 / 255, error_px: float = 0.25) -> None:
        scene = make_world("room", seed=3)
        T_world_cam = trajectory("walk", scene.walkway, gap + 1, 30.0, seed=3)[[0, gap]]
        images, ranges = scene.render(camera, T_world_cam)
        generator = torch.Generator().manual_seed(1)
        grey = [blur(image.mean(0), camera, 0.5) for image in images]
        grey = [image + noise * torch.randn(image.shape, generator=generator) for image in grey]
        axis = random_directions(1, 2)[:, 0] * error_px * camera.pixel_angle
        error = lie.se3(lie.so3_exp(axis), torch.zeros(3, dtype=torch.float64))
        self.T_tgt_ref = error @ lie.se3_inverse(T_world_cam[1]) @ T_world_cam[0]
        self.camera = camera
        self.images = grey
        self.reference, self.target = (make_target(image[None, None], camera) for image in grey)
        strength = gradient_magnitude(grey[0], camera)
        everywhere = torch.ones(camera.height, camera.width, dtype=torch.bool)
        self.pixel = select_pixels(strength, everywhere, camera, 6000, minimum=4 / 255)
        ray = camera.ray_grid().view(-1, 3)[self.pixel].T
        length = ray.square().sum(0).sqrt()
        self.ray = ray / length
        self.rho = 1 / (ranges[0].flatten()[self.pixel] * length)
        self.slope = strength.flatten()[self.pixel]
        self.uv = camera.pixel_grid().view(-1, 2)[self.pixel]

    def search(self, prior: Tensor, variance: Tensor, *, T: Tensor | None = None, **settings) -> EpipolarMatch:
        T = self.T_tgt_ref if T is None else T
        config = EpipolarConfig(**settings)
        return search_great_circles(
            self.reference, self.target, self.ray, prior, variance, self.slope, T, NO_CHANGE, config
        )

    def noisy_prior(self, share: float, seed: int = 0) -> Tensor:
        noise = torch.randn(len(self.rho), generator=torch.Generator().manual_seed(seed))
        return (self.rho * (1 + share * noise)).clamp_min(1e-3)


@pytest.fixture(scope="module")
def pair() -> Pair:
    return Pair(Equirectangular(512, 256))


@pytest.fixture(scope="module")
def found(pair: Pair) -> EpipolarMatch:
    return pair.search(pair.noisy_prior(0.2), (0.2 * pair.rho) ** 2)


def check_honest(match: EpipolarMatch, rho: Tensor, kept: Tensor) -> None:
    """Normalised errors of unit variance have a median of 0.67: within a factor of two, and few outliers."""
    kept = kept & match.found
    assert int(kept.sum()) > 100
    z = ((match.rho - rho) / match.variance.sqrt()).abs()[kept]
    assert 0.33 < float(z.median()) < 1.35
    assert float((z < 3).float().mean()) > 0.92


def test_most_searched_points_are_found_much_closer_than_their_prior(pair, found):
    assert float(found.searched.float().mean()) > 0.5
    assert float(found.found[found.searched].float().mean()) > 0.8
    error = ((found.rho - pair.rho) / pair.rho).abs()[found.found]
    assert float(error.median()) < 0.045, "against 13 % of the prior"


def test_variances_are_honest_within_a_factor_of_two(pair, found):
    check_honest(found, pair.rho, torch.ones_like(found.found))


def test_variances_are_conservative_for_clean_images_and_an_exact_motion():
    pair = Pair(Equirectangular(512, 256), noise=0.0, error_px=0.0)
    match = pair.search(pair.noisy_prior(0.2), (0.2 * pair.rho) ** 2)
    z = ((match.rho - pair.rho) / match.variance.sqrt()).abs()[match.found]
    assert float(z.median()) < 0.5
    assert float((z < 3).float().mean()) > 0.97
    error = ((match.rho - pair.rho) / pair.rho).abs()[match.found]
    assert float(error.median()) < 0.02


def test_the_search_goes_across_the_seam(pair, found):
    u = pair.uv[:, 0]
    check_honest(found, pair.rho, (u < 12) | (u > pair.camera.width - 12))
    u_tgt = pair.camera.pixel_of(*(pair.T_tgt_ref[:3, :3].float() @ pair.ray + pair.rho * pair.T_tgt_ref[:3, 3:]))[0]
    crossed = (u_tgt % pair.camera.width - u).abs() > pair.camera.width / 2
    assert int((crossed & found.found).sum()) > 5
    error = ((found.rho - pair.rho) / pair.rho).abs()[crossed & found.found]
    assert float(error.median()) < 0.1


def test_the_search_works_near_the_poles(pair, found):
    v = pair.uv[:, 1]
    check_honest(found, pair.rho, (v < 0.15 * pair.camera.height) | (v > 0.85 * pair.camera.height))


def test_a_brightness_change_that_is_known_costs_nothing(pair, found):
    changed = make_target(pair.images[1][None, None] * math.exp(-0.5) + 0.1, pair.camera)
    match = search_great_circles(
        pair.reference, changed, pair.ray, pair.noisy_prior(0.2), (0.2 * pair.rho) ** 2, pair.slope, pair.T_tgt_ref,
        torch.tensor([-0.5, 0.1], dtype=torch.float64), EpipolarConfig(),
    )  # fmt: skip
    both = match.found & found.found
    assert float(both.float().sum()) > 0.8 * float(match.found.float().sum())
    torch.testing.assert_close(match.rho[both].median(), found.rho[both].median(), rtol=1e-2, atol=0)


def test_what_is_not_found_keeps_its_prior_and_an_infinite_variance(pair, found):
    missed = ~found.found
    assert bool(missed.any())
    torch.testing.assert_close(found.rho[missed], pair.noisy_prior(0.2)[missed], rtol=0, atol=0)
    assert bool(found.variance[missed].isinf().all())
    assert bool((found.variance[found.found] > 0).all())
    assert bool((found.rho >= 0).all())
    assert not bool((found.found & ~found.searched).any())


# What must not be searched or found


def test_too_uncertain_and_too_certain_points_wait(pair):
    too_wide = pair.search(pair.rho, (2.0 * pair.rho + 5) ** 2)
    assert float(too_wide.searched.float().mean()) < 0.1, "those near the translation move little"
    certain = pair.search(pair.rho, (1e-4 * pair.rho) ** 2)
    assert not bool(certain.searched.any()), "a match could not improve them"


def test_points_along_the_translation_are_not_searched(pair):
    towards = pair.T_tgt_ref[:3, :3].mT.float() @ pair.T_tgt_ref[:3, 3].float()
    sine = torch.linalg.cross(pair.ray, (towards / towards.norm())[:, None].expand_as(pair.ray), dim=0).norm(dim=0)
    match = pair.search(pair.noisy_prior(0.2), (0.2 * pair.rho) ** 2)
    assert int((sine < 0.1).sum()) > 5
    assert not bool(match.searched[sine < 0.099].any())


@pytest.mark.parametrize("length", [0.0, 1e-15, 1e-7])
def test_without_translation_nothing_is_found_and_nothing_is_nan(pair, length):
    T = pair.T_tgt_ref.clone()
    T[:3, 3] *= length
    match = pair.search(pair.noisy_prior(0.2), (0.2 * pair.rho) ** 2, T=T)
    assert not bool(match.found.any())
    assert not any(bool(part.isnan().any()) for part in (match.rho, match.variance))


def test_points_at_infinity_are_searched_without_nan(pair):
    match = pair.search(torch.zeros_like(pair.rho), torch.full_like(pair.rho, 0.05**2))
    assert bool(match.searched.any())
    assert not any(bool(part.isnan().any()) for part in (match.rho, match.variance))
    assert bool((match.rho >= 0).all())


def stripes(camera: Equirectangular, period_px: float) -> Tensor:
    u = camera.pixel_grid()[..., 0]
    return 0.5 + 0.25 * torch.sin(u * (math.tau / period_px))


def search_stripes(image: Tensor, half_width_px: float) -> EpipolarMatch:
    """Search at points of the equator whose match is 8 px away, the translation across them."""
    camera = Equirectangular(512, 256)
    uv = torch.stack([torch.arange(216.5, 296.5), torch.full((80,), 128.0)], -1)
    ray = camera.ray(uv.double()).float().T.contiguous()
    T = motion((0.1, 0.0, 0.0), (0.0, 0.0, 0.0))
    # tan(theta) = rho t sin(phi) / (1 + rho t cos(phi)): solved for the rho that moves each ray by theta
    theta = 8 * camera.pixel_angle
    circles = great_circles(ray, T.float())
    rho = circles.rho(torch.full((80,), theta))
    sigma = half_width_px / 2 * camera.pixel_angle * circles.rho_by_angle(torch.full((80,), theta))
    target = make_target(image[None, None].roll(8, -1), camera)
    reference = make_target(image[None, None], camera)
    slope = gradient_magnitude(image, camera)[128, 216:296]
    return search_great_circles(reference, target, ray, rho, sigma**2, slope, T, NO_CHANGE, EpipolarConfig())


def test_repeated_texture_is_found_only_where_one_repetition_can_be_meant():
    camera = Equirectangular(512, 256)
    ambiguous = search_stripes(stripes(camera, 8.0), half_width_px=14)
    assert float(ambiguous.searched.float().mean()) > 0.9
    assert float(ambiguous.found.float().mean()) < 0.02
    clear = search_stripes(stripes(camera, 64.0), half_width_px=14)
    assert float(clear.found.float().mean()) > 0.5


def test_an_image_without_gradient_is_not_searched():
    match = search_stripes(torch.full((256, 512), 0.4), half_width_px=6)
    assert not bool(match.searched.any())


def test_a_changed_scene_is_not_found(pair):
    noise = torch.rand(1, 1, 256, 512, generator=torch.Generator().manual_seed(0))
    target = make_target(noise, pair.camera)
    prior = pair.noisy_prior(0.2)
    match = search_great_circles(
        pair.reference, target, pair.ray, prior, (0.2 * pair.rho) ** 2, pair.slope, pair.T_tgt_ref, NO_CHANGE,
        EpipolarConfig(),
    )  # fmt: skip
    assert float(match.found.float().sum()) < 0.05 * float(match.searched.float().sum())


def test_a_pinhole_finds_ranges_too_and_what_leaves_the_view_gives_no_nan():
    pair = Pair(Pinhole(240, 180, 160.0, 160.0, 120.0, 90.0), gap=6)
    turned = motion((0.2, 0.0, 0.1), (0.0, 0.5, 0.0))
    for T in (pair.T_tgt_ref, turned, motion((0.2, 0.0, 0.1), (0.0, math.pi, 0.0))):
        match = pair.search(pair.noisy_prior(0.2), (0.2 * pair.rho) ** 2, T=T)
        assert not any(bool(part.isnan().any()) for part in (match.rho, match.variance))
    assert not bool(match.found.any()), "everything is behind the camera"
    check_honest(pair.search(pair.noisy_prior(0.2), (0.2 * pair.rho) ** 2), pair.rho, torch.ones_like(match.found))


@pytest.mark.parametrize(
    ("name", "value"),
    [("max_half_width_px", 2), ("min_gradient", 0.0), ("max_ssd", -1.0), ("min_sine", 1.5), ("noise", math.nan)],
)
def test_unusable_settings_are_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        EpipolarConfig(**{name: value})
