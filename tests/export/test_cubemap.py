"""Pinhole images out of panoramas: each pixel shows what lies in its direction."""

import math

import cv2
import numpy as np
import pytest
import torch

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.export.cubemap import ROWS, View, Views

CAMERA = Equirectangular(256, 128)


def painted(camera) -> np.ndarray:
    """Return an image whose colours are a smooth function of the direction alone."""
    ray = torch.nn.functional.normalize(camera.ray_grid(dtype=torch.float64), dim=-1)
    return colours(ray).astype(np.uint8)


def colours(ray: torch.Tensor) -> np.ndarray:
    turned = ray @ torch.tensor([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return (127.5 + 120 * torch.sin(2 * turned + torch.tensor([0.0, 0.5, 1.0]))).round().numpy()


def rays_of(view: View) -> torch.Tensor:
    ray = torch.nn.functional.normalize(view.camera.ray_grid(dtype=torch.float64), dim=-1)
    return ray @ view.T_view_cam[:3, :3]


@pytest.mark.parametrize("fov_deg", [90.0, 100.0])
@pytest.mark.parametrize("faces", [4, 6])
def test_every_pixel_shows_its_direction_across_the_seam_and_the_poles(faces, fov_deg):
    views = Views.of(CAMERA, faces=faces, fov_deg=fov_deg)
    images = views.cut(painted(CAMERA))
    assert len(images) == len(views.views) == faces
    for view, image in zip(views.views, images, strict=True):
        assert image.shape == (view.camera.height, view.camera.width, 3)
        assert image.dtype == np.uint8
        off = np.abs(image.astype(float) - colours(rays_of(view)))
        assert off.max() <= 4, view.name
        assert off.mean() < 0.6, view.name


def test_six_faces_of_90_degrees_show_the_sphere_once():
    views = Views.of(CAMERA)
    ray = torch.nn.functional.normalize(
        torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)).double(), dim=-1
    )
    count = sum(view.camera.project(ray @ view.T_view_cam[:3, :3].mT)[1].int() for view in views.views)
    assert torch.equal(count, torch.ones_like(count))
    area = sum(view.camera.solid_angle(view.camera.pixel_grid(dtype=torch.float64)).sum() for view in views.views)
    assert float(area) == pytest.approx(4 * math.pi, rel=1e-4)


def test_the_turns_are_exact_rotations_and_look_where_their_names_say():
    views = {view.name: view for view in Views.of(CAMERA).views}
    assert list(views) == list(ROWS)
    for view in views.values():
        R = view.T_view_cam[:3, :3]
        assert torch.equal(R @ R.mT, torch.eye(3, dtype=torch.float64))
        assert float(torch.linalg.det(R)) == 1.0
        assert torch.equal(view.T_view_cam[:3, 3], torch.zeros(3, dtype=torch.float64))
    ahead = {name: view.T_view_cam[2, :3].tolist() for name, view in views.items()}
    assert ahead == {
        "front": [0, 0, 1],
        "right": [1, 0, 0],
        "back": [0, 0, -1],
        "left": [-1, 0, 0],
        "up": [0, -1, 0],
        "down": [0, 1, 0],
    }
    for name in ("front", "right", "back", "left"):
        assert views[name].T_view_cam[1, :3].tolist() == [0, 1, 0]  # down stays down


@pytest.mark.parametrize("fov_deg", [90.0, 110.0])
def test_by_default_no_resolution_is_lost_and_little_is_added(fov_deg):
    view = Views.of(Equirectangular(1024, 512), fov_deg=fov_deg).views[0]
    per_radian = 1024 / math.tau
    assert per_radian <= view.camera.fx < per_radian * 1.02
    assert 2 * math.degrees(math.atan(view.camera.width / 2 / view.camera.fx)) == pytest.approx(fov_deg)


def test_smaller_faces_average_instead_of_skipping_pixels():
    columns = np.arange(1024) % 2 * 255  # the finest stripes there are
    image = np.broadcast_to(columns[None, :, None], (512, 1024, 3)).astype(np.uint8)
    front = Views.of(Equirectangular(1024, 512), size=40).cut(image)[0]
    assert 100 < front.min() <= front.max() < 155


def test_edges_lie_where_the_geometry_puts_them():
    """A bright spot one pixel across the seam is found in the back face, on the ray's pixel."""
    image = np.zeros((128, 256, 3), np.uint8)
    image[60:64, :2] = image[60:64, -2:] = 255
    views = Views.of(CAMERA)
    back = cv2.cvtColor(views.cut(image)[2], cv2.COLOR_RGB2GRAY).astype(float)
    v, u = ((back * index).sum() / back.sum() + 0.5 for index in np.indices(back.shape))
    view = views.views[2]
    uv, _ = view.camera.project(CAMERA.ray(torch.tensor([0.0, 62.0]).double()) @ view.T_view_cam[:3, :3].mT)
    np.testing.assert_allclose([u, v], uv.numpy(), atol=0.05)


def test_a_mask_is_cut_with_its_edges_on_the_safe_side():
    usable = torch.ones(128, 256, dtype=torch.bool)
    usable[64:] = False
    views = Views.of(CAMERA)
    masks = dict(zip(ROWS, views.cut_mask(usable), strict=True))
    assert masks["up"].all()
    assert not masks["down"].any()
    half = masks["front"].shape[0] // 2
    assert masks["front"][: half - 1].all()
    assert not masks["front"][half:].any()
    assert all(mask.all() for mask in views.cut_mask(None))


def test_a_pinhole_is_its_own_view():
    camera = Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)
    views = Views.of(camera)
    image = painted(camera)
    assert [view.camera for view in views.views] == [camera]
    assert torch.equal(views.views[0].T_view_cam, torch.eye(4, dtype=torch.float64))
    assert views.cut(image)[0] is image
    mask = torch.rand(48, 64, generator=torch.Generator().manual_seed(0)) > 0.5
    np.testing.assert_array_equal(views.cut_mask(mask)[0], mask.numpy())
    assert views.cut_mask(None)[0].all()


def test_what_a_partial_panorama_does_not_see_is_black_and_masked():
    whole = Equirectangular(256, 128)
    fx, fy, cx, cy = whole.intrinsics
    part = Equirectangular(128, 64, fx, fy, cx - 64, cy - 32)
    views = Views.of(part)
    front, back = (views.cut(np.full((64, 128, 3), 200, np.uint8))[at] for at in (0, 2))
    mask = dict(zip(ROWS, views.cut_mask(None), strict=True))
    assert not back.any()
    assert not mask["back"].any()
    assert mask["front"][front.shape[0] // 2].all()
    assert (front[mask["front"]] == 200).all()
    assert not front[~mask["front"]].any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"faces": 5}, "faces: expected 4 or 6, got 5"),
        ({"fov_deg": 80.0}, "fov: expected a finite number above 90 at most 120, got 80"),
        ({"fov_deg": 170.0}, "fov: expected a finite number above 90 at most 120, got 170"),
        ({"size": 4}, "size: expected an integer from 8 to 8192, got 4"),
    ],
)
def test_settings_that_make_no_cube_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        Views.of(CAMERA, **settings)
