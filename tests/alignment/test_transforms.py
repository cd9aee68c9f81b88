"""With fixed steps the layer goes through `torch.func` and `torch.compile`; on a GPU it is what it is on a CPU."""

from dataclasses import replace

import pytest
import torch
from probes import CASES, TIGHT, probe
from torch.func import grad, vmap

from torchvo360 import Align, Status, align
from torchvo360.data.synthetic import sample_pairs

FIXED = replace(TIGHT, solver=replace(TIGHT.solver, fixed_steps=True), steps_by_level=[6])
MODES = {
    "implicit": FIXED,
    "exact": replace(FIXED, hessian="exact"),
    "unroll": replace(FIXED, backward="unroll"),
    "truncated": replace(FIXED, backward="truncated", backward_steps=2),
}


@pytest.mark.parametrize("mode", MODES)
def test_vmap_over_pairs_is_a_batch_of_them(mode):
    layer, config = CASES["sphere"](), MODES[mode]
    names = list(layer.values)

    def number(*values):
        return probe(layer.solve(config, dict(zip(names, values, strict=True))))

    values = tuple(layer.values.values())
    together = layer.solve(config)
    mapped = vmap(number)(*values)
    torch.testing.assert_close(mapped, probe(together), rtol=0, atol=1e-12)
    inputs = tuple(range(len(names) - (mode != "unroll")))
    mapped = vmap(grad(number, argnums=inputs))(*values)
    leaves = [value.clone().requires_grad_() for value in values]
    result = layer.solve(config, dict(zip(names, leaves, strict=True)))
    expected = torch.autograd.grad(probe(result).sum(), [leaves[k] for k in inputs])
    for one, other in zip(mapped, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


def test_vmap_over_starts_shares_the_images():
    layer = CASES["sphere"]()
    values = {name: value[:1] for name, value in layer.values.items()}
    starts = layer.values["T_tgt_ref"]

    def solve(T):
        return layer.solve(FIXED, {**values, "T_tgt_ref": T[None]}).T_tgt_ref[0]

    found = vmap(solve)(starts)
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-6)


@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")  # torch's own, as it traces
@pytest.mark.parametrize("mode", ["implicit", "unroll"])
def test_compile_makes_one_graph_with_the_same_answer(mode):
    # Captured and differentiated whole, without generating code: that takes minutes and a C++ compiler.
    layer = CASES["pinhole"]()
    config = replace(MODES[mode], steps_by_level=[1])
    names = list(layer.values)

    def solve(*values):
        result = layer.solve(config, dict(zip(names, values, strict=True)))
        return result.T_tgt_ref, result.a, result.status

    leaves = [value.clone().requires_grad_() for value in layer.values.values()]
    compiled = torch.compile(solve, backend="aot_eager", fullgraph=True)
    T, a, status = compiled(*leaves)
    T_expected, a_expected, status_expected = solve(*leaves)
    assert torch.equal(status, status_expected)
    torch.testing.assert_close(T, T_expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(a, a_expected, rtol=0, atol=1e-12)
    found = torch.autograd.grad(T[..., :3, :].sum() + a.sum(), leaves[:3])
    expected = torch.autograd.grad(T_expected[..., :3, :].sum() + a_expected.sum(), leaves[:3])
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


def test_the_module_is_the_function():
    layer = CASES["sphere"]()
    module = Align(layer.camera, TIGHT)
    values = dict(layer.values)
    ref, tgt, rho = (values.pop(name) for name in ("ref", "tgt", "rho"))
    assert torch.equal(module(ref, tgt, rho, **values).T_tgt_ref, layer.solve(TIGHT).T_tgt_ref)
    assert not list(module.parameters())
    assert "Equirectangular" in repr(module)
    assert "implicit" in repr(module)
    default = Align(layer.camera)
    assert default.config.backward == "implicit"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no CUDA device")
@pytest.mark.parametrize("mode", ["implicit", "unroll"])
def test_a_gpu_gives_the_answers_of_the_cpu(mode):
    pairs = sample_pairs(4, seed=21, width=128, height=64, gray=True)
    grads = []
    for device in ("cpu", "cuda"):
        leaves = [value.to(device).requires_grad_() for value in (pairs.ref, pairs.tgt, pairs.rho)]
        config = replace(TIGHT, levels=0, backward=mode, affine=True, steps_by_level=[15], solver=TIGHT.solver)
        config = replace(config, solver=replace(config.solver, step_tolerance=1e-3, cost_tolerance=1e-7))
        result = align(*leaves, pairs.camera, config=config, outputs=("maps", "history", "information"))
        assert result.T_tgt_ref.device.type == device
        assert (result.status == Status.CONVERGED).all()
        grads.append([g.cpu() for g in torch.autograd.grad(probe(result).sum(), leaves)])
        grads[-1].append(result.T_tgt_ref.detach().cpu())
    for one, other in zip(*grads, strict=True):
        assert float((one - other).norm() / other.norm()) < 0.02
