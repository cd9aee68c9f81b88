"""The layer's gradients are those of its answers, in every backward mode and at the sphere's hard points."""

import math
from dataclasses import replace

import pytest
import torch
from probes import CASES, TIGHT, Layer, probe
from torch import Tensor

from torchvo360 import AlignConfig, AlignResult, Status, lie

EXACT = replace(TIGHT, hessian="exact")
UNROLL = replace(TIGHT, backward="unroll")
TRUNCATED = replace(TIGHT, backward="truncated", backward_steps=5)
MODES = {"exact": EXACT, "unroll": UNROLL, "truncated": TRUNCATED}


def gradients(layer: Layer, config: AlignConfig) -> tuple[AlignResult, dict[str, Tensor | None]]:
    leaves = layer.leaves()
    result = layer.solve(config, leaves)
    found = torch.autograd.grad(probe(result).sum(), list(leaves.values()), allow_unused=True)
    return result, dict(zip(leaves, found, strict=True))


def direction(name: str, value: Tensor, seed: int) -> Tensor:
    d = torch.randn(value.shape, generator=torch.Generator().manual_seed(seed), dtype=value.dtype)
    if name == "rho":
        return d.abs()  # from 0 ranges can only come nearer
    return 1e-3 * d.abs() if name == "rho_variance" else d


def difference(layer: Layer, config: AlignConfig, name: str, d: Tensor, h: float = 1e-6) -> float:
    """The derivative of the answers along a change of one input, from the right."""
    value = layer.values[name]
    ends = [probe(layer.solve(config, {**layer.values, name: value + s * h * d})).sum() for s in (0, 1, 2)]
    return float((-3 * ends[0] + 4 * ends[1] - ends[2]) / (2 * h))


@pytest.mark.parametrize("mode", MODES)
def test_gradients_are_finite_differences_of_the_answer(layer, mode):
    result, found = gradients(layer, MODES[mode])
    assert (result.status == Status.CONVERGED).all()
    assert result.differentiable.all()
    for name, value in layer.values.items():
        if name == "T_tgt_ref":
            continue
        gradient = found[name]
        assert gradient is not None
        assert torch.isfinite(gradient).all()
        d = direction(name, value, seed=3)
        expected = difference(layer, TIGHT, name, d)
        assert float((gradient * d).sum()) == pytest.approx(expected, rel=2e-4, abs=2e-7), name


def test_implicit_equals_unrolled_at_convergence(layer):
    _, exact = gradients(layer, EXACT)
    for config in (UNROLL, TRUNCATED):
        _, unrolled = gradients(layer, config)
        for name, gradient in exact.items():
            if gradient is not None and float(gradient.abs().max()) > 1e-9:
                other = unrolled[name]
                assert other is not None
                assert float((other - gradient).abs().max() / gradient.abs().max()) < 1e-5, name


def test_gauss_newton_equals_the_exact_hessian_where_residuals_vanish():
    layer = CASES["pinhole"]()
    _, exact = gradients(layer, EXACT)
    _, gauss_newton = gradients(layer, TIGHT)
    for name in ("ref", "tgt", "rho", "intrinsics"):
        torch.testing.assert_close(gauss_newton[name], exact[name], rtol=1e-8, atol=1e-10)
    # With residuals, and in the half row around a pole where G is bounded, it comes near.
    _, exact = gradients(CASES["sphere"](), EXACT)
    _, gauss_newton = gradients(CASES["sphere"](), TIGHT)
    for name in ("ref", "tgt", "rho", "intrinsics"):
        error = (gauss_newton[name] - exact[name]).abs().max() / exact[name].abs().max()
        assert error < 0.02


