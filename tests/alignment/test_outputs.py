"""What a model asks for besides the pose: how the solve went, what it saw, and how sure it is."""

import pytest
import torch

from torchvo360 import AlignConfig, AlignResult, Pinhole, Status, align, lie
from torchvo360.checks import InputError, ShapeError
from torchvo360.data.synthetic import Pairs, make_world, sample_pairs
from torchvo360.data.synthetic.motion import UPRIGHT
from torchvo360.image import sample
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import LMConfig

ALL = ("history", "maps", "information")


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    return sample_pairs(4, seed=3, width=128, height=64, gray=True)


@pytest.fixture(scope="module")
def result(pairs) -> AlignResult:
    return align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera, outputs=ALL)


def test_nothing_is_made_unasked(pairs, result):
    plain = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera)
    assert plain.history is None
    assert plain.maps is None
    torch.testing.assert_close(plain.T_tgt_ref, result.T_tgt_ref, atol=1e-6, rtol=0)


def test_the_history_tells_every_step_of_every_level(pairs, result):
    assert len(result.history) == AlignConfig().level_count(pairs.camera)
    steps = torch.zeros(4, dtype=torch.int64)
    for level in result.history:
        S = level.cost.shape[-1]
        assert level.cost.shape == level.damping.shape == level.tried.shape == level.accepted.shape == (4, S)
        assert level.tried.any(0).all()
        steps += level.tried.sum(-1)
        # Once an element has ended it tries no more, and what it did not try it was not granted.
        assert (level.tried.int().diff(dim=-1) <= 0).all()
        assert not (level.accepted & ~level.tried).any()
        assert not level.cost[~level.tried].any()
        both = level.tried[:, 1:] & level.tried[:, :-1]
        assert (level.cost.diff(dim=-1)[both] <= 0).all()
        assert (level.cost.diff(dim=-1)[both & ~level.accepted[:, :-1]] == 0).all()
        assert (level.cost.diff(dim=-1)[both & level.accepted[:, :-1]] < 0).all()
        assert level.damping[level.tried][0] == LMConfig().initial_damping
    assert torch.equal(steps, result.steps)
    assert torch.equal(result.history[-1].T_tgt_ref, result.T_tgt_ref)
    assert torch.equal(result.history[-1].status, result.status)
    assert not torch.equal(result.history[0].T_tgt_ref, result.T_tgt_ref)


def test_the_maps_are_what_the_solution_sees(pairs):
    config = AlignConfig(blur_px=0.0)
    rho = pairs.rho.clone()
    rho[:, 10:20, 30:60] = torch.nan
    result = align(pairs.ref, pairs.tgt, rho, pairs.camera, config=config, outputs=("maps",))
    maps = result.maps
    T = result.T_tgt_ref.float()
    Y = (
        pairs.camera.ray_grid().reshape(-1, 3) @ T[:, :3, :3].mT
        + rho.nan_to_num(0).flatten(1)[..., None] * T[:, None, :3, 3]
    )
    warped = sample(pairs.tgt, pairs.camera.project(Y)[0], pairs.camera).view_as(pairs.tgt)
    seen = maps.visible[:, None]
    assert not maps.visible[:, 10:20, 30:60].any()
    assert maps.visible.float().mean() > 0.85
    away = torch.zeros_like(seen)
    away[..., 3:-3, :] = True  # grid sampling rounds the poles' longitudes differently
    torch.testing.assert_close(maps.warped[seen & away], warped[seen & away], atol=2e-4, rtol=0)
    gained = result.a.exp().float()[:, None, None, None] * pairs.ref + result.b.float()[:, None, None, None]
    torch.testing.assert_close(maps.residual[seen], (maps.warped - gained)[seen], atol=1e-5, rtol=0)
    assert not maps.residual[~seen].any()
    assert not maps.warped[~seen].any()
    assert not maps.weight[~seen].any()
    # Together they are the result's own sum of squares.
    square = (maps.weight * maps.residual**2).double().sum((1, 2, 3))
    expected = (
        result.variance * (maps.visible * pairs.camera.solid_angle(pairs.camera.pixel_grid())).sum((1, 2)).double()
    )
    area = pairs.camera.solid_angle(pairs.camera.pixel_grid()).mean()
    torch.testing.assert_close(square, expected / area, rtol=5e-3, atol=0)


def test_outside_a_pinholes_view_nothing_is_visible():
    camera = Pinhole(96, 72, 60.0, 60.0, 48.0, 36.0)
    T_world_ref = lie.se3(UPRIGHT, torch.tensor([1.9, 0.0, 1.6], dtype=torch.float64))
    yaw = lie.se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.25, 0.0], dtype=torch.float64))
    image, reach = make_world("pillars", seed=1).render(
        camera, torch.stack([T_world_ref, T_world_ref @ lie.se3_inverse(yaw)])
    )
    gray = image.mean(1, keepdim=True)
    result = align(gray[0], gray[1], 1 / reach[0], camera, T_tgt_ref=yaw, outputs=("maps",))
    assert result.status == Status.CONVERGED
    # Ahead turns to the right by a sixth of the width: the columns that leave are on the right.
    assert not result.maps.visible[:, -10:].any()
    assert result.maps.visible[10:-10, :60].all()
    assert not result.maps.warped[..., -10:].any()


