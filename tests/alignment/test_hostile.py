"""What networks and people do to the layer: half precision, holes, zero weights, unrelated images, lost batches."""

import math
from dataclasses import replace

import pytest
import torch
from probes import CASES, TIGHT, probe
from torch.func import grad, vmap

from torchvo360 import Align, AlignConfig, Equirectangular, Status, align
from torchvo360.checks import InputError
from torchvo360.data.synthetic import Pairs, sample_pairs
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import LMConfig

MODES = {
    "implicit": AlignConfig(),
    "exact": AlignConfig(hessian="exact"),
    "unroll": AlignConfig(backward="unroll"),
    "truncated": AlignConfig(backward="truncated"),
}


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    return sample_pairs(4, seed=9, width=128, height=64, gray=True)


def leaves(pairs: Pairs) -> list[torch.Tensor]:
    return [value.clone().requires_grad_() for value in (pairs.ref, pairs.tgt, pairs.rho)]


@pytest.mark.parametrize("mode", MODES)
def test_autocast_changes_nothing(pairs, mode):
    plain, cast = leaves(pairs), leaves(pairs)
    expected = align(*plain, pairs.camera, config=MODES[mode])
    probe(expected).sum().backward()
    with torch.autocast("cpu", torch.bfloat16):
        result = align(*cast, pairs.camera, config=MODES[mode])
    probe(result).sum().backward()
    assert torch.equal(result.T_tgt_ref, expected.T_tgt_ref)
    for one, other in zip(cast, plain, strict=True):
        assert torch.equal(one.grad, other.grad)


def test_vmap_through_unrolled_steps_stands_zero_weights():
    layer = CASES["sphere"]()
    config = replace(TIGHT, backward="unroll", steps_by_level=[4], solver=replace(TIGHT.solver, fixed_steps=True))
    values = dict(layer.values)
    values["weight_ref"] = values["weight_ref"] * (torch.arange(32) % 3 > 0)
    names = list(values)

    def number(*parts):
        return probe(layer.solve(config, dict(zip(names, parts, strict=True))))

    def total(*parts):
        return vmap(number)(*parts).sum()

    found = grad(total, argnums=(0, 1, 2, 3))(*values.values())
    given = [value.clone().requires_grad_() for value in values.values()]
    expected = torch.autograd.grad(number(*given).sum(), given[:4])
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


