"""The range network turns with the panorama, keeps its answers finite, and is held to exact losses."""

import math

import pytest
import torch

from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError, ShapeError
from torchvo360.data.synthetic import sample_pairs
from torchvo360.learn.checkpoint import load_checkpoint, save_checkpoint
from torchvo360.learn.depth import PanoramaDepth
from torchvo360.learn.plugin import checked_ranges
from torchvo360.learn.range_losses import (
    FAR_RHO,
    dissimilarity,
    laplace_loss,
    log_error,
    roughness,
    sphere_mean,
    warped,
)

CAMERA = Equirectangular(64, 32)


@pytest.fixture(scope="module")
def network() -> PanoramaDepth:
    """A small network whose every layer speaks."""
    torch.manual_seed(0)
    network = PanoramaDepth(64, (8, 16))
    torch.nn.init.normal_(network.exit.weight, std=0.1)
    return network.eval()


@pytest.fixture(scope="module")
def image() -> torch.Tensor:
    return sample_pairs(2, seed=1, width=64, height=32).ref


@pytest.mark.parametrize("columns", [8, 32, 56])
def test_turning_the_panorama_turns_the_ranges(network, image, columns):
    rho, variance = network(image)
    turned = network(image.roll(columns, -1))
    torch.testing.assert_close(turned.rho, rho.roll(columns, -1), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(turned.variance, variance.roll(columns, -1), rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("size", [(32, 64), (64, 128), (128, 256), (48, 96), (16, 32), (50, 100)])
def test_ranges_come_in_the_images_size(network, size):
    estimate = checked_ranges(network, torch.rand(1, 3, *size))
    assert estimate.rho.shape == (1, *size)


def test_a_larger_image_of_the_same_scene_has_the_same_ranges(network, image):
    large = image.repeat_interleave(4, -1).repeat_interleave(4, -2)
    rho = network(large).rho.unflatten(-1, (64, 4)).unflatten(1, (32, 4)).mean((2, 4))
    torch.testing.assert_close(rho, network(image).rho, rtol=0.1, atol=0.03)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_an_image_without_content_has_finite_ranges(network, value):
    checked_ranges(network, torch.full((1, 3, 32, 64), value))


def test_exposure_says_nothing_of_range(network, image):
    torch.testing.assert_close(network(image * 0.5 + 0.1).rho, network(image).rho, rtol=0.1, atol=0)


def test_one_image_of_a_batch_does_not_touch_another(network, image):
    both, alone = network(image).rho, network(image[:1]).rho
    torch.testing.assert_close(both[:1], alone, rtol=1e-5, atol=1e-6)


def test_float64_images_have_float64_ranges(network, image):
    assert network(image.double()).rho.dtype == torch.float64


def test_gradients_reach_every_parameter(image):
    torch.manual_seed(0)
    network = PanoramaDepth(64, (8, 16))
    torch.nn.init.normal_(network.exit.weight, std=0.1)
    rho, variance = network(image)
    (rho.mean() + variance.mean()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert float(parameter.grad.abs().max()) > 0, name


def test_a_new_network_says_three_metres_unsurely(image):
    rho, variance = PanoramaDepth(64, (8, 16))(image)
    torch.testing.assert_close(1 / rho, torch.full_like(rho, 3.0), rtol=0.01, atol=0)
    assert bool((variance > 0.05 * rho.square()).all())


def test_images_that_are_no_panoramas_are_refused(network):
    with pytest.raises(InputError, match="twice as wide as high, got 40 x 32"):
        network(torch.rand(1, 3, 32, 40))
    with pytest.raises(ShapeError, match="image"):
        network(torch.rand(1, 1, 32, 64))


@pytest.mark.parametrize(
    ("width", "channels", "name"), [(100, (8, 8), "width"), (64, (8, 12), "channels"), (64, (), "channels")]
)
def test_sizes_that_make_no_network_are_refused(width, channels, name):
    with pytest.raises(InputError, match=f"^{name}: expected"):
        PanoramaDepth(width, channels)


def test_a_checkpoint_makes_the_same_network_again(network, image, tmp_path):
    config = {"_target_": "torchvo360.learn.depth.PanoramaDepth", "width": 64, "channels": [8, 16]}
    save_checkpoint(tmp_path / "depth", network, config)
    assert torch.equal(load_checkpoint(tmp_path / "depth.safetensors")(image).rho, network(image).rho)


# Losses


@pytest.fixture(scope="module")
def pairs():
    return sample_pairs(3, seed=2, width=128, height=64, affine=False)


def test_through_its_true_range_and_pose_the_target_looks_like_the_reference(pairs):
    seen = warped(pairs.tgt, pairs.rho, pairs.T_tgt_ref_true, pairs.camera)
    unlike = sphere_mean(dissimilarity(pairs.ref, seen, pairs.camera), pairs.camera)
    before = sphere_mean(dissimilarity(pairs.ref, pairs.tgt, pairs.camera), pairs.camera)
    assert bool((unlike < before).all())
    assert float(unlike.mean()) < 0.25 * float(before.mean())


@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_wrong_ranges_look_less_alike_than_true_ones(pairs, factor):
    def unlike(rho):
        seen = warped(pairs.tgt, rho, pairs.T_tgt_ref_true, pairs.camera)
        return sphere_mean(dissimilarity(pairs.ref, seen, pairs.camera), pairs.camera)

    assert bool((unlike(pairs.rho * factor) > unlike(pairs.rho)).all())


def test_range_and_translation_fix_each_other_only_up_to_a_factor(pairs):
    T = pairs.T_tgt_ref_true.clone()
    T[:, :3, 3] /= 2
    twice = warped(pairs.tgt, 2 * pairs.rho, T, pairs.camera)
    torch.testing.assert_close(
        twice, warped(pairs.tgt, pairs.rho, pairs.T_tgt_ref_true, pairs.camera), rtol=0, atol=1e-3
    )


def test_the_warp_has_exact_gradients():
    torch.manual_seed(3)
    camera = Equirectangular(16, 8)
    tgt = torch.rand(1, 2, 8, 16, dtype=torch.float64, requires_grad=True)
    rho = (0.2 + torch.rand(1, 8, 16, dtype=torch.float64)).requires_grad_()
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[:, :3, 3] = torch.tensor([0.11, -0.07, 0.13])
    T.requires_grad_()
    assert torch.autograd.gradcheck(lambda *inputs: warped(*inputs, camera), (tgt, rho, T), eps=1e-7, atol=1e-5)


def test_an_image_is_not_unlike_itself(image):
    torch.testing.assert_close(dissimilarity(image, image, CAMERA), torch.zeros(2, 32, 64), rtol=0, atol=1e-5)


def test_the_mean_over_the_sphere_counts_by_solid_angle():
    torch.testing.assert_close(sphere_mean(torch.ones(1, 32, 64), CAMERA), torch.ones(1))
    # The mean of y^2 over the sphere is a third, which rows of equal weight would miss.
    y = CAMERA.ray_grid()[None, ..., 1]
    torch.testing.assert_close(sphere_mean(y.square(), CAMERA), torch.tensor([1 / 3]), rtol=1e-2, atol=0)


def test_the_mean_over_nothing_is_zero_and_has_no_nan():
    value = torch.full((1, 32, 64), torch.nan)
    assert float(sphere_mean(value, CAMERA, torch.zeros(1, 32, 64, dtype=torch.bool))) == 0


def test_the_likelihood_is_best_at_the_errors_own_scale():
    error = torch.distributions.Laplace(0.0, 0.2).sample((1, 32, 64))
    losses = {s: float(laplace_loss(error, torch.full_like(error, math.log(s)), CAMERA)) for s in (0.1, 0.2, 0.4)}
    assert losses[0.2] == min(losses.values())


def test_the_sky_is_far_and_has_no_range():
    rho_true = torch.tensor([[[0.0, 0.5]]])
    error, known = log_error(torch.tensor([[[math.log(FAR_RHO), math.log(0.5)]]]), rho_true)
    torch.testing.assert_close(error, torch.zeros(1, 1, 2), rtol=0, atol=1e-6)
    assert known.tolist() == [[[False, True]]]


def test_range_edges_cost_less_where_the_image_has_edges():
    log_rho = torch.zeros(1, 32, 64)
    log_rho[..., 16:48] = 1.0
    edge, flat = log_rho[:, None].expand(-1, 3, -1, -1), torch.zeros(1, 3, 32, 64)
    assert float(roughness(log_rho, edge, CAMERA)) < 0.1 * float(roughness(log_rho, flat, CAMERA))
    assert float(roughness(torch.zeros_like(log_rho), flat, CAMERA)) == 0
