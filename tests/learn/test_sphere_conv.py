"""Convolutions turn with the panorama, see across the poles, and keep pixels where they are."""

import pytest
import torch

from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError, ShapeError
from torchvo360.learn.sphere_conv import SphericalConv2d, enlarge


@pytest.mark.parametrize(("kernel_size", "stride"), [(1, 1), (3, 1), (5, 1), (2, 2), (4, 2), (6, 2)])
def test_rolling_the_panorama_rolls_the_output(kernel_size, stride):
    torch.manual_seed(0)
    layer = SphericalConv2d(3, 5, kernel_size, stride=stride).double()
    x = torch.randn(2, 3, 8, 16, dtype=torch.float64)
    y = layer(x)
    assert y.shape == (2, 5, 8 // stride, 16 // stride)
    for k in (1, 3, 7):
        torch.testing.assert_close(layer(x.roll(stride * k, -1)), y.roll(k, -1), atol=1e-12, rtol=0)


@pytest.mark.parametrize("row", [0, -1])
def test_a_pixel_at_a_pole_reaches_the_opposite_meridian(row):
    layer = SphericalConv2d(1, 1, 3, bias=False)
    torch.nn.init.ones_(layer.weight)
    x = torch.zeros(1, 1, 6, 12)
    x[0, 0, row, 2] = 1
    touched = (layer(x)[0, 0, row] > 0).nonzero().flatten().tolist()
    assert touched == [1, 2, 3, 7, 8, 9]


@pytest.mark.parametrize(("kernel_size", "stride"), [(3, 1), (4, 2)])
def test_a_symmetric_kernel_shifts_nothing(kernel_size, stride):
    """The mean over a symmetric kernel of a function linear in the pixel's height is that function at the centre."""
    layer = SphericalConv2d(1, 1, kernel_size, stride=stride, bias=False).double()
    torch.nn.init.constant_(layer.weight, 1 / kernel_size**2)
    camera = Equirectangular(32, 16)
    v = camera.pixel_grid(dtype=torch.float64)[..., 1]
    inner = layer(v[None, None])[0, 0, 2:-2]
    smaller = camera.resized(32 // stride, 16 // stride).pixel_grid(dtype=torch.float64)[2:-2, :, 1]
    torch.testing.assert_close(inner, smaller * stride, atol=1e-12, rtol=0)


def test_gradients_are_those_of_finite_differences():
    torch.manual_seed(1)
    layer = SphericalConv2d(2, 2, 4, stride=2).double()
    x = torch.randn(1, 2, 4, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(layer, (x,))
    assert torch.autograd.gradcheck(enlarge, (x,))


def test_enlarging_keeps_the_mean_and_turns_with_the_panorama():
    x = torch.rand(2, 3, 4, 8, dtype=torch.float64)
    double = enlarge(x)
    assert double.shape == (2, 3, 8, 16)
    torch.testing.assert_close(enlarge(x.roll(3, -1)), double.roll(6, -1), atol=1e-12, rtol=0)
    torch.testing.assert_close(enlarge(torch.ones_like(x)), torch.ones_like(double), atol=1e-12, rtol=0)
    torch.testing.assert_close(double.mean((2, 3)), x.mean((2, 3)), atol=1e-12, rtol=0)


@pytest.mark.parametrize(("kernel_size", "stride"), [(2, 1), (3, 2), (1, 2)])
def test_a_kernel_beside_the_pixel_is_refused(kernel_size, stride):
    with pytest.raises(InputError, match="kernel_size, stride: expected"):
        SphericalConv2d(1, 1, kernel_size, stride=stride)


def test_what_is_no_panorama_is_refused():
    layer = SphericalConv2d(1, 1, 3)
    with pytest.raises(InputError, match="even width"):
        layer(torch.zeros(1, 1, 4, 7))
    with pytest.raises(ShapeError, match="features: expected shape"):
        layer(torch.zeros(1, 4, 8))
