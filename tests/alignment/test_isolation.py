"""Bad elements have their status, and leave the others' values and gradients bit for bit as they are without them."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchvo360 import AlignConfig, AlignResult, Equirectangular, Status, align, lie
from torchvo360.data.synthetic import Pairs, sample_pairs
from torchvo360.solve import LMConfig

GOOD = [0, 2, 5]
"""Places of the good pairs in the batch of seven; between and around them lie the bad ones."""
EXPECTED = {
    1: Status.SINGULAR,
    3: Status.TOO_FEW_PIXELS,
    4: Status.TOO_FEW_PIXELS,
    6: Status.BAD_START,
}
FIXED = LMConfig(fixed_steps=True)


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    return sample_pairs(7, seed=21, width=128, height=64, gray=True)


def inputs(pairs: Pairs) -> dict[str, Tensor]:
    """A black image, a NaN image, an empty mask and an impossible start among good pairs."""
    ones = torch.ones_like(pairs.rho)
    values = {
        "ref": pairs.ref.clone(),
        "tgt": pairs.tgt.clone(),
        "rho": pairs.rho.clone(),
        "mask": ones.bool(),
        "weight_ref": 0.5 + 0.5 * pairs.ref[:, 0],
        "weight_tgt": ones.clone(),
        "rho_variance": 0.01 * ones,
        "T_tgt_ref": torch.eye(4, dtype=torch.float64).repeat(7, 1, 1),
    }
    values["ref"][1] = values["tgt"][1] = 0.0
    values["tgt"][3] = math.nan
    values["mask"][4] = False
    values["T_tgt_ref"][6] = math.nan
    return values


def solve(values: dict[str, Tensor], config: AlignConfig) -> tuple[AlignResult, dict[str, Tensor]]:
    leaves = {k: v.clone().requires_grad_() if v.is_floating_point() else v for k, v in values.items()}
    arguments = dict(leaves)
    ref, tgt, rho = (arguments.pop(name) for name in ("ref", "tgt", "rho"))
    result = align(ref, tgt, rho, Equirectangular(128, 64), config=config, **arguments, outputs=("maps", "history"))
    followed = [name for name, leaf in leaves.items() if leaf.requires_grad]
    mix = torch.linspace(0.5, 1.5, 16, dtype=torch.float64).view(4, 4)
    number = (result.T_tgt_ref * mix).sum() + result.a.sum() - 2 * result.b.sum()
    grads = torch.autograd.grad(number, [leaves[name] for name in followed], allow_unused=True)
    return result, {name: grad for name, grad in zip(followed, grads, strict=True) if grad is not None}


@pytest.mark.parametrize("mode", ["implicit", "exact", "unroll", "truncated"])
@pytest.mark.parametrize("solver", [LMConfig(), FIXED], ids=["compacted", "fixed"])
def test_bad_elements_leave_the_others_bit_for_bit_as_they_are(pairs, mode, solver):
    backward = "implicit" if mode == "exact" else mode
    hessian = "exact" if mode == "exact" else "gauss_newton"
    config = AlignConfig(backward=backward, hessian=hessian, solver=solver, steps_by_level=[6])
    values = inputs(pairs)
    together, grads = solve(values, config)
    for place, status in EXPECTED.items():
        assert Status(int(together.status[place])) is status
    assert not together.differentiable[list(EXPECTED)].any() or mode in ("unroll", "truncated")
    apart, grads_apart = solve({name: value[GOOD] for name, value in values.items()}, config)
    assert (apart.status == Status.CONVERGED).all()
    assert apart.differentiable.all()
    for name in ("T_tgt_ref", "a", "b", "status", "cost", "steps", "H", "variance", "agreement"):
        assert torch.equal(getattr(together, name)[GOOD], getattr(apart, name)), name
    assert grads.keys() == grads_apart.keys()
    for name, grad in grads.items():
        assert torch.equal(grad[GOOD], grads_apart[name]), name
        assert torch.isfinite(grad).all(), name
    for name in ("residual", "weight", "visible", "warped"):
        whole = getattr(together.maps, name)
        assert torch.equal(whole[GOOD], getattr(apart.maps, name))
        assert torch.isfinite(whole.float()).all()


@pytest.mark.parametrize("solver", [LMConfig(), FIXED], ids=["compacted", "fixed"])
def test_what_did_not_converge_has_exactly_zero_gradient_and_is_named(pairs, solver):
    values = inputs(pairs)
    # A start on the wrong side of the world ends in a false minimum.
    values["T_tgt_ref"][2, :3, :3] = lie.so3_exp(torch.tensor([0.3, 2.6, -0.4], dtype=torch.float64))
    result, grads = solve(values, AlignConfig(solver=solver))
    converged = result.status == Status.CONVERGED
    assert converged.tolist() == [True, False, False, False, False, True, False]
    assert torch.equal(result.differentiable, converged)
    for name, grad in grads.items():
        assert not grad[~converged].any(), name
        assert grad[converged].flatten(1).any(1).all(), name


def test_no_number_leaves_as_nan(pairs):
    for config in (AlignConfig(), AlignConfig(solver=FIXED), AlignConfig(backward="unroll")):
        result, _ = solve(inputs(pairs), config)
        for name in ("T_tgt_ref", "a", "b", "cost", "H", "variance", "agreement"):
            assert not getattr(result, name).isnan().any(), name
        assert not result.covariance().isnan().any()
        for level in result.history:
            assert torch.isfinite(level.cost).all()
            assert torch.isfinite(level.damping).all()
    assert torch.equal(result.T_tgt_ref[6], torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize("spoiled", [math.nan, math.inf, -1.0])
def test_weights_and_variances_that_are_none_leave_their_pixels_out(pairs, spoiled):
    values = {name: value[GOOD] for name, value in inputs(pairs).items()}
    area = (slice(None), slice(20, 40), slice(10, 60))
    config = AlignConfig(levels=1)
    for name in ("weight_ref", "rho_variance"):
        bad = {**values, name: values[name].clone()}
        bad[name][area] = spoiled
        masked = {**values, "mask": values["mask"].clone()}
        masked["mask"][area] = False
        result, grads = solve(bad, config)
        expected, _ = solve(masked, config)
        torch.testing.assert_close(result.T_tgt_ref, expected.T_tgt_ref, atol=1e-7, rtol=0)
        assert not grads[name][area].any()
    bad = {**values, "weight_tgt": values["weight_tgt"].clone()}
    bad["weight_tgt"][area] = spoiled
    zero = {**values, "weight_tgt": values["weight_tgt"].clone()}
    zero["weight_tgt"][area] = 0.0
    assert torch.equal(solve(bad, config)[0].T_tgt_ref, solve(zero, config)[0].T_tgt_ref)


@pytest.mark.parametrize(
    ("name", "start"),
    [
        ("scaled", 2 * torch.eye(4)),
        ("mirrored", torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))),
        ("infinite", torch.full((4, 4), math.inf)),
        ("far", torch.eye(4) + 1e7 * torch.eye(4).roll(1, 1).tril(-1).mT.roll(0)),
    ],
)
def test_impossible_starts_are_a_status(pairs, name, start):
    if name == "far":
        start = torch.eye(4)
        start[0, 3] = 1e7
    T = torch.stack([torch.eye(4), start])
    result = align(pairs.ref[:2], pairs.tgt[:2], pairs.rho[:2], pairs.camera, T_tgt_ref=T)
    assert [Status(int(s)) for s in result.status] == [Status.CONVERGED, Status.BAD_START]
    assert torch.equal(result.T_tgt_ref[1], torch.eye(4, dtype=torch.float64))


def test_impossible_intrinsics_leave_no_pixel(pairs):
    k = torch.tensor([pairs.camera.intrinsics] * 3)
    k[1, 0], k[2, 3] = 0.0, math.nan
    result = align(pairs.ref[:3], pairs.tgt[:3], pairs.rho[:3], pairs.camera, intrinsics=k)
    assert [Status(int(s)) for s in result.status] == [Status.CONVERGED] + [Status.TOO_FEW_PIXELS] * 2
    own = align(pairs.ref[:1], pairs.tgt[:1], pairs.rho[:1], pairs.camera)
    torch.testing.assert_close(result.T_tgt_ref[:1], own.T_tgt_ref, atol=1e-5, rtol=0)


def test_wrong_intrinsics_are_seen_in_the_answer_and_right_ones_in_the_agreement(pairs):
    k = torch.tensor([pairs.camera.intrinsics] * 3, dtype=torch.float64)
    wrong = k.clone()
    wrong[:, 1] *= 0.9  # the image's height stands for 10 % more latitude
    args = (pairs.ref[:3], pairs.tgt[:3], pairs.rho[:3], pairs.camera)
    right, off = align(*args, intrinsics=k), align(*args, intrinsics=wrong)
    assert (right.cost < off.cost).all()
    shifted = k.clone()
    shifted[:, 2] += 5.0  # another column looks ahead: a yaw of both cameras, which turns the motion
    Y = lie.so3_exp(torch.tensor([0.0, -5 * math.tau / 128, 0.0], dtype=torch.float64))
    Y = lie.se3(Y, Y.new_zeros(3))
    turned = align(*args, intrinsics=shifted)
    assert (turned.status == Status.CONVERGED).all()
    expected = Y @ right.T_tgt_ref @ lie.se3_inverse(Y)
    torch.testing.assert_close(turned.T_tgt_ref, expected, atol=2e-3, rtol=0)


def test_fixed_steps_give_the_answers_of_branches(pairs):
    values = inputs(pairs)
    for damping in ("gain_ratio", "lsd"):
        solver = LMConfig(damping=damping)
        plain, _ = solve(values, AlignConfig(solver=solver))
        fixed, _ = solve(values, AlignConfig(solver=replace(solver, fixed_steps=True)))
        for name in ("T_tgt_ref", "a", "b", "status", "cost", "steps", "H", "variance", "agreement"):
            assert torch.equal(getattr(fixed, name), getattr(plain, name)), name
