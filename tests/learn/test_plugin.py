"""Plug-in points: a network of one's own is named, made and held to its word, in one sentence when it breaks it."""

import math
import sys

import pytest
import torch
from torch import nn

from torchvo360.checks import InputError, ShapeError
from torchvo360.learn import (
    DepthEstimator,
    FeatureExtractor,
    FeaturePyramid,
    NonFiniteError,
    RangeEstimate,
    build,
    checked_features,
    checked_ranges,
)

IMAGE = torch.rand(2, 3, 4, 8)


class Answer(nn.Module):
    """Returns whatever it was made with."""

    def __init__(self, answer: object = None) -> None:
        super().__init__()
        self.answer = answer

    def forward(self, image):
        return self.answer


class Fussy(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        if channels < 1:
            raise InputError(f"channels: expected at least 1, got {channels}.")
        if channels > 9:
            raise RuntimeError("out of channels\nand of words")


def pyramid(**changes) -> FeaturePyramid:
    """A good answer with some of its parts exchanged."""
    parts = {"fine": torch.rand(2, 5, 4, 8), "coarse": torch.rand(2, 7, 2, 4), "w_fine": torch.rand(2, 4, 8)}
    parts = parts | {"w_coarse": torch.zeros(2, 2, 4)} | changes
    return FeaturePyramid([parts["fine"], parts["coarse"]], [parts["w_fine"], parts["w_coarse"]])


def ranges(**changes) -> RangeEstimate:
    return RangeEstimate(**({"rho": torch.rand(2, 4, 8) + 0.1, "variance": torch.full((2, 4, 8), 0.01)} | changes))


def spoiled(tensor: torch.Tensor, value: float) -> torch.Tensor:
    tensor = tensor.clone()
    tensor.view(-1)[3] = value
    return tensor


def test_a_network_is_made_from_its_name_and_arguments():
    module = build(
        {"_target_": "torch.nn.Conv2d", "in_channels": 3, "out_channels": 5, "kernel_size": 1}, FeatureExtractor
    )
    assert isinstance(module, nn.Conv2d)
    assert module.out_channels == 5


def test_a_good_answer_passes_unchanged_and_keeps_its_gradient():
    fine = torch.rand(2, 5, 4, 8, requires_grad=True)
    answer = pyramid(fine=fine * 2)
    checked = checked_features(Answer(answer), IMAGE)
    assert all(
        one is other for one, other in zip(checked.maps + checked.confidence, answer[0] + answer[1], strict=True)
    )
    checked.maps[0].sum().backward()
    assert fine.grad is not None
    estimate = ranges()
    assert checked_ranges(Answer(estimate), IMAGE).rho is estimate.rho


@pytest.mark.parametrize(
    ("spec", "sentence"),
    [
        ({}, "features: expected the key _target_, such as features._target_=my.module.Net, got {}."),
        ({"_target_": 3}, "features._target_: expected a dotted name such as my.module.Net, got 3."),
        ({"_target_": "Net"}, "features._target_: expected a dotted name such as my.module.Net, got 'Net'."),
        ({"_target_": "os.system('ls')"}, "features._target_: expected a dotted name such as my.module.Net, got "),
        (
            {"_target_": "absent.module.Net"},
            "features._target_: expected an importable class, got absent.module.Net (Mod",
        ),
        ({"_target_": "torch.nn.Absent"}, "features._target_: expected an importable class, got torch.nn.Absent (Attr"),
        (
            {"_target_": "broken_module.Net"},
            "features._target_: expected an importable class, got broken_module.Net (Zer",
        ),
        ({"_target_": "math.pi"}, "features._target_: expected a subclass of torch.nn.Module, got math.pi, a float."),
        ({"_target_": "builtins.dict"}, "features._target_: expected a subclass of torch.nn.Module, got builtins.dict"),
        (
            {"_target_": "torch.nn.ReLU", "size": 3},
            "features: expected arguments that torch.nn.ReLU accepts, got size (",
        ),
        ({"_target_": "test_plugin.Fussy", "channels": 0}, "features.channels: expected at least 1, got 0."),
        (
            {"_target_": "test_plugin.Fussy", "channels": 10},
            "features: expected arguments that test_plugin.Fussy accepts",
        ),
    ],
)
def test_what_cannot_be_made_is_refused_in_one_sentence(spec, sentence, tmp_path, monkeypatch):
    (tmp_path / "broken_module.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InputError) as refused:
        build(spec, FeatureExtractor)
    assert str(refused.value).startswith(sentence)
    assert str(refused.value).endswith(".")
    assert "\n" not in str(refused.value)
    assert "broken_module" not in sys.modules


@pytest.mark.parametrize("name", ["os.mkdir", "pathlib.Path.mkdir", "test_plugin.pyramid"])
def test_what_is_no_network_is_not_called(name, tmp_path):
    arguments = {"path": str(tmp_path / "made")} if name == "os.mkdir" else {"self": tmp_path / "made"}
    with pytest.raises(InputError, match=r"^depth\._target_: expected .*, got .*\.$"):
        build({"_target_": name, **arguments}, DepthEstimator)
    assert not (tmp_path / "made").exists()


def test_the_role_of_a_network_is_named_in_what_is_refused():
    with pytest.raises(InputError, match=r"^depth\._target_: expected a dotted name"):
        build({"_target_": "Net"}, DepthEstimator)


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (None, "expected a FeaturePyramid (maps, confidence), got NoneType."),
        (
            torch.rand(2, 5, 4, 8),
            "expected a FeaturePyramid (maps, confidence), got a tensor [2, 5, 4, 8] of torch.float32.",
        ),
        (([], []), "expected at least one level, each with its confidence, got 0 maps and 0 confidences."),
        (([torch.rand(2, 5, 4, 8)], []), "expected at least one level, each with its confidence, got 1 maps and 0 con"),
        (pyramid(fine=torch.rand(2, 4, 8)), "maps[0]: expected shape [2, any, any, any], got [2, 4, 8]."),
        (pyramid(coarse=torch.rand(3, 7, 2, 4)), "maps[1]: expected shape [2, any, any, any], got [3, 7, 2, 4]."),
        (pyramid(fine=torch.rand(2, 5, 8, 16)), "maps[0]: expected at most 4 x 8 (finest first), got 8 x 16."),
        (pyramid(fine=torch.rand(2, 5, 0, 8)), "maps[0]: expected at most 4 x 8 (finest first), got 0 x 8."),
        (
            pyramid(fine=torch.rand(2, 5, 1, 2), w_fine=torch.ones(2, 1, 2)),
            "maps[1]: expected at most 1 x 2 (finest first)",
        ),
        (
            pyramid(coarse=torch.rand(2, 7, 2, 3)),
            "maps[1]: expected a panorama's maps twice as wide as high, got 2 x 3.",
        ),
        (pyramid(w_coarse=torch.ones(2, 4, 8)), "confidence[1]: expected shape [2, 2, 4], got [2, 4, 8]."),
        (
            pyramid(fine=torch.ones(2, 5, 4, 8, dtype=torch.int64)),
            "maps[0]: expected a floating-point tensor [2, any, any, ",
        ),
        (
            pyramid(fine=spoiled(torch.rand(2, 5, 4, 8), math.nan)),
            "maps[0]: expected finite values, got 1 of 320 that are",
        ),
        (
            pyramid(w_fine=spoiled(torch.ones(2, 4, 8), math.inf)),
            "confidence[0]: expected finite values, got 1 of 64 that",
        ),
        (pyramid(w_fine=spoiled(torch.ones(2, 4, 8), -0.5)), "confidence[0]: expected values of at least 0, got -0.5."),
        (pyramid(coarse=torch.rand(2, 7, 2, 4, device="meta")), "maps[1]: expected the image's device cpu, got meta."),
    ],
)
def test_features_that_break_their_word_are_refused_by_the_name_of_their_class(answer, sentence):
    with pytest.raises(InputError) as refused:
        checked_features(Answer(answer), IMAGE)
    text = str(refused.value)
    assert text.startswith("features (test_plugin.Answer): " + sentence)
    assert text.endswith(".")


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (torch.rand(2, 4, 8), "expected a RangeEstimate (rho, variance), got a tensor [2, 4, 8] of torch.float32."),
        (ranges(rho=torch.rand(2, 1, 4, 8)), "rho: expected shape [2, 4, 8], got [2, 1, 4, 8]."),
        (ranges(variance=None), "variance: expected a floating-point tensor [2, 4, 8], got NoneType."),
        (ranges(rho=spoiled(torch.ones(2, 4, 8), 0.0)), "rho: expected values above 0, got 0."),
        (
            ranges(variance=spoiled(torch.ones(2, 4, 8), math.nan)),
            "variance: expected finite values, got 1 of 64 that are ",
        ),
        (ranges(rho=torch.rand(2, 4, 8, device="meta")), "rho: expected the image's device cpu, got meta."),
    ],
)
def test_ranges_that_break_their_word_are_refused_by_the_name_of_their_class(answer, sentence):
    with pytest.raises(InputError) as refused:
        checked_ranges(Answer(answer), IMAGE)
    text = str(refused.value)
    assert text.startswith("depth (test_plugin.Answer): " + sentence)
    assert text.endswith(".")


def test_maps_of_another_image_than_a_panorama_may_have_any_sides():
    answer = FeaturePyramid([torch.rand(1, 5, 4, 3)], [torch.ones(1, 4, 3)])
    assert len(checked_features(Answer(answer), torch.rand(1, 3, 6, 8)).maps) == 1


def test_numbers_that_are_not_finite_are_an_error_of_their_own():
    with pytest.raises(NonFiniteError):
        checked_features(Answer(pyramid(fine=spoiled(torch.rand(2, 5, 4, 8), math.nan))), IMAGE)
    with pytest.raises(NonFiniteError):
        checked_ranges(Answer(ranges(rho=spoiled(torch.ones(2, 4, 8), math.inf))), IMAGE)


@pytest.mark.parametrize("check", [checked_features, checked_ranges])
def test_an_image_of_another_shape_is_refused(check):
    with pytest.raises(ShapeError, match=r"^image: expected shape \[B 3 H W\], got \[3, 4, 8\]\.$"):
        check(Answer(pyramid()), IMAGE[0])
