"""The adjustment finds poses, brightness and ranges of rendered worlds, and bad points and images do not disturb it."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from window_scenes import Scene, perturbed, scene

from torchvo360 import lie
from torchvo360.window import Window, WindowConfig

PLACES = (0, 8, 16, 24)
CONFIG = WindowConfig(steps=30, tolerance=1e-6)
FRAMES_MM = 1.5
"""What is reached in room at 256 x 128, over a path of 0.8 m; measured 0.7."""


def errors(window: Window, truth: Scene) -> tuple[float, float]:
    """Largest error of a position in millimetres, after the second keyframe's distance; and of rho, the median."""
    T = torch.stack([frame.T_cam_world for frame in window.frames])
    true = truth.T_cam_world[[frame.key for frame in window.frames]]
    centre, right = (lie.se3_inverse(each)[:, :3, 3] for each in (T, true))
    scale = float(right[1].norm() / centre[1].norm())
    points = window.points
    assert points is not None
    exact = torch.cat([exact_rho(truth, points.pixel[points.host == i], i) for i in range(len(T))])
    off = (points.rho / scale - exact).abs() / exact
    return 1e3 * float((centre * scale - right).norm(dim=1).max()), float(off[exact > 0].median())


def exact_rho(truth: Scene, pixel: Tensor, place: int) -> Tensor:
    length = truth.camera.ray_grid().view(-1, 3)[pixel].norm(dim=-1)
    return 1 / (truth.ranges[place].flatten()[pixel] * length)


def spoiled(seed: int, config: WindowConfig = CONFIG, places: tuple[int, ...] = PLACES, **settings: object) -> Window:
    window = scene(*places, **settings).window(config)
    perturbed(window, seed, 0.01, 0.004, 0.05)
    window.hold_scale()
    return window


@pytest.mark.parametrize(
    ("world", "camera", "millimetres"),
    [("room", "equirectangular", 1.5), ("courtyard", "equirectangular", 4.0), ("room", "pinhole", 4.0)],
)
@pytest.mark.parametrize("seed", range(2))
def test_perturbed_keyframes_and_ranges_come_back(world, camera, millimetres, seed):
    size = {"width": 320, "height": 240} if camera == "pinhole" else {}
    truth = scene(*PLACES, world=world, camera=camera, **size)
    window = truth.window(CONFIG)
    perturbed(window, seed, 0.01, 0.004, 0.05)
    before = errors(window, truth)
    window.hold_scale()
    adjustment = window.optimise()
    after = errors(window, truth)
    assert adjustment.energy_after < 0.7 * adjustment.energy_before
    assert after[0] < millimetres < before[0] / 4
    assert after[1] < 0.03 < before[1]


def test_brightness_is_found():
    truth = scene(*PLACES)
    window = truth.window(CONFIG)
    gains, offsets = (0.25, -0.2, 0.1), (0.02, -0.03, 0.05)
    for place, (a, b) in enumerate(zip(gains, offsets, strict=True), start=1):
        target = window.frames[place].target
        brighter = replace(target, padded=target.padded * torch.tensor(a).exp() + b, saturation=None)
        window.frames[place] = replace(window.frames[place], target=brighter)
        points = window.points
        assert points is not None
        hosted = points.host == place
        points.value[hosted] = points.value[hosted] * torch.tensor(a).exp() + b
    perturbed(window, 0, 0.005, 0.002, 0.02)
    window.hold_scale()
    window.optimise()
    found = torch.stack([frame.affine for frame in window.frames[1:]])
    expected = torch.tensor([gains, offsets], dtype=torch.float64).T
    torch.testing.assert_close(found, expected, atol=0.015, rtol=0)
    assert errors(window, truth)[0] < FRAMES_MM


def test_a_tenth_of_wrong_ranges_is_refused():
    truth = scene(*PLACES)
    window = spoiled(0)
    points = window.points
    assert points is not None
    bad = torch.rand(len(points), generator=torch.Generator().manual_seed(4)) < 0.1
    points.rho = torch.where(bad, points.rho * 4, points.rho)
    window.optimise()
    points = window.points
    assert points is not None
    assert errors(window, truth)[0] < 2 * FRAMES_MM
    assert float(points.inliers[bad].mean()) < 0.6 * float(points.inliers[~bad].mean())


