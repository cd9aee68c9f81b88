"""A padded panorama continues as the sphere does; other images repeat their edge."""

import math

import pytest
import torch

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import InputError, ShapeError
from torchvo360.image import pad_image

SPHERE = Equirectangular(16, 8)
PLANE = Pinhole(12, 7, 9.0, 9.0, 6.0, 3.5)


def noise(*shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(3), dtype=dtype)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)], ids=str)
@pytest.mark.parametrize("margin", [0, 1, 3, 8])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_every_padded_pixel_of_a_panorama_shows_the_same_ray(batch, margin, dtype):
    # The value is a function on the sphere, evaluated beyond the image at the rays of pixels beyond the image.
    def world(u, v):
        lon, lat = (u / 16 - 0.5) * math.tau, (0.5 - v / 8) * math.pi
        x, y, z = lat.cos() * lon.sin(), lat.sin(), lat.cos() * lon.cos()
        return x + 2 * y * z - 0.7 * x * z + y

    def image(margin):
        u = torch.arange(-margin, 16 + margin, dtype=torch.float64) + 0.5
        v = torch.arange(-margin, 8 + margin, dtype=torch.float64) + 0.5
        return world(u, v[:, None]).expand(*batch, -1, -1).to(dtype)

    padded = pad_image(image(0), SPHERE, margin)
    assert padded.dtype == dtype
    torch.testing.assert_close(padded, image(margin), atol=1e-6 if dtype == torch.float32 else 1e-14, rtol=0)


@pytest.mark.parametrize("k", [1, 5, 8, 13])
def test_rolling_a_panorama_commutes_with_padding(k):
    image = noise(2, 8, 16)
    rolled = pad_image(image.roll(k, -1), SPHERE, 2)
    # The inside of a padded image has the period of the panorama.
    expected = pad_image(image, SPHERE, 2)[..., 2:-2].roll(k, -1)
    assert torch.equal(rolled[..., 2:-2], expected)
    assert torch.equal(rolled[..., :2], rolled[..., 16:18])
    assert torch.equal(rolled[..., -2:], rolled[..., 2:4])


def test_a_pole_is_crossed_onto_the_opposite_meridian():
    image = noise(8, 16)
    padded = pad_image(image, SPHERE, 2)
    for column in range(16):
        opposite = (column + 8) % 16
        assert padded[1, column + 2] == image[0, opposite]
        assert padded[0, column + 2] == image[1, opposite]
        assert padded[10, column + 2] == image[7, opposite]
        assert padded[11, column + 2] == image[6, opposite]


@pytest.mark.parametrize("margin", [0, 1, 3])
def test_other_cameras_repeat_their_edge(margin):
    image = noise(2, 3, 7, 12)
    expected = torch.nn.functional.pad(image, [margin] * 4, mode="replicate")
    assert torch.equal(pad_image(image, PLANE, margin), expected)


def test_padding_is_differentiable():
    image = noise(8, 16).requires_grad_()
    pad_image(image, SPHERE, 1).sum().backward()
    # Every value counts once inside, and again wherever it is repeated: 18 x 10 in all.
    assert image.grad is not None
    assert image.grad.sum() == 180
    assert image.grad.min() == 1


def test_bad_input_is_named():
    with pytest.raises(ShapeError, match=r"^image: expected shape \[... 8 16\], got \[8, 15\]\.$"):
        pad_image(noise(8, 15), SPHERE, 1)
    with pytest.raises(InputError, match=r"^margin: expected at most the image's size, got 9\.$"):
        pad_image(noise(8, 16), SPHERE, 9)
    with pytest.raises(InputError, match=r"^image: expected an even width for a full panorama, got 15\.$"):
        pad_image(noise(8, 15), Equirectangular(15, 8), 1)