def test_the_start_has_a_gradient_only_where_all_steps_are_unrolled():
    layer = CASES["sphere"]()
    early = {"steps_by_level": [2]}
    _, none = gradients(layer, replace(TIGHT, **early))
    assert none["T_tgt_ref"] is None
    result, found = gradients(layer, replace(UNROLL, **early))
    assert (result.status == Status.MAX_STEPS).all()
    # After two steps the answer still depends on the start: that dependence is the gradient.
    d = torch.randn(2, 6, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    h = 1e-6
    start = layer.values["T_tgt_ref"]
    ends = [
        probe(layer.solve(replace(UNROLL, **early), {**layer.values, "T_tgt_ref": lie.se3_exp(s * h * d) @ start}))
        for s in (1, -1)
    ]
    expected = float((ends[0] - ends[1]).sum() / (2 * h))
    along = torch.func.jvp(lambda e: lie.se3_exp(e) @ start, (torch.zeros_like(d),), (d,))[1]
    assert expected == pytest.approx(float((found["T_tgt_ref"] * along).sum()), rel=1e-3)
    assert abs(expected) > 1e-4


@pytest.mark.parametrize("mode", [*MODES, "gauss_newton", "none"])
def test_the_forward_result_is_the_same_in_every_mode(mode):
    layer = CASES["sphere"]()
    plain = layer.solve(TIGHT)
    config = {**MODES, "gauss_newton": TIGHT, "none": replace(TIGHT, backward="none")}[mode]
    result = layer.solve(config, layer.leaves())
    for name in ("T_tgt_ref", "a", "b", "status", "cost", "steps", "H", "variance", "agreement"):
        assert torch.equal(getattr(result, name), getattr(plain, name)), name
    assert not plain.differentiable.any()
    assert result.T_tgt_ref.requires_grad == result.differentiable.all() == (mode != "none")


def test_nothing_is_followed_without_a_graph():
    layer = CASES["sphere"]()
    with torch.no_grad():
        result = layer.solve(TIGHT, layer.leaves())
    assert not result.T_tgt_ref.requires_grad
    assert not result.differentiable.any()


@pytest.mark.parametrize("mode", MODES)
def test_second_derivatives_are_those_of_the_first(mode):
    # The zero-residual case is smooth enough for differences of gradients. Damping and acceptance are held as they
    # came out, so that unrolled second derivatives are those of many steps: they agree once converged.
    layer, config = CASES["pinhole"](), MODES[mode]
    if mode != "exact":
        config = replace(config, solver=replace(config.solver, initial_damping=1e-9), backward_steps=9)
    name = "ref"
    d, e = (direction(name, layer.values[name], seed) for seed in (1, 2))

    def first(shift: float) -> tuple[Tensor, Tensor]:
        leaves = layer.leaves()
        leaves[name] = (layer.values[name] + shift * e).requires_grad_()
        result = layer.solve(config, leaves)
        (gradient,) = torch.autograd.grad(probe(result).sum(), leaves[name], create_graph=True)
        return (gradient * d).sum(), leaves[name]

    along, leaf = first(0.0)
    (second,) = torch.autograd.grad(along, leaf)
    h = 1e-5
    expected = float((first(h)[0] - first(-h)[0]).detach() / (2 * h))
    assert float((second * e).sum()) == pytest.approx(expected, rel=2e-3)
    assert abs(expected) > 1e-3


@pytest.mark.parametrize("mode", MODES)
def test_float32_gradients_are_those_of_float64(mode):
    layer = CASES["sphere"]()
    coarse = {"solver": replace(TIGHT.solver, step_tolerance=1e-3, cost_tolerance=1e-9)}
    result, single = gradients(layer.to(torch.float32), replace(MODES[mode], **coarse))
    _, double = gradients(layer, MODES[mode])
    assert (result.status == Status.CONVERGED).all()
    for name in ("ref", "tgt", "rho", "intrinsics"):
        assert single[name].dtype == torch.float32
        error = (single[name].double() - double[name]).norm() / double[name].norm()
        assert error < 0.01, name


def test_an_image_aligned_with_itself_has_finite_gradients():
    # Every look-up lies on the border of the interpolant's cells, and every residual is zero.
    layer = CASES["identity start"]()
    values = {**layer.values, "ref": layer.values["tgt"].clone()}
    for config in (TIGHT, *MODES.values()):
        result, found = gradients(replace(layer, values=values), config)
        assert (result.status == Status.CONVERGED).all()
        assert all(torch.isfinite(g).all() for g in found.values() if g is not None)
        assert float(found["ref"].abs().max()) > 0.01


def test_gradients_flow_through_the_levels_of_a_pyramid():
    # Two levels of one's own, with different numbers of channels; an implicit gradient reaches the finest one only.
    layer = CASES["zero residual"]()
    values = {**layer.values, "ref": 0.9 * layer.values["ref"] + 0.03}
    small = torch.nn.functional.avg_pool2d
    for name in ("ref", "tgt"):
        values[name] = [values[name], small(values[name], 2)[:, :1]]
    for name in ("weight_ref", "weight_tgt"):
        values[name] = [values[name], small(values[name], 2)]
    reached = {}
    for mode, config in {"exact": EXACT, "unroll": replace(UNROLL, steps_by_level=[2])}.items():
        leaves = {
            name: [v.clone().requires_grad_() for v in value] if isinstance(value, list) else value
            for name, value in values.items()
        }
        result = layer.solve(replace(config, affine=False), leaves)
        assert torch.isfinite(result.T_tgt_ref).all()
        levels = [leaf for value in leaves.values() if isinstance(value, list) for leaf in value]
        found = torch.autograd.grad(probe(result).sum(), levels, allow_unused=True)
        reached[mode] = [g is not None and bool((g != 0).any()) for g in found]
    assert reached["exact"] == [True, False] * 2 + [True, False] * 2
    assert reached["unroll"] == [True, True] * 4


def test_maps_and_information_carry_gradients():
    layer = CASES["sphere"]()
    leaves = layer.leaves()
    result = layer.solve(EXACT, leaves, outputs=("maps", "information"))
    loss = (result.maps.residual**2).mean() + result.covariance()[:, :6, :6].diagonal(dim1=-2, dim2=-1).sum()
    found = torch.autograd.grad(loss, [leaves["rho"], leaves["tgt"]])
    d = direction("rho", leaves["rho"], 4)
    h = 1e-6

    def value(shift: float) -> float:
        with torch.no_grad():
            values = {**layer.values, "rho": layer.values["rho"] + shift * d}
            moved = layer.solve(EXACT, values, outputs=("maps", "information"))
            diagonal = moved.covariance()[:, :6, :6].diagonal(dim1=-2, dim2=-1)
            return float((moved.maps.residual**2).mean() + diagonal.sum())

    expected = (value(h) - value(-h)) / (2 * h)
    assert math.isfinite(expected)
    assert float((found[0] * d).sum()) == pytest.approx(expected, rel=1e-3, abs=1e-9)
