"""Checkpoints: what was saved comes back bit for bit; what comes from a stranger can neither run nor break anything."""

import json
import os
import struct
import sys
from pathlib import Path

import pytest
import torch
from torch import nn
from toy_experiment import toy_module

import torchvo360.learn
from torchvo360.checks import InputError
from torchvo360.files import write_atomically
from torchvo360.learn import load_checkpoint, save_checkpoint
from torchvo360.learn.checkpoint import read_config

CONFIG = {"_target_": "toy_experiment.toy_module", "plain": False, "made_by": "a command", "figures": {"loss": 0.5}}


class Tied(nn.Module):
    """Two names for one tensor, and a buffer of integers."""

    def __init__(self, size: int = 3) -> None:
        super().__init__()
        self.one = nn.Linear(size, size)
        self.other = nn.Linear(size, size)
        self.other.weight = self.one.weight
        self.register_buffer("count", torch.tensor([7]))


@pytest.fixture
def saved(tmp_path) -> Path:
    path = tmp_path / "net.v1"
    save_checkpoint(path, toy_module(), CONFIG)
    return path


def weights_of(path: Path) -> Path:
    return path.with_name(path.name + ".safetensors")


def json_of(path: Path) -> Path:
    return path.with_name(path.name + ".json")


@pytest.mark.parametrize("suffix", ["", ".safetensors", ".json"])
@pytest.mark.parametrize("target", [toy_module, "toy_experiment.ToyNet"])
def test_a_saved_network_comes_back_bit_for_bit_ready_to_use(saved, suffix, target):
    module = load_checkpoint(saved.with_name(saved.name + suffix), target)
    assert not module.training
    own = toy_module().state_dict()
    assert all(torch.equal(value, own[name]) for name, value in module.state_dict().items())
    assert read_config(saved) == CONFIG
    assert sorted(path.name for path in saved.parent.iterdir()) == ["net.v1.json", "net.v1.safetensors"]


def test_tensors_that_are_shared_come_back_shared(tmp_path):
    module = Tied()
    module.count += 1
    save_checkpoint(tmp_path / "tied", module, {"_target_": "test_checkpoint.Tied", "size": 3})
    again = load_checkpoint(tmp_path / "tied", Tied)
    assert again.one.weight is again.other.weight
    assert torch.equal(again.one.weight, module.one.weight)
    assert int(again.count) == 8


def test_numbers_that_json_cannot_hold_become_null(tmp_path):
    figures = {"a": float("nan"), "b": [float("inf"), 1.0]}
    save_checkpoint(tmp_path / "net", toy_module(), CONFIG | {"figures": figures})
    assert read_config(tmp_path / "net")["figures"] == {"a": None, "b": [None, 1.0]}


@pytest.mark.parametrize(
    "name",
    [
        "evil_module.Net",
        "os.system",
        "torch.load",
        "torch.nn.Linear",
        "torchvo360.lie.torch.load",
        "torchvo360.learn",
        "torchvo360.learn.",
        "torchvo360.learn.checkpoint.load_checkpoint",
        "torchvo360.learn.checkpoint.Path",
        "torchvo360.learn.plugin.nn.Linear",
        "torchvo360.learn.experiment.nn",
        "torchvo360.learn.absent.Net",
        "torchvo360.learn.plugin.Absent",
        "torchvo360.learning.Net",
        "../evil_module.Net",
    ],
)
def test_a_checkpoint_cannot_have_foreign_code_imported_or_called(saved, monkeypatch, name):
    trap = saved.parent / "evil_module.py"
    trap.write_text(f"open({str(saved.parent / 'ran')!r}, 'w').close()")
    monkeypatch.syspath_prepend(str(saved.parent))
    json_of(saved).write_text(json.dumps({"_target_": name}))
    with pytest.raises(InputError, match=r"^checkpoint: expected .*\.$"):
        load_checkpoint(saved)
    assert not (saved.parent / "ran").exists()
    assert "evil_module" not in sys.modules


