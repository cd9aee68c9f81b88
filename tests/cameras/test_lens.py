"""Lenses: the projection is OpenCV's, its inverse comes back, and what lies beyond the fold is not seen."""

import math

import cv2
import numpy as np
import pytest
import torch

from torchvo360.cameras import Lens
from torchvo360.checks import InputError, ShapeError

K = (458.654, 457.296, 367.215, 248.375)
EUROC = Lens.of_opencv(752, 480, K, "radtan", (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))
TUM = Lens.of_opencv(640, 480, (517.3, 516.5, 318.6, 255.3), "radtan", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
SKEWED = Lens.of_opencv(640, 480, (400.0, -410.0, 330.0, 228.0), "radtan", (0.08, 0.02, 0.02, -0.015))
FISHEYE = Lens.of_opencv(
    1024, 1024, (310.0, 308.0, 514.0, 509.0), "equidistant", (-0.0134, 0.0023, -0.0021, 0.0004)
)  # 188 degrees across
PLAIN = Lens.of_opencv(640, 480, (500.0, 480.0, 320.0, 240.0))
LENSES = {"euroc": EUROC, "tum": TUM, "skewed": SKEWED, "fisheye": FISHEYE, "plain": PLAIN}
PLANE = {name: lens for name, lens in LENSES.items() if lens.model != "equidistant"}


def opencv_matrix(lens: Lens) -> np.ndarray:
    """Return OpenCV's camera matrix, whose pixel centres are at integers."""
    return np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])


def directions(most_deg: float, count: int = 500) -> torch.Tensor:
    """Return unit rays up to an angle from the axis, the axis among them."""
    generator = torch.Generator().manual_seed(0)
    theta = math.radians(most_deg) * torch.rand(count, generator=generator, dtype=torch.float64).sqrt()
    phi = math.tau * torch.rand(count, generator=generator, dtype=torch.float64)
    theta[0] = 0
    return torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)


@pytest.mark.parametrize("name", PLANE)
def test_the_pixels_are_opencvs_half_a_pixel_on(name):
    lens = PLANE[name]
    rays = directions(40) * torch.linspace(0.5, 5, 500, dtype=torch.float64)[:, None]
    expected, _ = cv2.projectPoints(
        rays.numpy(), np.zeros(3), np.zeros(3), opencv_matrix(lens), np.array(lens.distortion or (0.0,) * 4)
    )
    uv, _ = lens.project(rays)
    np.testing.assert_allclose(uv.numpy(), expected[:, 0] + 0.5, atol=1e-9)


def test_a_fisheyes_pixels_are_opencvs_half_a_pixel_on():
    rays = directions(89)
    expected, _ = cv2.fisheye.projectPoints(
        rays.numpy()[:, None], np.zeros(3), np.zeros(3), opencv_matrix(FISHEYE), np.array(FISHEYE.distortion)
    )
    uv, valid = FISHEYE.project(rays)
    assert bool(valid.all())
    np.testing.assert_allclose(uv.numpy(), expected[:, 0] + 0.5, atol=1e-9)


def test_a_fisheye_sees_beyond_the_half_space_continuously():
    theta = torch.linspace(85, 95, 11, dtype=torch.float64).deg2rad()
    rays = torch.stack([theta.sin(), torch.zeros_like(theta), theta.cos()], -1)
    uv, valid = FISHEYE.project(rays)
    step = uv[:, 0].diff()
    assert bool((step > 0).all())
    assert float(step.diff().abs().max()) < 0.2
    assert bool(valid[theta.rad2deg() < 92].all())
    assert not bool(FISHEYE.project(torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64))[1])


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
@pytest.mark.parametrize("name", LENSES)
def test_every_pixel_comes_back(name, shape):
    lens = LENSES[name]
    generator = torch.Generator().manual_seed(1)
    size = torch.tensor([lens.width, lens.height], dtype=torch.float64)
    uv = torch.rand(*shape, 2, generator=generator, dtype=torch.float64) * size
    ray, valid = lens.ray(uv)
    assert ray.shape == (*shape, 3)
    assert valid.shape == shape
    torch.testing.assert_close(torch.linalg.vector_norm(ray, dim=-1), torch.ones(shape, dtype=torch.float64))
    again, seen = lens.project(ray)
    torch.testing.assert_close(torch.where(valid[..., None], again, uv), uv, atol=1e-6, rtol=0)
    torch.testing.assert_close(seen, valid)


@pytest.mark.parametrize("name", LENSES)
def test_the_whole_image_has_rays_up_to_its_corners(name):
    lens = LENSES[name]
    v, u = torch.meshgrid(torch.linspace(0, lens.height, 25), torch.linspace(0, lens.width, 33), indexing="ij")
    _, valid = lens.ray(torch.stack([u, v], -1).double())
    assert bool(valid.all())


@pytest.mark.parametrize("name", LENSES)
def test_rays_come_back_in_the_precision_they_are_given_in(name):
    rays = directions(30)
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 1e-5)):
        uv, _ = LENSES[name].project(rays.to(dtype))
        ray, valid = LENSES[name].ray(uv)
        assert uv.dtype == ray.dtype == dtype
        assert bool(valid.all())
        torch.testing.assert_close(ray, rays.to(dtype), atol=tolerance, rtol=0)


