"""Agreement tells true alignments from false ones at any exposure, and is 0 where there is nothing to tell by."""

from dataclasses import replace

import pytest
import torch

from torchvo360 import lie
from torchvo360.agreement import TOLERANCE_PX, agreeing_share
from torchvo360.backends import compare
from torchvo360.data.synthetic import Pairs, sample_pairs
from torchvo360.image import blur
from torchvo360.residuals.direct import Reference, Target, make_target


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    return sample_pairs(8, seed=2, gray=True)


def problem(pairs: Pairs, noise: float = 0.0) -> tuple[Reference, Target, torch.Tensor]:
    camera, B = pairs.camera, len(pairs)
    generator = torch.Generator().manual_seed(0)
    ref, tgt = (
        blur(image + noise * torch.randn(image.shape, generator=generator), camera, 0.5)
        for image in (pairs.ref, pairs.tgt)
    )
    area = camera.solid_angle(camera.pixel_grid())
    reference = Reference(
        camera.ray_grid().permute(2, 0, 1).flatten(1)[None],
        pairs.rho.flatten(1),
        ref.flatten(2),
        area.flatten().expand(B, -1),
    )
    return reference, make_target(tgt, camera), torch.stack([pairs.gain.log(), pairs.bias], -1).double()


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_true_alignments_agree_and_false_ones_do_not(pairs, noise):
    reference, target, affine = problem(pairs, noise)
    assert agreeing_share(reference, target, pairs.T_tgt_ref_true, affine).min() > 0.7
    elsewhere = target.take(torch.arange(8).roll(1))
    assert agreeing_share(reference, elsewhere, pairs.T_tgt_ref_true, affine.roll(1, 0)).max() < 0.1
    turned = lie.se3_exp(torch.tensor([[0, 0, 0, 0, 1.0, 0]], dtype=torch.float64)) @ pairs.T_tgt_ref_true
    assert agreeing_share(reference, target, turned, affine).max() < 0.1


def test_a_gain_that_vanishes_explains_nothing(pairs):
    # A reference without contrast explains almost half of weak gradients: no merit of the alignment.
    reference, target, _ = problem(pairs)
    mean = target.padded[..., 1:-1, 1:-1].mean((1, 2, 3)).double()
    vanished = torch.stack([torch.full_like(mean, -30.0), mean], -1)
    found = compare(reference, target, pairs.T_tgt_ref_true, vanished)
    energy = found.weight * found.slope2
    explained = energy * (found.residual.square() < TOLERANCE_PX**2 * found.slope2)
    assert (explained.sum((1, 2)) / energy.sum((1, 2))).max() > 0.3
    assert agreeing_share(reference, target, pairs.T_tgt_ref_true, vanished).max() < 0.05


def test_it_falls_as_the_pose_departs(pairs):
    reference, target, affine = problem(pairs)
    shares = []
    for px in (0, 1, 2, 4, 8):
        step = torch.zeros(8, 6, dtype=torch.float64)
        step[:, 4] = px * pairs.camera.pixel_angle
        shares.append(agreeing_share(reference, target, lie.se3_exp(step) @ pairs.T_tgt_ref_true, affine))
    assert (torch.stack(shares).diff(dim=0) < 0.02).all()
    assert (shares[2] < 0.5 * shares[0]).all()


def test_exposure_and_contrast_do_not_count(pairs):
    reference, target, affine = problem(pairs)
    share = agreeing_share(reference, target, pairs.T_tgt_ref_true, affine)
    darker = replace(target, padded=0.3 * target.padded + 0.1)
    moved = torch.stack([affine[:, 0] + torch.tensor(0.3).log(), 0.3 * affine[:, 1] + 0.1], -1)
    torch.testing.assert_close(agreeing_share(reference, darker, pairs.T_tgt_ref_true, moved), share, atol=2e-3, rtol=0)


def test_it_is_a_share_and_needs_something_to_see(pairs):
    reference, target, affine = problem(pairs)
    T = pairs.T_tgt_ref_true
    flat = replace(target, padded=torch.full_like(target.padded, 0.5))
    unseen = replace(reference, weight=torch.zeros_like(reference.weight))
    for share in (agreeing_share(reference, flat, T, affine), agreeing_share(unseen, target, T, affine)):
        assert not share.any()
    same = make_target(reference.value.view(8, 1, 128, 256), pairs.camera)
    whole = agreeing_share(reference, same, torch.eye(4, dtype=torch.float64).expand(8, 4, 4), torch.zeros(8, 2))
    torch.testing.assert_close(whole, torch.ones(8), atol=1e-3, rtol=0)
