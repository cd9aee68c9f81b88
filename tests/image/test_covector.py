"""The covector field is the gradient of a function on the sphere, or on the plane, along the rays."""

import math

import pytest
import torch
from torch.func import jacrev, vmap

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.image import covector_field, gradient, gradient_magnitude

SPHERE = Equirectangular(256, 128)
PLANE = Pinhole(160, 120, 90.0, 85.0, 78.0, 61.5)
CAMERAS = pytest.mark.parametrize("camera", [SPHERE, PLANE], ids=["sphere", "pinhole"])


def world(ray: torch.Tensor) -> torch.Tensor:
    """A smooth function of the direction, whatever the ray's length."""
    x, y, z = (ray / ray.norm()).unbind(-1)
    return torch.sin(3 * x + 1) + torch.cos(2 * y - z) + 0.5 * x * z + y * y * z


def image_of(camera) -> torch.Tensor:
    return vmap(vmap(world))(camera.ray_grid(dtype=torch.float64))


@CAMERAS
def test_the_field_is_the_functions_own_gradient_on_the_rays(camera):
    rays = camera.ray_grid(dtype=torch.float64)
    field = covector_field(image_of(camera), camera).permute(1, 2, 0)
    truth = vmap(vmap(jacrev(world)))(rays)
    scale = truth.norm(dim=-1).max()
    inside = (slice(None), slice(None)) if camera.wraps else (slice(1, -1), slice(1, -1))
    if camera.wraps:
        # Central differences over three pixels: beside a pole these span too many degrees of longitude.
        inside = (slice(6, -6), slice(None))
    torch.testing.assert_close(field[inside], truth[inside], atol=float(4e-3 * scale), rtol=0)


@CAMERAS
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)], ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_the_field_is_orthogonal_to_the_rays_and_finite(camera, batch, dtype):
    image = torch.rand(*batch, camera.height, camera.width, generator=torch.Generator().manual_seed(0)).to(dtype)
    field = covector_field(image, camera)
    assert field.shape == (*batch, 3, camera.height, camera.width)
    assert field.dtype == dtype
    assert torch.isfinite(field).all()
    along = (field * camera.ray_grid(dtype=dtype).permute(2, 0, 1)).sum(-3)
    bound = field.norm(dim=-3) * (1e-5 if dtype == torch.float32 else 1e-12) + 1e-9
    assert (along.abs() <= bound).all()


@pytest.mark.parametrize("k", [1, 40, 128])
def test_rolling_a_panorama_turns_its_field_about_the_vertical(k):
    angle = torch.tensor(k * math.tau / 256, dtype=torch.float64)
    c, s, o, i = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    R = torch.stack([c, o, s, o, i, o, -s, o, c]).view(3, 3)
    image = image_of(SPHERE)
    turned = covector_field(image.roll(k, -1), SPHERE)
    expected = torch.einsum("ij,jhw->ihw", R, covector_field(image, SPHERE)).roll(k, -1)
    torch.testing.assert_close(turned, expected, atol=1e-10, rtol=0)


def test_central_differences_go_around_the_seam_and_over_the_poles():
    image = torch.rand(8, 16, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    camera = Equirectangular(16, 8)
    g_u, g_v = gradient(image, camera)
    for column in range(16):
        right, left, opposite = (column + 1) % 16, (column - 1) % 16, (column + 8) % 16
        torch.testing.assert_close(g_u[3, column], (image[3, right] - image[3, left]) / 2)
        torch.testing.assert_close(g_v[0, column], (image[1, column] - image[0, opposite]) / 2)
        torch.testing.assert_close(g_v[7, column], (image[7, opposite] - image[6, column]) / 2)


def test_edges_of_equal_strength_are_equal_at_every_latitude():
    # Stripes across longitude whose spacing on the sphere is the same: a stripe along meridians would widen.
    lat = (0.5 - (torch.arange(128, dtype=torch.float64) + 0.5) / 128) * math.pi
    image = torch.sin(20 * lat)[:, None].expand(128, 256)
    magnitude = gradient_magnitude(image, SPHERE)
    # |d sin(20 lat)| = 20 |cos(20 lat)|, per pixel of pi / 128; central differences shorten it by sin(h) / h.
    step = 20 * math.pi / 128
    expected = torch.cos(20 * lat).abs() * math.sin(step)
    torch.testing.assert_close(magnitude[2:-2, 7], expected[2:-2], atol=1e-9, rtol=0)
