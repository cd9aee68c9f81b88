"""Two-view motion from bearings all around: outliers, noise, points behind, and motions without parallax."""

import math

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.motion.essential import INLIER_RAD, TwoView, estimate_two_view, inverse_ranges, sampson_angle

PIXEL_RAD = math.tau / 1024


def unit(x: Tensor) -> Tensor:
    return x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)


class Views:
    """Points all around two cameras, one metre apart or less, seen as bearings with noise and outliers."""

    def __init__(
        self, seed: int, *, length: float = 0.3, noise_px: float = 0.15, outliers: float = 0.0, turn_deg: float = 20.0
    ) -> None:
        g = torch.Generator().manual_seed(seed)
        p_ref = unit(torch.randn(300, 3, generator=g, dtype=torch.float64))
        p_ref = p_ref * (1.5 + 6 * torch.rand(300, 1, generator=g, dtype=torch.float64))
        self.R = lie.so3_exp(unit(torch.randn(3, generator=g, dtype=torch.float64)) * math.radians(turn_deg))
        self.direction = unit(torch.randn(3, generator=g, dtype=torch.float64))
        p_tgt = p_ref @ self.R.mT + length * self.direction
        noise = noise_px * PIXEL_RAD
        self.ref = unit(unit(p_ref) + noise * torch.randn(300, 3, generator=g, dtype=torch.float64))
        self.tgt = unit(unit(p_tgt) + noise * torch.randn(300, 3, generator=g, dtype=torch.float64))
        self.outlier = torch.rand(300, generator=g) < outliers
        wrong = unit(torch.randn(300, 3, generator=g, dtype=torch.float64))
        self.tgt = torch.where(self.outlier[:, None], wrong, self.tgt)
        self.rho = length / torch.linalg.vector_norm(p_ref, dim=-1)

    def estimate(self, seed: int = 0) -> TwoView:
        view = estimate_two_view(self.ref, self.tgt, torch.Generator().manual_seed(seed))
        assert view is not None
        return view

    def errors_deg(self, view: TwoView) -> tuple[float, float]:
        direction = math.degrees(math.acos(float((view.t_tgt_ref @ self.direction).clamp(-1, 1))))
        return float(lie.so3_angle(view.R_tgt_ref @ self.R.mT).rad2deg()), direction


@pytest.mark.parametrize("seed", range(8))
def test_exact_bearings_over_the_whole_sphere_give_the_exact_motion(seed):
    views = Views(seed, noise_px=0.0)
    view = views.estimate()
    assert max(views.errors_deg(view)) < 1e-3
    assert bool(view.inlier.all())
    assert view.cheirality == 1.0
    assert float(torch.linalg.vector_norm(view.t_tgt_ref)) == pytest.approx(1.0)
    torch.testing.assert_close(view.rho, views.rho, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("seed", range(8))
def test_noise_and_thirty_percent_of_outliers_are_survived(seed):
    views = Views(seed, outliers=0.3)
    view = views.estimate()
    rotation, direction = views.errors_deg(view)
    assert rotation < 0.05
    assert direction < 0.5
    assert float((view.inlier & ~views.outlier).double().sum()) > 0.95 * float((~views.outlier).double().sum())
    assert float(view.inlier[views.outlier].double().mean()) < 0.05
    assert view.cheirality > 0.95


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 179.9])
def test_any_rotation_is_recovered(turn_deg):
    views = Views(3, outliers=0.1, turn_deg=turn_deg)
    assert max(views.errors_deg(views.estimate())) < 0.5


def test_the_parallax_is_the_median_angle_that_the_translation_causes():
    views = Views(1, noise_px=0.0)
    turned = unit(views.ref @ views.R.mT)
    expected = torch.acos((turned * views.tgt).sum(-1).clamp(-1, 1)).median()
    assert views.estimate().parallax == pytest.approx(float(expected), rel=1e-3)


def test_a_pure_rotation_has_hardly_any_parallax_and_its_rotation_is_right():
    views = Views(2, length=0.0, noise_px=0.3)
    view = views.estimate()
    assert view.parallax < math.radians(0.3)
    assert views.errors_deg(view)[0] < 0.1


def test_points_at_infinity_do_not_disturb():
    views = Views(4)
    far = unit(torch.randn(200, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64))
    views.ref, views.tgt = torch.cat([views.ref, far]), torch.cat([views.tgt, far @ views.R.mT])
    view = views.estimate()
    assert max(views.errors_deg(view)) < 0.5
    assert float(view.rho[300:].abs().max()) < 1e-2


def test_few_or_unrelated_bearings_give_nothing_or_few_inliers():
    g = torch.Generator().manual_seed(0)
    ref, tgt = (unit(torch.randn(200, 3, generator=g, dtype=torch.float64)) for _ in range(2))
    assert estimate_two_view(ref[:15], tgt[:15], g) is None
    assert estimate_two_view(ref[:0], tgt[:0], g) is None
    view = estimate_two_view(ref, tgt, g)
    assert view is None or float(view.inlier.double().mean()) < 0.2


def test_identical_bearings_give_no_nan():
    ref = unit(torch.randn(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    view = estimate_two_view(ref, ref, torch.Generator().manual_seed(0))
    assert view is not None
    assert view.parallax < 1e-6
    assert bool(view.R_tgt_ref.isfinite().all())
    assert bool(view.rho.isfinite().all())


def test_equal_generators_give_equal_bits():
    views = Views(5, outliers=0.3)
    first, second = views.estimate(7), views.estimate(7)
    assert torch.equal(first.R_tgt_ref, second.R_tgt_ref)
    assert torch.equal(first.t_tgt_ref, second.t_tgt_ref)
    assert torch.equal(first.inlier, second.inlier)


@pytest.mark.parametrize("seed", range(3))
def test_inverse_ranges_are_the_true_ones_in_any_batch(seed):
    views = Views(seed, noise_px=0.0)
    rho = inverse_ranges(views.R, views.direction, views.ref, views.tgt)
    torch.testing.assert_close(rho, views.rho, rtol=1e-9, atol=1e-12)
    both = inverse_ranges(
        torch.stack([views.R, views.R]), torch.stack([views.direction, -views.direction]), views.ref, views.tgt
    )
    torch.testing.assert_close(both, torch.stack([views.rho, -views.rho]), rtol=1e-9, atol=1e-12)


def test_inverse_ranges_along_the_translation_are_finite():
    t = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    rho = inverse_ranges(torch.eye(3, dtype=torch.float64), t, t[None], t[None])
    assert bool(rho.isfinite().all())


def test_the_sampson_angle_is_the_angle_off_the_epipolar_plane_shared_by_both_bearings():
    """A bearing turned off its plane by a small angle is a distance of 1 / sqrt 2 of it from a consistent pair."""
    views = Views(6, noise_px=0.0)
    E = lie.so3_hat(views.direction) @ views.R
    assert float(sampson_angle(E, views.ref, views.tgt).max()) < 1e-9
    normal = unit(torch.linalg.cross(views.tgt, views.direction.expand_as(views.tgt)))
    off = unit(views.tgt + 1e-3 * normal)
    error = sampson_angle(E, views.ref, off)
    wide = torch.linalg.vector_norm(torch.linalg.cross(views.tgt, views.direction.expand_as(views.tgt)), dim=-1) > 0.3
    assert float(error[wide].median()) == pytest.approx(1e-3 / math.sqrt(2), rel=0.05)
    assert float(error.max()) < INLIER_RAD
