"""The inverse-range filter: the Kalman update of a scalar, outliers, and neighbours over seam and poles."""

import math

import pytest
import torch
from torch import Tensor

from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.depth import EpipolarMatch, FilterConfig, InverseRange, fuse, smooth
from torchvo360.depth.filter import box_sums, scatter


def state(rho: list[float], variance: list[float], score: list[float] | None = None) -> InverseRange:
    score = [1.0] * len(rho) if score is None else score
    return InverseRange(*(torch.tensor(part, dtype=torch.float64) for part in (rho, variance, score)))


def match(rho: list[float], variance: list[float], found: list[bool], searched: list[bool] | None = None):
    return EpipolarMatch(
        torch.tensor(rho, dtype=torch.float64),
        torch.tensor(variance, dtype=torch.float64),
        torch.tensor(found if searched is None else searched),
        torch.tensor(found),
    )


def test_a_match_is_fused_by_the_kalman_update_of_a_scalar():
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        mean, other = (1 + torch.rand(2, generator=generator)).tolist()
        V, S = (0.5 + torch.rand(2, generator=generator)).tolist()
        out = fuse(state([mean], [V]), match([other], [S], [True]), FilterConfig(inflation=1.0))
        assert float(out.rho) == pytest.approx((mean / V + other / S) / (1 / V + 1 / S))
        assert float(out.variance) == pytest.approx(1 / (1 / V + 1 / S))
        assert float(out.score) == 2


def test_every_frame_inflates_the_variance():
    config = FilterConfig(inflation=1.1)
    unsearched = fuse(state([1.0], [0.2]), match([1.0], [math.inf], [False], [False]), config)
    assert float(unsearched.variance) == pytest.approx(0.22)
    assert float(unsearched.score) == 1
    fused = fuse(state([1.0], [0.2]), match([1.0], [0.2], [True]), config)
    assert float(fused.variance) == pytest.approx(0.11)


def test_outliers_leave_the_mean_inflate_the_variance_and_lower_the_score():
    config = FilterConfig()
    out = fuse(state([1.0], [0.01]), match([2.0], [0.01], [True]), config)
    assert float(out.rho) == 1.0
    assert float(out.variance) == pytest.approx(0.01 * config.outlier_inflation)
    assert float(out.score) == 0
    # the gate is on the innovation's own deviation: 3 sqrt(V + S)
    inside, outside = 1 + 2.99 * math.sqrt(0.02), 1 + 3.01 * math.sqrt(0.02)
    both = fuse(state([1.0] * 2, [0.01] * 2), match([inside, outside], [0.01] * 2, [True] * 2), config)
    assert (both.rho > 1).tolist() == [True, False]


def test_a_failed_search_lowers_the_score_by_a_third_and_scores_stay_in_their_bounds():
    config = FilterConfig()
    failed = match([1.0], [math.inf], [False], [True])
    points = fuse(state([1.0], [0.01]), failed, config)
    assert float(points.score) == pytest.approx(2 / 3)
    for _ in range(40):
        points = fuse(points, failed, config)
    assert float(points.score) == config.min_score
    for _ in range(40):
        points = fuse(points, match([1.0], [0.01], [True]), config)
    assert float(points.score) == config.max_score


def test_no_match_puts_a_point_behind_infinity_or_makes_anything_nan():
    prior = state([1e-3, 1.0, 0.0, 0.0], [4.0, 4.0, 1.0, 0.01])
    out = fuse(prior, match([0.0, -2.0, 0.0, 0.5], [1e-9, 1e-9, 1e-9, 1e-9], [True] * 4), FilterConfig())
    assert bool((out.rho >= 0).all())
    assert float(out.rho[1]) > 0
    assert all(bool(part.isfinite().all()) for part in out)


def test_repeated_matches_converge_and_their_variance_is_that_of_the_mean():
    generator = torch.Generator().manual_seed(0)
    points = InverseRange(torch.ones(4000), torch.full((4000,), 0.3**2), torch.zeros(4000))
    for _ in range(10):
        measured = 1.2 + 0.1 * torch.randn(4000, generator=generator)
        found = torch.ones(4000, dtype=torch.bool)
        points = fuse(points, EpipolarMatch(measured, torch.full((4000,), 0.01), found, found), FilterConfig())
    error = points.rho - 1.2
    assert float(error.mean().abs()) < 0.02, "the prior at 1.0 still counts a hundredth"
    assert float(error.std()) == pytest.approx(float(points.variance.sqrt().mean()), rel=0.15)


# Neighbours