def test_a_class_within_the_arguments_of_a_checkpoint_stays_a_word(saved):
    json_of(saved).write_text(json.dumps({"_target_": "x.Y", "inner": {"_target_": "os.system", "command": "true"}}))
    got = []

    def target(inner: dict) -> nn.Module:
        got.append(inner)
        return toy_module()

    load_checkpoint(saved, target)
    assert got == [{"_target_": "os.system", "command": "true"}]


def test_networks_of_our_own_are_made_without_a_word_from_the_caller(tmp_path, monkeypatch):
    class Own(nn.Linear):
        pass

    Own.__module__ = "torchvo360.learn.plugin"
    monkeypatch.setattr(torchvo360.learn.plugin, "Own", Own, raising=False)
    config = {"_target_": "torchvo360.learn.plugin.Own", "in_features": 2, "out_features": 3}
    save_checkpoint(tmp_path / "own", Own(2, 3), config)
    assert type(load_checkpoint(tmp_path / "own")) is Own


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"\xff\xfe", b"null", b'{"_target_": 3}', b'{"a": 1}', b"[" * 10**5]
)
def test_a_json_that_is_none_is_told(saved, content):
    json_of(saved).write_bytes(content)
    with pytest.raises(InputError, match=r"^checkpoint: expected .*\.json.*, got.*\.$"):
        load_checkpoint(saved, toy_module)


def test_files_that_are_missing_are_told(saved):
    weights_of(saved).unlink()
    with pytest.raises(InputError, match=r"^checkpoint: expected a readable file .*\.safetensors, got: .*\.$"):
        load_checkpoint(saved, toy_module)
    json_of(saved).unlink()
    with pytest.raises(InputError, match=r"^checkpoint: expected a readable file .*\.json, got: No such file .*\.$"):
        load_checkpoint(saved, toy_module)


@pytest.mark.parametrize("keep", [0, 4, 8, 100, -1])
def test_a_truncated_file_is_told(saved, keep):
    weights = weights_of(saved)
    weights.write_bytes(weights.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"^checkpoint: expected a whole safetensors file in .*, got: .*\.$"):
        load_checkpoint(saved, toy_module)


def test_a_pickle_is_refused_unread(saved):
    torch.save(toy_module().state_dict(), weights_of(saved))
    with pytest.raises(InputError, match=r"^checkpoint: expected a whole safetensors file"):
        load_checkpoint(saved, toy_module)


def test_a_header_that_claims_more_than_there_is_is_told(saved):
    header = json.dumps({"x": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4 * 10**12]}}).encode()
    weights_of(saved).write_bytes(struct.pack("<Q", len(header)) + header + b"\0" * 16)
    with pytest.raises(InputError, match=r"^checkpoint: expected a whole safetensors file"):
        load_checkpoint(saved, toy_module)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda s: s.pop("0.weight"), r"expected the tensors of Sequential, got .* without 0\.weight\."),
        (lambda s: s.update(more=torch.ones(1)), r"expected the tensors of Sequential, got .* with more\."),
        (
            lambda s: s.update({"0.bias": torch.ones(4)}),
            r"expected 0\.bias to be \[3\] of torch\.float32, got \[4\] of .*\.",
        ),
        (
            lambda s: s.update({"0.bias": torch.ones(3).long()}),
            r"expected 0\.bias to be .*, got \[3\] of torch\.int64 .*\.",
        ),
        (
            lambda s: s["0.weight"].view(-1)[0].fill_(torch.nan),
            r"expected finite numbers, got others in 0\.weight of .*\.",
        ),
        (
            lambda s: s["1.running_var"].fill_(torch.inf),
            r"expected finite numbers, got others in 1\.running_var of .*\.",
        ),
    ],
)
def test_tensors_that_do_not_fit_are_told(saved, change, sentence):
    state = toy_module().state_dict()
    change(state)

    class Other(nn.Module):
        def state_dict(self):
            return state

    save_checkpoint(saved, Other(), CONFIG)
    with pytest.raises(InputError, match=f"^checkpoint: {sentence}$"):
        load_checkpoint(saved, toy_module)