def test_the_covariance_is_that_of_what_was_estimated(pairs):
    with_affine = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera)
    without = align(pairs.ref, pairs.ref, pairs.rho, pairs.camera, config=AlignConfig(affine=False))
    assert with_affine.estimated.all()
    assert without.estimated[:, :6].all()
    assert not without.estimated[:, 6:].any()
    covariance = without.covariance()
    assert not covariance[:, 6:].any()
    assert not covariance[:, :, 6:].any()
    expected = without.variance[:, None, None] * torch.linalg.inv(without.H[:, :6, :6])
    torch.testing.assert_close(covariance[:, :6, :6], expected, rtol=1e-8, atol=0)
    assert (torch.linalg.eigvalsh(with_affine.covariance()) > 0).all()


def test_information_is_taken_at_the_solution_itself(pairs, result):
    # Without being asked for it is that of a last small step before.
    plain = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera)
    difference = (result.H - plain.H).flatten(1).norm(dim=1) / plain.H.flatten(1).norm(dim=1)
    assert (difference < 0.02).all()
    assert (difference > 0).any()
    assert (torch.linalg.eigvalsh(result.H) > 0).all()


def test_uncertain_ranges_count_less(pairs):
    # Half of the world is nearer than it is said to be, and known to be unsure.
    rho = pairs.rho
    wrong = torch.arange(128) < 64
    said = torch.where(wrong, 1.6 * rho, rho)
    variance = torch.where(wrong, (0.6 * rho) ** 2, 1e-8)
    loss = LossConfig(name="none")
    plain = align(pairs.ref, pairs.tgt, said, pairs.camera, config=AlignConfig(loss=loss, min_agreement=0.0))
    weighed = align(
        pairs.ref,
        pairs.tgt,
        said,
        pairs.camera,
        rho_variance=variance,
        config=AlignConfig(loss=loss, min_agreement=0.0),
    )

    def error(found: AlignResult) -> float:
        return float((found.T_tgt_ref - pairs.T_tgt_ref_true)[:, :3, 3].norm(dim=-1).mean())

    assert error(weighed) < 0.8 * error(plain)  # measured 0.68


def test_target_weights_keep_what_moved_out(pairs):
    # A box that is only in the target, over a fifth of the view.
    tgt = pairs.tgt.clone()
    tgt[:, :, 16:48, 20:70] = torch.rand(32, 50, generator=torch.Generator().manual_seed(0))
    weight = torch.ones_like(pairs.rho)
    weight[:, 15:49, 19:71] = 0.0
    loss = AlignConfig(loss=LossConfig(name="none"), min_agreement=0.0)
    plain = align(pairs.ref, tgt, pairs.rho, pairs.camera, config=loss)
    kept = align(pairs.ref, tgt, pairs.rho, pairs.camera, config=loss, weight_tgt=weight)
    true = pairs.T_tgt_ref_true
    assert (kept.T_tgt_ref - true).abs().max() < 0.01
    assert (plain.T_tgt_ref - true).abs().max() > 2 * (kept.T_tgt_ref - true).abs().max()


def test_bad_requests_are_named(pairs):
    args = (pairs.ref, pairs.tgt, pairs.rho, pairs.camera)
    with pytest.raises(InputError, match=r"^outputs: expected one of history, maps, information, got 'map'\.$"):
        align(*args, outputs=("map",))
    with pytest.raises(ShapeError, match=r"^intrinsics: expected shape \[4 4\], got \[4\]\.$"):
        align(*args, intrinsics=torch.ones(4))
    with pytest.raises(ShapeError, match=r"^weight_tgt: expected shape \[4 64 128\]"):
        align(*args, weight_tgt=torch.ones(4, 1, 64, 128))
    with pytest.raises(ShapeError, match=r"^rho_variance: expected shape"):
        align(*args, rho_variance=torch.ones(64, 128))
    with pytest.raises(
        InputError, match=r"^backward: expected one of implicit, unroll, truncated, none, got 'full'\.$"
    ):
        AlignConfig(backward="full")
    with pytest.raises(InputError, match=r"^hessian: expected one of gauss_newton, exact, got 'newton'\.$"):
        AlignConfig(hessian="newton")
    with pytest.raises(InputError, match=r"^backward_steps: expected at least 1, got 0\.$"):
        AlignConfig(backward_steps=0)


def test_bad_pyramids_are_named(pairs):
    levels = [pairs.ref, torch.nn.functional.avg_pool2d(pairs.ref, 2)]

    def call(ref=levels, tgt=levels, **options):
        return align(ref, tgt, pairs.rho, pairs.camera, config=AlignConfig(affine=False), **options)

    assert (call().status == Status.CONVERGED).all()
    with pytest.raises(InputError, match=r"^ref: expected at least one level, got none\.$"):
        call([], [])
    with pytest.raises(InputError, match=r"^tgt: expected 2 levels, as ref has, got 1\.$"):
        call(tgt=levels[:1])
    with pytest.raises(ShapeError, match=r"^tgt\[1\]: expected shape \[4 1 32 64\], got \[4, 1, 64, 128\]\.$"):
        call(tgt=[levels[0], levels[0]])
    with pytest.raises(InputError, match=r"^ref\[1\]: expected a size of at most 32 x 64, got 64 x 128\.$"):
        call(levels[::-1], levels[::-1])
    odd = [pairs.ref, pairs.ref[..., :32, :63]]
    with pytest.raises(InputError, match=r"^ref\[1\]: expected an even width for a full panorama, got 63\.$"):
        call(odd, odd)
    with pytest.raises(InputError, match=r"^weight_ref: expected 2 levels, as ref has, got 1\.$"):
        call(weight_ref=pairs.rho)
    with pytest.raises(ShapeError, match=r"^weight_ref\[0\]: expected shape"):
        call(weight_ref=[pairs.ref, pairs.ref])