def neighbours(row: int, column: int, camera: Camera, radius: int) -> list[tuple[int, int]]:
    """The square around a pixel, one by one: over a pole the row comes back on the opposite meridian."""
    out = []
    for r in range(row - radius, row + radius + 1):
        for c in range(column - radius, column + radius + 1):
            if camera.wraps:
                over = r < 0 or r >= camera.height
                r_in = -1 - r if r < 0 else 2 * camera.height - 1 - r if r >= camera.height else r
                out.append((r_in, (c + (camera.width // 2 if over else 0)) % camera.width))
            else:
                out.append((min(max(r, 0), camera.height - 1), min(max(c, 0), camera.width - 1)))
    return out


@pytest.mark.parametrize("camera", [Equirectangular(16, 8), Pinhole(11, 7, 8.0, 8.0, 5.5, 3.5)], ids=["sphere", "flat"])
@pytest.mark.parametrize("radius", [1, 2, 3])
def test_box_sums_are_those_of_a_plain_loop(camera, radius):
    grid = torch.rand(2, camera.height, camera.width, generator=torch.Generator().manual_seed(0))
    expected = torch.zeros_like(grid)
    for row in range(camera.height):
        for column in range(camera.width):
            for r, c in neighbours(row, column, camera, radius):
                expected[:, row, column] += grid[:, r, c]
    torch.testing.assert_close(box_sums(grid, camera, radius), expected)


def test_box_sums_keep_small_values_beside_large_ones():
    camera = Equirectangular(64, 32)
    grid = torch.full((1, 32, 64), 1e-3)
    grid[0, 0, 0] = 1e8
    far = box_sums(grid, camera, 2)[0, 20, 40]
    assert float(far) == pytest.approx(25e-3, rel=1e-3)


def test_scatter_adds_up_what_falls_on_one_pixel():
    camera = Equirectangular(8, 4)
    grid = scatter(camera, torch.tensor([3, 3, 31]), torch.tensor([[1.0, 2.0, 5.0], [10.0, 20.0, 50.0]]))
    assert grid.shape == (2, 4, 8)
    assert grid[:, 0, 3].tolist() == [3.0, 30.0]
    assert grid[:, 3, 7].tolist() == [5.0, 50.0]
    assert float(grid.sum()) == 88.0


CAMERA = Equirectangular(32, 16)


def dense(rho: Tensor, relative_sigma: float = 0.2) -> tuple[InverseRange, Tensor, Tensor]:
    flat = rho.flatten()
    points = InverseRange(flat, (relative_sigma * flat) ** 2, torch.ones_like(flat))
    return points, torch.arange(flat.numel()), torch.ones_like(flat, dtype=torch.bool)


def test_smoothing_reduces_noise_without_moving_the_level():
    noise = torch.randn(16, 32, generator=torch.Generator().manual_seed(0))
    points, pixel, usable = dense(1 + 0.1 * noise, 0.1)
    points = points._replace(variance=torch.full_like(points.rho, 0.01))
    out = smooth(points, pixel, CAMERA, usable, FilterConfig(smoothing=0.5))
    assert float((out.rho - 1).std()) < 0.75 * float((points.rho - 1).std())
    assert float(out.rho.mean()) == pytest.approx(float(points.rho.mean()), abs=0.01)
    unchanged = smooth(points, pixel, CAMERA, usable, FilterConfig(smoothing=0.0))
    torch.testing.assert_close(unchanged.rho, points.rho, rtol=0, atol=0)


def test_smoothing_leaves_the_two_sides_of_a_depth_edge_apart():
    rho = torch.ones(16, 32)
    rho[:, 8:24] = 3.0
    points, pixel, usable = dense(rho, 0.05)
    out = smooth(points, pixel, CAMERA, usable, FilterConfig(smoothing=1.0))
    torch.testing.assert_close(out.rho, points.rho)
    torch.testing.assert_close(out.score, points.score, rtol=0, atol=0)


@pytest.mark.parametrize("place", [(8, 16), (8, 0), (0, 5), (15, 31)], ids=["middle", "seam", "north", "corner"])
def test_a_point_that_contradicts_its_neighbours_is_marked_down(place):
    rho = torch.ones(16, 32)
    rho[place] = 4.0
    points, pixel, usable = dense(rho)
    out = smooth(points, pixel, CAMERA, usable, FilterConfig())
    at = place[0] * 32 + place[1]
    assert float(out.rho[at]) == 4.0
    assert float(out.score[at]) == 0.5
    assert bool((out.score[torch.arange(512) != at] == 1).all())


def test_unusable_points_neither_speak_nor_change():
    rho = torch.ones(16, 32)
    rho[8, 15] = 1.2
    points, pixel, usable = dense(rho)
    usable[8 * 32 + 15] = False
    out = smooth(points, pixel, CAMERA, usable, FilterConfig(smoothing=1.0))
    assert float(out.rho[8 * 32 + 15]) == pytest.approx(1.2)
    torch.testing.assert_close(out.rho[8 * 32 + 14], torch.tensor(1.0))


@pytest.mark.parametrize(
    ("name", "value"),
    [("inflation", 0.5), ("gate_sigma", 0.0), ("smoothing", 1.5), ("radius_px", 0), ("variance_floor", -1.0)],
)
def test_unusable_settings_are_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        FilterConfig(**{name: value})
