"""The compiled comparison finds what the eager one finds: in every option, at hard points, for empty input."""

import math

import pytest
import torch
from test_numba import CAMERAS, FULL, everything, lone_points, plain

from torchvo360.backends import backend, comparison, numba, select

pytest.importorskip("numba")


@CAMERAS
@pytest.mark.parametrize(("channels", "shared"), [(1, True), (3, False)])
def test_every_option_means_what_it_means_to_the_eager_comparison(camera, channels, shared):
    problem = everything(camera, 3, channels, shared=shared)
    for each in (problem, plain(problem)):
        found, truth = numba.compare(*each), comparison.compare(*each)
        assert found.residual.shape == found.weight.shape == (3, channels, camera.height * camera.width)
        seen = (found.weight > 0) & (truth.weight > 0)
        torch.testing.assert_close(found.residual[seen], truth.residual[seen], rtol=0, atol=2e-5)
        torch.testing.assert_close(found.value[seen], truth.value[seen], rtol=0, atol=2e-5)
        # Beside a cell's border rounding decides whose slope it is, and at the edge what is seen.
        weight = truth.weight.expand_as(found.weight)
        for one, other in ((found.slope2[seen], truth.slope2[seen]), (found.weight, weight)):
            alike = (one - other).abs() <= 1e-4 * float(other.max())
            assert float(alike.double().mean()) > 0.999


@CAMERAS
@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_axes_and_zeros_are_compared_alike(camera, rho):
    points = torch.cat([torch.eye(3), -torch.eye(3), torch.zeros(1, 3), 1e9 * torch.eye(3)])
    problem = lone_points(camera, points, rho)
    found, truth = numba.compare(*problem), comparison.compare(*problem)
    assert torch.equal(found.weight, truth.weight)
    seen = found.weight > 0
    torch.testing.assert_close(found.residual[seen], truth.residual[seen], rtol=0, atol=2e-5)
    assert all(bool(torch.isfinite(part).all()) for part in found)


def test_a_pose_that_is_not_finite_reads_nothing_foreign():
    reference, target, T, affine = plain(everything(FULL, 2, 1))
    good = numba.compare(reference, target, T, affine)
    spoilt = T.clone()
    spoilt[1] = math.nan
    found = numba.compare(reference, target, spoilt, affine)
    assert torch.equal(found.residual[0], good.residual[0])


def test_no_points_and_no_pairs_are_answered():
    reference, target, T, affine = plain(everything(FULL, 2, 1))
    assert numba.compare(reference.chunk(0, 0), target, T, affine).residual.shape == (2, 1, 0)
    none = slice(0, 0)
    assert numba.compare(reference.take(none), target.take(none), T[none], affine[none]).residual.shape[0] == 0


def test_the_selection_leaves_derivatives_to_the_eager_comparison():
    reference, target, T, affine = plain(everything(FULL, 1, 1))
    compiled = select.compare(reference, target, T, affine)
    assert torch.equal(compiled.residual, numba.compare(reference, target, T, affine).residual)
    assert select.compare(reference, target, T.clone().requires_grad_(), affine).residual.requires_grad
    with backend("eager"):
        eager = select.compare(reference, target, T, affine)
    assert torch.equal(eager.residual, comparison.compare(reference, target, T, affine).residual)
