"""The feature network sees the sphere, not the image; spreading has the properties that its basin rests on."""

import math

import pytest
import torch
import torch.nn.functional as F

from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError, ShapeError
from torchvo360.learn import FeaturePyramid, checked_features
from torchvo360.learn.features import (
    COARSE,
    PanoramaFeatures,
    align_features,
    feature_alignment,
    pair_features,
    spread,
    spread_matrix,
)
from torchvo360.lie import se3, so3_angle, so3_exp


@pytest.fixture
def network():
    torch.manual_seed(0)
    return PanoramaFeatures().eval()


def test_the_pyramid_is_what_alignment_takes(network):
    maps, confidence = checked_features(network, torch.rand(2, 3, 64, 128))
    assert [tuple(each.shape[1:]) for each in maps] == [
        (4, 64, 128), (6, 32, 64), (8, 16, 32), (8, 8, 16), (8, 8, 16), (8, 8, 16), (8, 8, 16)
    ]  # fmt: skip
    assert all(bool((each > 0).all() and (each <= 1).all()) for each in confidence)


@pytest.mark.parametrize("width", [128, 144, 256])
def test_every_map_has_mean_zero_and_mean_square_one_over_the_sphere(network, width):
    for each in network(torch.rand(1, 3, width // 2, width)).maps:
        camera = Equirectangular(each.shape[-1], each.shape[-2])
        area = camera.solid_angle(camera.pixel_grid())
        torch.testing.assert_close((each * area).sum((2, 3)), torch.zeros(1, each.shape[1]), atol=1e-3, rtol=0)
        torch.testing.assert_close(
            (each.square().mean(1) * area).sum() / area.sum(), torch.tensor(1.0), atol=0.02, rtol=0
        )


def test_turning_the_panorama_turns_every_map(network):
    image = torch.rand(1, 3, 64, 128)
    still, turned = network(image), network(image.roll(8 * 5, -1))
    for before, after in zip(still.maps + still.confidence, turned.maps + turned.confidence, strict=True):
        torch.testing.assert_close(after, before.roll(5 * before.shape[-1] // 16, -1), atol=1e-4, rtol=0)


def test_exposure_hardly_changes_the_features_of_bright_images(network):
    image = 0.2 + 0.3 * torch.rand(1, 3, 64, 128)
    for before, after in zip(network(image).maps, network(2 * image).maps, strict=True):
        assert float((after - before).detach().square().mean()) < 0.02


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_an_image_without_contrast_has_finite_features_and_gradients(network, value):
    image = torch.full((1, 3, 64, 128), value, requires_grad=True)
    maps, _ = network(image)
    sum(each.square().sum() for each in maps).backward()
    assert all(bool(torch.isfinite(each).all()) for each in maps)
    assert bool(torch.isfinite(image.grad).all())


@pytest.mark.parametrize("angle_deg", [15.0, 30.0, 60.0])
def test_spreading_shortens_directions_by_the_factor_of_its_density(angle_deg):
    """A linear function of the ray is an eigenfunction, whatever its direction: spreading commutes with rotations."""
    matrix = spread_matrix(COARSE, math.radians(angle_deg))
    concentration = 1 / math.radians(angle_deg) ** 2
    factor = 1 / math.tanh(concentration) - 1 / concentration
    rays = COARSE.ray_grid().permute(2, 0, 1)[None]
    torch.testing.assert_close(spread(rays, matrix), factor * rays, atol=0.02, rtol=0)
    ones = torch.ones(1, 1, COARSE.height, COARSE.width)
    torch.testing.assert_close(spread(ones, matrix), ones)


def test_a_spread_direction_is_found_again_from_almost_any_rotation():
    """Why the coarse maps are spread: with three directions to match, no rotation is a false minimum."""
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(3, 3, generator=generator)
    true = so3_exp(torch.randn(32, 3, generator=generator, dtype=torch.float64))
    axis = F.normalize(torch.randn(32, 3, generator=generator, dtype=torch.float64), dim=-1)
    rays = COARSE.ray_grid()
    ref, tgt = (
        torch.einsum("hwk,bck->bchw", rays, directions @ R.mT.float()) for R in (torch.eye(3).expand(32, 3, 3), true)
    )
    ones = [torch.ones(32, COARSE.height, COARSE.width)]
    result = align_features(
        FeaturePyramid([ref.contiguous()], ones),
        FeaturePyramid([tgt.contiguous()], ones),
        torch.full((32, COARSE.height, COARSE.width), 0.3),
        T_tgt_ref=se3(so3_exp(axis * math.radians(150)) @ true, torch.zeros(32, 3, dtype=torch.float64)),
    )
    error = so3_angle(result.T_tgt_ref[:, :3, :3] @ true.mT)
    assert float((error < math.radians(5)).double().mean()) > 0.9


@pytest.mark.parametrize("shape", [(1, 3, 32, 64), (1, 3, 64, 130), (1, 3, 65, 130), (1, 3, 64, 64)])
def test_an_image_that_does_not_fit_is_refused_in_one_sentence(network, shape):
    with pytest.raises(InputError, match=r"image: expected a panorama of W x W/2 pixels .*, got \d+ x \d+\.$"):
        network(torch.rand(shape))


def test_other_numbers_of_channels_are_refused(network):
    with pytest.raises(ShapeError, match="image: expected shape"):
        network(torch.rand(1, 1, 64, 128))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"widths": (16, 24)}, "widths, channels"),
        ({"widths": (6, 24, 32, 48)}, "widths, channels"),
        ({"channels": (0, 1, 2, 3)}, "channels: expected 1 to 1024 each"),
        ({"spread_deg": (2.0,)}, "spread_deg"),
    ],
)
def test_impossible_networks_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        PanoramaFeatures(**arguments)


def test_the_pose_error_reaches_every_parameter(network):
    torch.manual_seed(2)
    ref = F.avg_pool2d(torch.rand(2, 3, 64, 128), 5, 1, 2)
    features = pair_features(network, ref, ref.roll(1, -1))
    settings = feature_alignment(backward="unroll", steps_by_level=[2])
    result = align_features(*features, torch.full((2, 64, 128), 0.5), config=settings, outputs=("history",))
    sum(level.T_tgt_ref.square().sum() for level in result.history).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name
        assert bool((parameter.grad != 0).any()), name


def test_turned_panoramas_align_by_features_of_an_untrained_network(network):
    torch.manual_seed(3)
    ref = F.avg_pool2d(torch.rand(1, 3, 64, 128), 9, 1, 4)
    result = align_features(*pair_features(network, ref, ref.roll(16, -1)), torch.full((1, 64, 128), 0.3))
    yaw = math.tau / 8
    expected = so3_exp(torch.tensor([0.0, yaw, 0.0], dtype=torch.float64))
    torch.testing.assert_close(result.T_tgt_ref[0, :3, :3], expected, atol=5e-3, rtol=0)
