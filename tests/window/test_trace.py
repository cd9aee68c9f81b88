"""Tracing finds the ranges of points along their great circles, and says where it does not."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from window_scenes import Scene, scene

from torchvo360 import lie
from torchvo360.residuals.direct import Target
from torchvo360.window import CENTRE, TraceConfig, View, WindowConfig, WindowPoints, trace

PLACES = (0, 8, 16, 24)
NONE = torch.zeros(2, dtype=torch.float64)


def views(truth: Scene, host: int, *others: int) -> list[View]:
    T = truth.T_cam_world
    return [View(truth.frames[j].targets[0], T[j] @ lie.se3_inverse(T[host]), NONE) for j in others]


def traced(truth: Scene, *others: int, host: int = 2) -> tuple[WindowPoints, Tensor, Tensor]:
    """Points of a keyframe, the share by which their traced ranges err, and which were found."""
    points = truth.points(host, 1500, WindowConfig())
    found = trace(points, truth.frames[host].targets[0], views(truth, host, *others), TraceConfig())
    return points, (found.rho / points.rho - 1).abs(), found.found


@pytest.mark.parametrize(
    ("world", "camera"), [("room", "equirectangular"), ("courtyard", "equirectangular"), ("room", "pinhole")]
)
def test_most_ranges_are_found_and_right(world, camera):
    size = {"width": 320, "height": 240} if camera == "pinhole" else {}
    points, error, found = traced(scene(*PLACES, world=world, camera=camera, **size), 0, 1)
    assert len(points) > 200
    assert float(found.float().mean()) > 0.3
    assert float(error[found].median()) < 0.04
    assert float((error[found] > 0.3).float().mean()) < 0.12


@pytest.mark.parametrize("where", ["seam", "poles"])
def test_at_the_seam_and_near_the_poles_as_well(where):
    points, error, found = traced(scene(*PLACES), 0, 1)
    ray = points.ray[..., CENTRE]
    here = (ray[2] < -0.85 * ray[:3:2].norm(dim=0)) if where == "seam" else ray[1].abs() > 0.8
    assert int((found & here).sum()) > 10
    assert float(error[found & here].median()) < 0.05


def test_two_views_tell_wrong_matches_better_than_one():
    _, one, found_in_one = traced(scene(*PLACES), 0)
    _, two, found_in_two = traced(scene(*PLACES), 0, 1)
    assert float((two[found_in_two] > 0.3).float().mean()) < float((one[found_in_one] > 0.3).float().mean())


def test_brightness_of_the_view_is_allowed_for():
    truth = scene(*PLACES)
    points = truth.points(2, 1500, WindowConfig())
    (view,) = views(truth, 2, 0)
    plain = trace(points, truth.frames[2].targets[0], [view], TraceConfig())
    darker = replace(view.target, padded=view.target.padded * 0.7 + 0.05)
    affine = torch.tensor([0.7, 0.05], dtype=torch.float64)
    affine[0] = affine[0].log()
    config = TraceConfig(min_distinction=1.5)
    same = trace(points, truth.frames[2].targets[0], [View(darker, view.T_tgt_host, affine)], config)
    both = plain.found & same.found
    assert int(both.sum()) > 0.8 * int(plain.found.sum())
    torch.testing.assert_close(same.rho[both].median(), plain.rho[both].median(), rtol=1e-2, atol=0)
    ignored = trace(points, truth.frames[2].targets[0], [View(darker, view.T_tgt_host, NONE)], config)
    assert int(ignored.found.sum()) < 0.5 * int(same.found.sum())


def test_nothing_is_found_in_images_of_something_else_and_without_texture():
    truth = scene(*PLACES)
    points = truth.points(2, 1500, WindowConfig())
    (view,) = views(truth, 2, 0)
    right = trace(points, truth.frames[2].targets[0], [view], TraceConfig()).found.float().mean()
    g = torch.Generator().manual_seed(0)
    noise = replace(view.target, padded=torch.rand(view.target.padded.shape, generator=g))
    flat = replace(view.target, padded=torch.full_like(view.target.padded, 0.5))
    for image, share in ((noise, 0.1), (flat, 0.0)):
        found = trace(points, truth.frames[2].targets[0], [View(image, view.T_tgt_host, NONE)], TraceConfig()).found
        assert float(found.float().mean()) <= share * float(right)


def test_without_texture_in_the_host_nothing_is_found_either():
    truth = scene(*PLACES)
    points = truth.points(2, 1500, WindowConfig())
    flat = replace(points, value=torch.full_like(points.value, 0.5))
    target = truth.frames[2].targets[0]
    grey = replace(target, padded=torch.full_like(target.padded, 0.5))
    view = views(truth, 2, 0)[0]
    all_grey = View(replace(view.target, padded=torch.full_like(view.target.padded, 0.5)), view.T_tgt_host, NONE)
    assert not bool(trace(flat, grey, [all_grey], TraceConfig()).found.any())


def test_what_the_view_masks_is_not_found():
    truth = scene(*PLACES)
    points = truth.points(2, 1500, WindowConfig())
    (view,) = views(truth, 2, 0)
    hidden = torch.ones_like(view.target.padded)
    hidden[..., : hidden.shape[-1] // 2] = 0
    masked = View(Target(view.target.camera, view.target.padded, hidden, None), view.T_tgt_host, NONE)
    found = trace(points, truth.frames[2].targets[0], [masked], TraceConfig()).found
    there = view.T_tgt_host.float()
    Y = there[:3, :3] @ points.ray[..., CENTRE] + points.rho * there[:3, 3:]
    u = truth.camera.pixel_of(*Y)[0]
    half = truth.camera.width // 2
    behind, open_ = (u > 8) & (u < half - 8), (u > half + 8) & (u < truth.camera.width - 8)
    assert int(found[open_].sum()) > 100
    assert int(found[behind].sum()) < 0.05 * int(found[open_].sum())


def test_a_view_from_the_same_place_tells_no_range():
    truth = scene(*PLACES)
    points = truth.points(2, 500, WindowConfig())
    still = View(truth.frames[2].targets[0], torch.eye(4, dtype=torch.float64), NONE)
    found = trace(points, truth.frames[2].targets[0], [still], TraceConfig())
    assert not bool(found.found.any())
    assert bool(torch.isfinite(found.rho).all())


def test_no_points_are_no_mistake():
    truth = scene(*PLACES)
    none = truth.points(2, 500, WindowConfig()).take(torch.zeros(0, dtype=torch.long))
    assert trace(none, truth.frames[2].targets[0], views(truth, 2, 0, 1), TraceConfig()).rho.shape == (0,)