@pytest.mark.parametrize("dtype", [torch.float8_e4m3fn, torch.float8_e5m2, torch.complex64, torch.bool])
def test_numbers_of_another_kind_are_told(tmp_path, dtype):
    class Other(nn.Module):
        def state_dict(self):
            return {"weight": torch.ones(3, 2).to(dtype), "bias": torch.ones(3)}

    save_checkpoint(tmp_path / "net", Other(), {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 3})
    with pytest.raises(InputError, match=r"^checkpoint: expected weight to be .*, got \[3, 2\] of .* in .*\.$"):
        load_checkpoint(tmp_path / "net", nn.Linear)


def test_a_network_of_eight_bits_is_told(tmp_path):
    network = nn.Linear(2, 3).to(torch.float8_e4m3fn)
    save_checkpoint(tmp_path / "net", network, {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 3})
    with pytest.raises(InputError, match=r"^checkpoint: expected 16 bits or more a number, got .*float8.*\.$"):
        load_checkpoint(tmp_path / "net", lambda **arguments: nn.Linear(**arguments).to(torch.float8_e4m3fn))


@pytest.mark.parametrize("path", ["", ".", "/", "./", ".."])
def test_a_path_that_names_no_file_is_told(path):
    with pytest.raises(InputError, match=r"^checkpoint: expected .*\.$"):
        load_checkpoint(path, toy_module)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("depth.PanoramaDepth", {"width": 2**70}),
        ("depth.PanoramaDepth", {"channels": [2**70]}),
        ("depth.PanoramaDepth", {"channels": [8] * 10**5}),
        ("features.PanoramaFeatures", {"widths": [2**70], "channels": [1]}),
        ("features.PanoramaFeatures", {"widths": [8], "channels": [2**70]}),
        ("features.PanoramaFeatures", {"widths": [8] * 10**5, "channels": [8] * 10**5}),
        ("features.PanoramaFeatures", {"spread_deg": [15.0] * 10**5}),
    ],
)
def test_sizes_beyond_all_use_are_told_before_anything_is_made(saved, name, arguments):
    json_of(saved).write_text(json.dumps({"_target_": f"torchvo360.learn.{name}", **arguments}))
    with pytest.raises(InputError, match=r"^checkpoint\.[\w, ]+: expected .*, got .{1,200}\.$"):
        load_checkpoint(saved)


def test_arguments_that_the_class_refuses_are_told(saved):
    json_of(saved).write_text(json.dumps({"_target_": "x.Y", "depth": 3}))
    with pytest.raises(
        InputError, match=r"^checkpoint: expected arguments that toy_module accepts, got depth \(.*\)\.$"
    ):
        load_checkpoint(saved, toy_module)


def test_a_config_without_a_class_or_beyond_json_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(InputError, match=r"^config: expected _target_"):
        save_checkpoint(tmp_path / "net", toy_module(), {"channels": 3})
    with pytest.raises(InputError, match=r"^config: expected what JSON holds"):
        save_checkpoint(tmp_path / "net", toy_module(), CONFIG | {"size": torch.ones(1)})
    assert not list(tmp_path.iterdir())


def test_a_write_that_fails_leaves_the_older_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, "older")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match=r"^file: expected a folder to write to, got .*: No space left on device\.$"):
        write_atomically(path, "newer")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["older"]


def test_the_extra_is_named_where_safetensors_is_missing(saved, monkeypatch):
    monkeypatch.setitem(sys.modules, "safetensors", None)
    with pytest.raises(InputError, match=r"pip install 'torchvo360\[learn\]'"):
        load_checkpoint(saved, toy_module)
