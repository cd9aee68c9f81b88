"""Points keep together what belongs together, in the order of their hosts."""

from dataclasses import fields

import pytest
import torch
from window_scenes import scene

from torchvo360.residuals.direct import Target
from torchvo360.window import CENTRE, PATTERN, WindowConfig, make_points, pattern_rays
from torchvo360.window.points import LEADING

PLACES = (0, 8, 16, 24)


def rows(points) -> list[tuple]:
    parts = [
        getattr(points, f.name).movedim(1, 0) if f.name in LEADING else getattr(points, f.name) for f in fields(points)
    ]
    return [tuple(part[i].flatten().tolist() for part in parts) for i in range(len(points))]


def test_joined_points_are_all_of_them_in_the_order_of_their_hosts():
    truth, config = scene(*PLACES), WindowConfig()
    first, second, third = truth.points(2, 120, config), truth.points(0, 100, config), truth.points(2, 130, config)
    joined = first.joined(second).joined(third)
    assert rows(joined) == rows(second) + rows(first) + rows(third)


def test_taken_points_are_those_asked_for_in_that_order():
    points = scene(*PLACES).points(1, 150, WindowConfig())
    index = torch.tensor([7, 0, 3, 3, len(points) - 1])
    assert rows(points.take(index)) == [rows(points)[i] for i in index]
    assert len(points.take(torch.zeros(0, dtype=torch.long))) == 0


@pytest.mark.parametrize("ray", [[0.0, 0, 1], [1, 0, 0], [0, 0, -1], [0, 1, 0], [0, -1, 0], [0.5, -0.7, -0.3]])
def test_the_pattern_is_of_one_size_everywhere(ray):
    middle = torch.tensor(ray, dtype=torch.float64)
    middle = middle / middle.norm()
    rays = pattern_rays(middle[:, None], 0.01)[:, 0]
    torch.testing.assert_close(rays.norm(dim=0), torch.ones(len(PATTERN), dtype=torch.float64))
    torch.testing.assert_close(rays[:, CENTRE], middle)
    angle = torch.linalg.cross(rays, middle[:, None].expand_as(rays), dim=0).norm(dim=0).asin()
    expected = torch.tensor(PATTERN, dtype=torch.float64).norm(dim=1) * 0.01
    torch.testing.assert_close(angle, expected, rtol=1e-3, atol=1e-9)


def test_pixels_of_the_pattern_lead_back_to_its_rays():
    truth = scene(*PLACES)
    points = truth.points(0, 400, WindowConfig())
    rays = truth.camera.ray(points.uv.movedim(0, -1)).movedim(-1, 0)
    torch.testing.assert_close(rays, points.ray, atol=2e-6, rtol=0)


def test_masked_and_clipped_patterns_weigh_nothing():
    truth, config = scene(*PLACES), WindowConfig()
    frame = truth.frames[0].targets[0]
    points = truth.points(0, 400, config)
    left = torch.ones_like(frame.padded)
    left[..., : left.shape[-1] // 2] = 0
    masked = Target(frame.camera, frame.padded, left, frame.saturation)
    again = make_points(masked, points.pixel, points.ray[..., CENTRE].contiguous(), points.rho, config)
    level = points.ray[1].abs().amax(1) < 0.9  # nearer to a pole a pattern spans many columns
    column = torch.where(level, points.pixel % truth.camera.width, 0)
    half = truth.camera.width // 2
    assert bool((again.weight[(column > 4) & (column < half - 4)] == 0).all())
    inside = (column > half + 4) & (column < truth.camera.width - 4)
    torch.testing.assert_close(again.weight[inside], points.weight[inside])
    clipped = Target(frame.camera, torch.ones_like(frame.padded), None, 0.9)
    assert float(make_points(clipped, points.pixel, points.ray[..., CENTRE], points.rho, config).weight.sum()) == 0
