"""Look-ups agree with plain oracles, wrap as the sphere does and carry the interpolant's own derivative."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.func import jacfwd, vmap

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import ShapeError
from torchvo360.image import interpolate, locate, pad_image, sample

SPHERE = Equirectangular(16, 8)
PLANE = Pinhole(12, 7, 9.0, 9.0, 6.0, 3.5)
CAMERAS = pytest.mark.parametrize("camera", [SPHERE, PLANE], ids=["sphere", "pinhole"])
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def pixels(camera, *shape: int) -> torch.Tensor:
    """Random pixels over the whole image, its edges included."""
    uv = noise(*shape, 2, seed=1) * torch.tensor([camera.width, camera.height])
    special = [(0.0, 0.0), (camera.width, camera.height), (0.5, 0.5), (camera.width - 1e-3, 3.0), (1e-3, 3.0)]
    uv.view(-1, 2)[: len(special)] = torch.tensor(special, dtype=torch.float64)
    return uv


def bilinear(image: np.ndarray, u: float, v: float, wraps: bool) -> float:
    """One value by the textbook: four neighbours, fetched one by one through the topology of the image."""
    height, width = image.shape

    def fetch(row: int, column: int) -> float:
        if not wraps:
            return image[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
        if row < 0:
            row, column = -1 - row, column + width // 2
        elif row >= height:
            row, column = 2 * height - 1 - row, column + width // 2
        return image[row, column % width]

    left, top = math.floor(u - 0.5), math.floor(v - 0.5)
    across, down = u - 0.5 - left, v - 0.5 - top
    upper = (1 - across) * fetch(top, left) + across * fetch(top, left + 1)
    lower = (1 - across) * fetch(top + 1, left) + across * fetch(top + 1, left + 1)
    return (1 - down) * upper + down * lower


@CAMERAS
@DTYPES
@pytest.mark.parametrize("points", [(5,), (40,), (4, 6)], ids=str)
def test_sample_equals_the_textbook(camera, dtype, points):
    image, uv = noise(2, 3, camera.height, camera.width), pixels(camera, 2, *points)
    expected = [
        [
            [bilinear(image[b, c].numpy(), p[0], p[1], camera.wraps) for p in uv[b].view(-1, 2).tolist()]
            for c in range(3)
        ]
        for b in range(2)
    ]
    actual = sample(image.to(dtype), uv.to(dtype), camera)
    assert actual.shape == (2, 3, *points)
    tolerance = 5e-6 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(
        actual.double(), torch.tensor(expected, dtype=torch.float64).view(2, 3, *points), atol=tolerance, rtol=0
    )


@CAMERAS
@DTYPES
@pytest.mark.parametrize("channels", [1, 3])
def test_interpolate_equals_sample_and_grid_sample(camera, dtype, channels):
    image, uv = noise(2, channels, camera.height, camera.width), pixels(camera, 2, 60)
    u, v = uv.to(dtype).unbind(-1)
    value = interpolate(pad_image(image.to(dtype), camera, 1).contiguous(), locate(u, v, camera)).value
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(value.double(), sample(image, uv, camera), atol=tolerance, rtol=0)
    inside = ((uv > 0.5) & (uv < torch.tensor([camera.width, camera.height]) - 0.5)).all(-1)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    plain = F.grid_sample(image, (2 * uv / size - 1)[:, None], align_corners=False)[:, :, 0]
    torch.testing.assert_close(
        value.double().transpose(1, 2)[inside], plain.transpose(1, 2)[inside], atol=tolerance, rtol=0
    )


@pytest.mark.parametrize("k", [1, 5, 8, -3])
def test_rolling_a_panorama_moves_its_samples(k):
    image, uv = noise(1, 1, 8, 16), pixels(SPHERE, 1, 60)
    moved = uv + torch.tensor([float(k), 0.0])
    expected = sample(image, uv, SPHERE)
    torch.testing.assert_close(sample(image.roll(k, -1), moved, SPHERE), expected, atol=1e-12, rtol=0)
    torch.testing.assert_close(sample(image, uv + torch.tensor([32.0, 0.0]), SPHERE), expected, atol=1e-12, rtol=0)


@CAMERAS
@pytest.mark.parametrize("channels", [1, 2])
def test_the_slope_is_the_derivative_of_the_value(camera, channels):
    padded = pad_image(noise(1, channels, camera.height, camera.width), camera, 1).contiguous()
    uv = pixels(camera, 40)[5:]

    def value(point):
        return interpolate(padded, locate(point[None, :1], point[None, 1:], camera)).value[0, :, 0]

    result = interpolate(padded, locate(uv[None, :, 0], uv[None, :, 1], camera))
    J_value_uv = vmap(jacfwd(value))(uv)
    torch.testing.assert_close(result.g_u[0], J_value_uv[..., 0].T, atol=1e-12, rtol=0)
    torch.testing.assert_close(result.g_v[0], J_value_uv[..., 1].T, atol=1e-12, rtol=0)
    # Finite differences inside one cell are exact along an axis.
    step = 1e-4
    inside = (((uv - 0.5) % 1 > 2 * step) & ((uv - 0.5) % 1 < 1 - 2 * step)).all(-1)
    assert inside.sum() > 30
    for axis, slope in ((0, result.g_u), (1, result.g_v)):
        shift = torch.zeros(2, dtype=torch.float64)
        shift[axis] = step
        difference = (vmap(value)(uv + shift) - vmap(value)(uv - shift)) / (2 * step)
        torch.testing.assert_close(slope[0].T[inside], difference[inside], atol=1e-9, rtol=0)


def test_backward_through_the_value_gives_the_same_slope():
    padded = pad_image(noise(2, 1, 8, 16), SPHERE, 1).contiguous()
    uv = pixels(SPHERE, 2, 50)[:, 5:].requires_grad_()
    result = interpolate(padded, locate(uv[..., 0], uv[..., 1], SPHERE))
    (gradient,) = torch.autograd.grad(result.value.sum(), uv)
    torch.testing.assert_close(gradient, torch.stack([result.g_u[:, 0], result.g_v[:, 0]], -1), atol=1e-12, rtol=0)


@CAMERAS
@DTYPES
@given(
    u=st.floats(allow_nan=False, allow_infinity=True, width=32),
    v=st.floats(allow_nan=False, allow_infinity=True, width=32),
)
@settings(max_examples=200, deadline=None)
def test_no_pixel_leaves_the_padded_image(camera, dtype, u, v):
    # As many images as make the float32 index round, did it not go through integers.
    for count in (1, 3):
        at = torch.tensor([[u], [v]], dtype=dtype)
        taps = locate(at[:1].expand(count, 1), at[1:].expand(count, 1), camera)
        area = (camera.height + 2) * (camera.width + 2)
        assert (taps.corner[:, 0] - torch.arange(count) * area >= 0).all()
        assert (taps.corner[:, 0] + taps.pitch + 1 - torch.arange(count) * area < area).all()
        assert ((taps.across >= 0) & (taps.across <= 1) & (taps.down >= 0) & (taps.down <= 1)).all()


def test_large_images_are_indexed_exactly():
    camera = Equirectangular(8192, 4096)
    u = torch.tensor([[0.5, 8191.5, 8190.5, 3.5]])
    v = torch.tensor([[4095.5, 4095.5, 4094.5, 0.5]])
    row, column = v.long() + 1, u.long() + 1
    assert torch.equal(locate(u, v, camera).corner, row * 8194 + column)


def test_bad_input_is_named():
    with pytest.raises(ShapeError, match=r"^image: expected shape \[B C 8 16\], got \[1, 8, 16\]\.$"):
        sample(noise(1, 8, 16), noise(1, 5, 2), SPHERE)
    with pytest.raises(ShapeError, match=r"^uv: expected shape"):
        sample(noise(1, 1, 8, 16), noise(1, 5, 3), SPHERE)