def test_the_axis_is_the_principal_point_with_finite_gradients():
    for lens in LENSES.values():
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        J = torch.autograd.functional.jacobian(lambda ray, lens=lens: lens.project(ray)[0], axis)
        torch.testing.assert_close(lens.project(axis)[0], axis.new_tensor([lens.cx, lens.cy]))
        torch.testing.assert_close(lens.ray(axis.new_tensor([lens.cx, lens.cy]))[0], axis)
        assert isinstance(J, torch.Tensor)
        assert bool(torch.isfinite(J).all())


def test_beyond_the_fold_nothing_is_seen_and_pixels_there_have_no_ray():
    barrel = Lens(640, 480, 300.0, 300.0, 320.0, 240.0, "radtan", (-0.3, 0.0, 0.0, 0.0))
    fold = 1 / math.sqrt(0.9)  # 1 + 3 k1 r^2 = 0
    assert barrel.limit == pytest.approx(fold)
    slope = torch.tensor([0.5, 0.99, 1.01, 1.5, 1.8], dtype=torch.float64) * fold
    rays = torch.stack([slope, torch.zeros_like(slope), torch.ones_like(slope)], -1)
    uv, valid = barrel.project(rays)
    assert valid.tolist() == [True, True, False, False, False]
    assert bool(((uv >= 0) & (uv <= 640)).all()), "they do come out inside the image, where they must not be taken"
    farthest = 300 * fold * (1 - 0.3 * fold**2)
    u = 320 + farthest + torch.tensor([-1.0, -1e-3, 1e-3, 50.0], dtype=torch.float64)
    ray, valid = barrel.ray(torch.stack([u, torch.full_like(u, 240)], -1))
    assert valid.tolist() == [True, True, False, False]
    assert bool(torch.isfinite(ray).all())


def test_a_fisheyes_fold_ends_its_view():
    folding = Lens(800, 800, 300.0, 300.0, 400.0, 400.0, "equidistant", (-0.1, 0.0, 0.0, 0.0))
    fold = 1 / math.sqrt(0.3)  # 1 + 3 k1 theta^2 = 0, at 105 degrees
    assert folding.limit == pytest.approx(fold)
    theta = torch.tensor([0.5, 0.98, 1.02], dtype=torch.float64) * fold
    uv, valid = folding.project(torch.stack([torch.zeros_like(theta), theta.sin(), theta.cos()], -1))
    assert valid.tolist() == [True, True, False]
    assert bool((uv <= 800).all())
    _, found = folding.ray(torch.tensor([[400.0, 764.0], [400.0, 770.0]], dtype=torch.float64))
    assert found.tolist() == [True, False]


def test_points_behind_and_beside_the_lens_are_not_seen():
    rays = torch.tensor([[0.1, 0.0, -1.0], [0.0, 0.0, -1.0], [0.3, 0.2, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    for lens in LENSES.values():
        uv, valid = lens.project(rays)
        assert not bool(valid[[0, 1, 3]].any())
        assert bool(torch.isfinite(uv).all())
    for lens in PLANE.values():
        assert not bool(lens.project(rays)[1].any())


@pytest.mark.parametrize("name", LENSES)
def test_a_resized_image_has_the_same_rays(name):
    lens = LENSES[name]
    rays = directions(25)
    small = lens.resized(lens.width // 2, lens.height // 2)
    torch.testing.assert_close(small.project(rays)[0] * 2, lens.project(rays)[0])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"fx": 0.0}, "fx: expected a focal length other than zero, got 0"),
        ({"cy": math.nan}, "cy: expected a finite number, got nan"),
        ({"width": 0}, "width: expected a positive integer, got 0"),
        ({"model": "omni"}, "model: expected one of none, radtan, equidistant, got 'omni'"),
        ({"distortion": (0.1,) * 3}, "distortion: expected 4 or 5 numbers for radtan, got 3"),
        ({"model": "equidistant", "distortion": (0.1,) * 5}, "distortion: expected 4 numbers for equidistant, got 5"),
        ({"distortion": (0.1, math.inf, 0, 0)}, "distortion, number 2: expected a finite number, got inf"),
    ],
)
def test_an_impossible_lens_is_refused(changed, message):
    usual = {"width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0, "model": "radtan"}
    with pytest.raises(InputError, match=f"^{message}\\.$"):
        Lens(**{**usual, "distortion": (0.1, 0, 0, 0), **changed})
    with pytest.raises(ShapeError):
        PLAIN.project(torch.zeros(2))


@pytest.mark.parametrize("focal", [1e-9, -1.0])
def test_a_calibration_of_an_impossible_angle_is_refused(focal):
    with pytest.raises(
        InputError, match=rf"^fy: expected at least 0\.02 of the image's height, got {focal:g} pixels\.$"
    ):
        Lens.of_opencv(320, 200, (160.0, focal, 160.0, 100.0))