def test_pixels_of_no_weight_have_a_gradient_too():
    # A confidence that a ReLU has closed must be able to open again.
    layer = CASES["sphere"]()
    values = dict(layer.values)
    closed = torch.arange(32) % 3 == 0
    values["weight_ref"] = torch.where(closed, 0.0, values["weight_ref"])
    found = {}
    for mode in ("exact", "unroll"):
        config = replace(TIGHT, backward="unroll" if mode == "unroll" else "implicit", hessian="exact")
        weight = values["weight_ref"].clone().requires_grad_()
        result = layer.solve(config, {**values, "weight_ref": weight})
        (found[mode],) = torch.autograd.grad(probe(result).sum(), weight)
    assert found["exact"][..., closed].abs().max() > 1e-6
    torch.testing.assert_close(found["unroll"], found["exact"], rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("name", ["weight_ref", "weight_tgt"])
def test_information_has_the_gradient_of_the_weights(name):
    layer = CASES["sphere"]()
    config = replace(TIGHT, hessian="exact")

    def number(weight):
        result = layer.solve(config, {**layer.values, name: weight}, outputs=("information",))
        return result.H.diagonal(dim1=-2, dim2=-1).log().sum()

    weight = layer.values[name].clone().requires_grad_()
    (found,) = torch.autograd.grad(number(weight), weight)
    assert abs(float((found * weight.detach()).sum())) < 1e-3  # only ratios count
    d = torch.randn(weight.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    h = 1e-6
    with torch.no_grad():
        expected = float((number(weight + h * d) - number(weight - h * d)) / (2 * h))
    assert float((found * d).sum()) == pytest.approx(expected, rel=1e-3)


def test_one_heavy_pixel_does_not_outweigh_the_count_of_all(pairs):
    weight = torch.ones_like(pairs.rho)
    weight[:, 20, 30] = 300.0
    result = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera, weight_ref=weight, weight_tgt=weight)
    assert (result.status != Status.TOO_FEW_PIXELS).all()
    assert (result.status == Status.CONVERGED).sum() >= 3


@pytest.mark.parametrize("size", [(128, 64), (102, 51), (90, 45), (360, 180)])
def test_a_pair_alone_gives_the_bits_that_it_gives_in_a_batch(size):
    pairs = sample_pairs(2, seed=4, width=2 * (size[0] // 2), height=size[1], gray=True)
    for config in (AlignConfig(), AlignConfig(backward="unroll", steps_by_level=[3])):
        together = leaves(pairs)
        result = align(*together, pairs.camera, config=config)
        probe(result).sum().backward()
        for k in range(2):
            alone = [value.detach()[k : k + 1].clone().requires_grad_() for value in together]
            single = align(*alone, pairs.camera, config=config)
            probe(single).sum().backward()
            assert torch.equal(single.T_tgt_ref[0], result.T_tgt_ref[k])
            assert torch.equal(single.H[0], result.H[k])
            for one, other in zip(alone, together, strict=True):
                assert torch.equal(one.grad[0], other.grad[k])


@pytest.mark.parametrize("blur_px", [0.0, 0.5, 2.0])
def test_holes_are_not_smoothed_into_what_is_used(pairs, blur_px):
    tgt = pairs.tgt.clone()
    tgt[:, :, 20:40, 30:60] = math.nan
    config = AlignConfig(levels=1, blur_px=blur_px)
    start = {"T_tgt_ref": pairs.T_tgt_ref_true, "config": config, "outputs": ("maps",)}
    holed = align(pairs.ref, tgt, pairs.rho, pairs.camera, **start)
    filled = tgt.nan_to_num(nan=1.0)
    weight = (~tgt.isnan()[:, 0]).float()
    assert (holed.status == Status.CONVERGED).all()
    whole = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera, **start)
    apart = (holed.T_tgt_ref - whole.T_tgt_ref).abs().max()
    assert apart < 4e-3
    # What stands in the hole is never seen, be it zeros or ones: the pose is that of any other filling.
    other = torch.where(weight[:, None] > 0, filled, torch.inf)
    assert torch.equal(align(pairs.ref, other, pairs.rho, pairs.camera, **start).T_tgt_ref, holed.T_tgt_ref)
    seen = holed.maps.visible & whole.maps.visible & (holed.maps.weight[:, 0] > 0)
    assert float((holed.maps.warped - whole.maps.warped)[:, 0][seen].abs().quantile(0.999)) < 0.02


@pytest.mark.parametrize("mode", MODES)
def test_unrelated_images_run_nowhere(mode):
    generator = torch.Generator().manual_seed(0)
    ref, tgt, rho = (torch.rand(40, *size, generator=generator) for size in ((1, 16, 32), (1, 16, 32), (16, 32)))
    given = [(1e3 * ref).requires_grad_(), tgt.requires_grad_(), rho.requires_grad_()]
    config = replace(MODES[mode], saturation=None, steps_by_level=[10])
    result = align(*given, Equirectangular(32, 16), config=config)
    assert result.a.abs().max() <= 10
    assert result.T_tgt_ref.abs().max() <= 1e6
    for gradient in torch.autograd.grad(probe(result).sum(), given):
        assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("fault", ["mask", "flat", "start", "weight", "empty"])
def test_a_batch_that_fails_as_a_whole_can_be_gone_back_through(pairs, mode, fault):
    given = leaves(pairs)
    options = {}
    if fault == "mask":
        options["mask"] = torch.zeros_like(pairs.rho, dtype=torch.bool)
    elif fault == "flat":
        given[0] = torch.full_like(pairs.ref, 0.4).requires_grad_()
        given[1] = torch.full_like(pairs.ref, 0.4).requires_grad_()
    elif fault == "start":
        options["T_tgt_ref"] = torch.full((4, 4, 4), math.nan)
    elif fault == "weight":
        options["weight_ref"] = torch.zeros_like(pairs.rho).requires_grad_()
    else:
        given = [value.detach()[:0].requires_grad_() for value in given]
    result = align(*given, pairs.camera, config=MODES[mode], outputs=("maps", "history"), **options)
    asked = given + [value for value in options.values() if value.requires_grad]
    for gradient in torch.autograd.grad(probe(result).sum(), asked):
        # The start of gain and offset is the images' own, and unrolled like all that follows.
        assert not gradient.any() or (fault == "flat" and mode == "unroll" and torch.isfinite(gradient).all())
    assert result.maps.warped.shape == given[0].shape


def test_differentiable_is_where_gradients_flow(pairs):
    T = torch.eye(4).repeat(4, 1, 1)
    for mode, expected in (("implicit", False), ("truncated", False), ("unroll", True)):
        start = T.clone().requires_grad_()
        result = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera, T_tgt_ref=start, config=MODES[mode])
        assert result.T_tgt_ref.requires_grad is expected
        assert bool(result.differentiable.all()) is expected
    mask = torch.ones_like(pairs.rho, dtype=torch.bool)
    mask[1] = False
    for mode in MODES:
        given = leaves(pairs)
        result = align(*given, pairs.camera, mask=mask, config=MODES[mode])
        assert result.differentiable.tolist() == [True, False, True, True]
        for gradient in torch.autograd.grad(probe(result).sum(), given):
            assert gradient.flatten(1).any(1).tolist() == [True, False, True, True]


def test_tight_tolerances_end_at_the_rounding_of_the_cost(pairs):
    for tolerance in (1e-4, 1e-6):
        solver = LMConfig(step_tolerance=tolerance, cost_tolerance=tolerance**2)
        result = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera, config=AlignConfig(solver=solver))
        assert (result.status == Status.CONVERGED).all()


