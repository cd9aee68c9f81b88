"""Levels, brightness and agreement by compiled passes are those of torch, whatever sizes, edges, masks and weights."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from torchvo360 import AlignConfig, Equirectangular, Pinhole, Status, align, lie
from torchvo360.agreement import agreeing_share
from torchvo360.alignment import compiled_pyramid, match_brightness, pyramid
from torchvo360.alignment.inputs import read_inputs
from torchvo360.alignment.pyramid import Level
from torchvo360.backends import backend
from torchvo360.cameras import Camera
from torchvo360.data.synthetic import sample_pairs

pytest.importorskip("numba")

CAMERAS: list[Camera] = [
    Equirectangular(64, 32),
    Equirectangular(76, 37),
    Equirectangular(60, 20, 80 / math.tau, -40 / math.pi, 30.0, 11.0),
    Pinhole(80, 60, 70.0, 71.0, 41.0, 29.0),
    Pinhole(53, 31, 40.0, 40.0, 26.0, 15.0),
]
every_camera = pytest.mark.parametrize("camera", CAMERAS, ids=["even", "odd", "partial", "pinhole", "odd pinhole"])


def given(camera: Camera, C: int, *, everything: bool) -> dict[str, Any]:
    """Two pairs with holes in their ranges; or with holes in all, and all that may be given."""
    generator = torch.Generator().manual_seed(4)
    H, W = camera.height, camera.width

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    ref, tgt, rho = rand(2, C, H, W), rand(2, C, H, W), rand(2, H, W)
    rho[:, :3, 5:] = math.nan
    rho[0, 9, ::3] = -1.0
    values: dict[str, Any] = dict.fromkeys(("T", "mask", "weight_ref", "weight_tgt", "variance", "k"))
    values |= {"ref": ref, "tgt": tgt, "rho": rho}
    if everything:
        ref[0, 0, 4, 7], tgt[1, -1, -1, 3] = math.nan, math.inf
        variance = 0.1 * rand(2, H, W)
        variance[1, 4, 4:9] = math.inf
        k = torch.tensor([camera.intrinsics] * 2) * (1 + 0.01 * rand(2, 4))
        values |= {"mask": rand(2, H, W) > 0.2, "weight_ref": rand(2, H, W), "weight_tgt": rand(2, H, W)}
        values |= {"variance": variance, "k": k, "T": lie.se3_exp(0.03 * rand(2, 6).double())}
    return values


def levels_of(camera: Camera, values: dict[str, Any], config: AlignConfig, name: str) -> list[Level]:
    with backend(name):
        order = ("T", "mask", "weight_ref", "weight_tgt", "variance", "k")
        inputs = read_inputs(values["ref"], values["tgt"], values["rho"], camera, *(values[name] for name in order))
        compiled = compiled_pyramid.serves(inputs, camera, config)
        assert compiled == (name == "numba")
        return (compiled_pyramid if compiled else pyramid).build_levels(inputs, camera, config)


@every_camera
@pytest.mark.parametrize("blur_px", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("C", "everything"), [(1, False), (1, True), (3, True)])
def test_levels_are_those_of_torch(camera, blur_px, C, everything):
    config = AlignConfig(levels=4, blur_px=blur_px)
    values = given(camera, C, everything=everything)
    found, truth = (levels_of(camera, values, config, name) for name in ("numba", "eager"))
    for a, b in zip(found, truth, strict=True):
        assert a.target.camera == b.target.camera
        assert a.target.saturation == b.target.saturation
        for part in ("ray", "rho", "value", "weight", "variance"):
            torch.testing.assert_close(getattr(a.reference, part), getattr(b.reference, part), atol=3e-6, rtol=1e-5)
        for part in ("padded", "confidence", "intrinsics"):
            torch.testing.assert_close(getattr(a.target, part), getattr(b.target, part), atol=3e-6, rtol=1e-5)


@every_camera
@pytest.mark.parametrize(("C", "everything"), [(1, False), (3, True)])
def test_brightness_and_agreement_are_those_of_torch(camera, C, everything):
    level = levels_of(camera, given(camera, C, everything=everything), AlignConfig(), "eager")[0]
    T = lie.se3_exp(torch.tensor([[0.003] * 6, [0.02, -0.05, 0.01, 0.03, -0.02, 0.05]], dtype=torch.float64))
    affine = torch.tensor([[0.1, -0.02], [-0.2, 0.05]], dtype=torch.float64)
    both = []
    for name in ("numba", "eager"):
        with backend(name):
            brightness = match_brightness(level.reference, level.target, T)
            both.append((brightness, agreeing_share(level.reference, level.target, T, affine)))
    torch.testing.assert_close(both[0][0], both[1][0], atol=1e-5, rtol=0)
    torch.testing.assert_close(both[0][1], both[1][1], atol=2e-3, rtol=0)


def test_pairs_align_as_in_torch():
    pairs = sample_pairs(3, seed=2, width=128, height=64, gray=True)
    results = []
    for name in ("numba", "eager"):
        with backend(name):
            results.append(align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera))
    assert (results[0].status == Status.CONVERGED).all()
    torch.testing.assert_close(results[0].T_tgt_ref, results[1].T_tgt_ref, atol=2e-5, rtol=0)
    torch.testing.assert_close(results[0].agreement, results[1].agreement, atol=1e-3, rtol=0)


def test_a_start_that_is_exact_is_kept_and_its_memory_is_left_alone():
    pairs = sample_pairs(2, seed=2, width=128, height=64, gray=True)
    start = pairs.T_tgt_ref_true.double().clone()
    before = start.clone()
    result = align(pairs.ref, pairs.tgt, torch.full_like(pairs.rho, math.nan), pairs.camera, T_tgt_ref=start)
    assert (result.status == Status.TOO_FEW_PIXELS).all()
    torch.testing.assert_close(result.T_tgt_ref, before, atol=1e-6, rtol=0)
    result.T_tgt_ref.zero_()
    assert torch.equal(start, before)