@pytest.mark.parametrize("what", ["black", "elsewhere"])
def test_an_image_that_shows_nothing_of_it_does_not_disturb_the_others(what):
    truth = scene(*PLACES)
    window = spoiled(1)
    last = window.frames[3]
    if what == "black":
        last = replace(last, target=replace(last.target, padded=torch.zeros_like(last.target.padded)))
    else:
        # Masked all over: it sees no point at all.
        nothing = torch.zeros_like(last.target.padded)
        last = replace(last, target=replace(last.target, confidence=nothing))
    window.frames[3] = last
    points = window.points
    assert points is not None
    window.points = points.take((points.host < 3).nonzero()[:, 0])
    window.optimise()
    centre, right = (
        lie.se3_inverse(T)[:3, :3, 3] for T in (torch.stack([f.T_cam_world for f in window.frames]), truth.T_cam_world)
    )
    scale = right[1].norm() / centre[1].norm()
    assert 1e3 * float((centre * scale - right).norm(dim=1).max()) < 2 * FRAMES_MM
    window.drop_frame(3)
    window.optimise()
    assert errors(window, truth)[0] < 2 * FRAMES_MM


def test_without_any_point_nothing_moves():
    window = spoiled(0)
    assert window.points is not None
    window.points = window.points.take(torch.zeros(0, dtype=torch.long))
    before = torch.stack([frame.T_cam_world for frame in window.frames])
    adjustment = window.optimise()
    after = torch.stack([frame.T_cam_world for frame in window.frames])
    torch.testing.assert_close(after, before, atol=1e-9, rtol=0)
    assert adjustment.energy_after <= adjustment.energy_before < 1e-12
    window.drop_frame(0)
    assert len(window.frames) == 3


def test_one_keyframe_with_known_ranges_stays_and_its_ranges_hold_the_unit():
    truth = scene(*PLACES)
    window = Window(CONFIG)
    frame, points = truth.window(CONFIG).frames[0], truth.points(0, 300, CONFIG)
    known = replace(points, information=torch.full_like(points.rho, 1e3))
    window.add_frame(replace(frame, T_first=None, affine_first=None))
    window.add_points(known)
    window.optimise()
    assert window.points is not None
    torch.testing.assert_close(window.points.rho, points.rho, rtol=1e-6, atol=0)
    # No scale is held: the second keyframe starts at nine tenths of its distance and is put right.
    near = lie.se3(truth.T_cam_world[1, :3, :3], 0.9 * truth.T_cam_world[1, :3, 3])
    window.add_frame(replace(truth.window(CONFIG).frames[1], T_cam_world=near, T_first=None, affine_first=None))
    window.optimise()
    length, true = window.frames[1].T_cam_world[:3, 3].norm(), truth.T_cam_world[1, :3, 3].norm()
    assert abs(float(length / true) - 1) < 0.01


def test_points_are_settled_each_for_itself_while_keyframes_stay():
    truth = scene(*PLACES)
    window = truth.window(CONFIG)
    points = window.points
    assert points is not None
    rough = replace(
        points, rho=points.rho * (1 + 0.08 * torch.randn(len(points), generator=torch.Generator().manual_seed(0)))
    )
    settled = window.refine_points(rough, steps=5)
    off, was = ((p.rho / points.rho - 1).abs() for p in (settled, rough))
    assert float(off.median()) < 0.016 < 0.04 < float(was.median())
    assert torch.equal(torch.stack([f.T_cam_world for f in window.frames]), truth.T_cam_world)


def test_equal_windows_come_to_equal_bits():
    first, second = spoiled(3), spoiled(3)
    assert first.optimise() == second.optimise()
    first.drop_frame(0), second.drop_frame(0)
    for a, b in zip(first.frames, second.frames, strict=True):
        assert torch.equal(a.T_cam_world, b.T_cam_world)
    assert first.prior is not None
    assert second.prior is not None
    assert torch.equal(first.prior.H, second.prior.H)
    assert torch.equal(first.points.rho, second.points.rho)