def test_a_start_that_is_nearly_rigid_is_made_rigid(pairs):
    start = pairs.T_tgt_ref_true.clone()
    start[:, :3, :3] *= 1.0003
    R = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera, T_tgt_ref=start).T_tgt_ref[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand(4, 3, 3), atol=1e-9, rtol=0)


def test_half_floats_masks_of_numbers_and_wrong_modules_are_refused(pairs):
    args = (pairs.ref, pairs.tgt, pairs.rho, pairs.camera)
    with pytest.raises(InputError, match=r"^mask: expected bool, got torch.float32\.$"):
        align(*args, mask=torch.ones_like(pairs.rho))
    with pytest.raises(InputError, match=r"^weight_tgt: expected float32 or float64, got torch.complex64\.$"):
        align(*args, weight_tgt=pairs.rho.to(torch.complex64))
    with pytest.raises(InputError, match=r"^T_tgt_ref: expected float32 or float64, got torch.int64\.$"):
        align(*args, T_tgt_ref=torch.eye(4, dtype=torch.int64).repeat(4, 1, 1))
    small = pairs.ref[..., ::2, ::2]
    with pytest.raises(InputError, match=r"^tgt\[1\]: expected float32 or float64, got torch.float16\.$"):
        align([pairs.ref, small], [pairs.tgt, small.half()], pairs.rho, pairs.camera)
    with pytest.raises(InputError, match=r"^camera: expected Camera, got AlignConfig"):
        Align(AlignConfig())  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"^config: expected AlignConfig, got LMConfig"):
        Align(pairs.camera, LMConfig())  # pyright: ignore[reportArgumentType]
    config = AlignConfig(loss=LossConfig())
    config.backward = "unrol"
    with pytest.raises(
        InputError, match=r"^backward: expected one of implicit, unroll, truncated, none, got 'unrol'\.$"
    ):
        align(*args, config=config)
    with pytest.raises(InputError, match=r"^outputs: expected one of .*, got 'map'\.$"):
        align(*args, outputs="map")
    assert align(*args, outputs=(name for name in ("maps",))).maps is not None
