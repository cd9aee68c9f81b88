"""A linearisation that is kept open gives the answers of `linearize`."""

import pytest
import torch

from torchvo360 import Equirectangular, Pinhole, lie
from torchvo360.backends import OpenLinearization, linearize
from torchvo360.cameras import Camera
from torchvo360.residuals.direct import Reference, Target, make_target
from torchvo360.residuals.weights import LossConfig

CAMERAS = [Equirectangular(64, 32), Pinhole(48, 36, 40.0, 38.0, 23.5, 18.2)]


def problem(camera: Camera, channels: int, *, variance: bool) -> tuple[Reference, Target, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(4)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    N = camera.width * camera.height
    reference = Reference(
        ray=camera.ray_grid(dtype=torch.float64).permute(2, 0, 1).reshape(1, 3, -1),
        rho=rand(3, N),
        value=rand(3, channels, N),
        weight=rand(3, N),
        variance=0.1 * rand(3, N) if variance else None,
    )
    size = camera.height, camera.width
    target = make_target(rand(3, channels, *size), camera, rand(3, *size), saturation=0.97)
    T = lie.se3_exp(0.1 * (rand(3, 6) - 0.5))
    return reference, target, T, 0.2 * (rand(3, 2) - 0.5)


@pytest.mark.parametrize("camera", CAMERAS, ids=["sphere", "pinhole"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("variance", [False, True])
@pytest.mark.parametrize("loss", ["huber", "student_t", "none"])
def test_its_matrix_gradient_and_pull_are_those_of_linearize(camera, channels, variance, loss):
    reference, target, T, affine = problem(camera, channels, variance=variance)
    config = LossConfig(name=loss, scale=0.1)
    expected = linearize(reference, target, T, affine, config, noise=0.05)
    at = OpenLinearization.at(reference, target, T, affine, config, 0.05)
    torch.testing.assert_close(at.matrix(), expected.H, rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(at.gradient(), expected.g, rtol=1e-10, atol=1e-9)
    direction = torch.randn(3, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(at.pull(direction), (expected.g * direction).sum(-1), rtol=1e-10, atol=1e-9)


def test_float32_sums_lose_nothing():
    reference, target, T, affine = problem(CAMERAS[0], 1, variance=False)
    truth = OpenLinearization.at(reference, target, T, affine, LossConfig(scale=0.1), 0.05).gradient()
    single = Reference(reference.ray.float(), reference.rho.float(), reference.value.float(), reference.weight.float())
    images = make_target(target.padded[..., 1:-1, 1:-1].float(), target.camera, None, None)
    images = Target(images.camera, images.padded, target.confidence.float(), 0.97)
    found = OpenLinearization.at(single, images, T, affine, LossConfig(scale=0.1), 0.05)
    assert found.gradient().dtype == found.matrix().dtype == torch.float64
    assert float((found.gradient() - truth).norm() / truth.norm()) < 1e-4
