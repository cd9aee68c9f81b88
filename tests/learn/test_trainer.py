"""Training: what is killed and resumed ends with the same bits, what is not finite changes nothing, ends are told."""

import csv
import io
import json
import math
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor, nn
from toy_experiment import SETTINGS, Toy, toy_module

from torchvo360.checks import InputError
from torchvo360.files import atomic_path
from torchvo360.learn import Ending, NonFiniteError, TrainerConfig, load_checkpoint, train
from torchvo360.learn.checkpoint import read_config, read_tensors, tensors_to_bytes
from torchvo360.learn.resume import load_state
from torchvo360.learn.schedule import learning_rate

CONFIG = TrainerConfig(**SETTINGS)


class BrokenOffError(Exception):
    pass


class InterruptedToy(Toy):
    """Breaks off at a step, as a kill would."""

    at = 0

    def batch(self, step, part, parts):
        if step == self.at:
            raise BrokenOffError
        return super().batch(step, part, parts)


class SpoiledToy(Toy):
    """Has batches that are not finite."""

    steps = range(0)

    def batch(self, step, part, parts):
        batch = super().batch(step, part, parts)
        return {name: value * math.nan for name, value in batch.items()} if step in self.steps else batch


class FalseGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value):
        return value.clone()

    @staticmethod
    def backward(ctx, *gradients):
        return gradients[0] * math.inf


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return [{name: cell for name, cell in row.items() if name != "seconds"} for row in csv.DictReader(file)]


def weights(folder: Path, name: str = "last") -> dict[str, Tensor]:
    return read_tensors(folder / f"{name}.safetensors")[0]


def assert_same_bits(first: Path, second: Path) -> None:
    for name in ("state", "best", "last"):
        one, other = weights(first, name), weights(second, name)
        assert one.keys() == other.keys()
        assert all(torch.equal(one[key], other[key]) for key in one)
    for name in ("train.csv", "validation.csv"):
        assert rows(first / name) == rows(second / name)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("uninterrupted")
    assert train(Toy(CONFIG), CONFIG, folder).ending is Ending.FINISHED
    return folder


def test_a_training_killed_by_sigkill_resumes_bit_for_bit(uninterrupted, tmp_path):
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, str(Path(__file__).with_name("toy_experiment.py")), "killed", str(tmp_path)]
    killed = subprocess.run(command, env=environment, timeout=120, check=False, capture_output=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    assert len(rows(tmp_path / "train.csv")) == 24  # three of them behind the state of step 21
    outcome = train(Toy(CONFIG), CONFIG, tmp_path, resume=True)
    assert (outcome.ending, outcome.steps) == (Ending.FINISHED, 30)
    assert_same_bits(uninterrupted, tmp_path)


@pytest.mark.parametrize("at", [0, 6, 7, 10, 11, 20, 29])
def test_a_training_broken_off_at_any_step_resumes_bit_for_bit(uninterrupted, tmp_path, at):
    toy = InterruptedToy(CONFIG)
    toy.at = at
    with pytest.raises(BrokenOffError):
        train(toy, CONFIG, tmp_path)
    train(Toy(CONFIG), CONFIG, tmp_path, resume=True)
    assert_same_bits(uninterrupted, tmp_path)


def test_a_training_stopped_by_a_signal_is_saved_at_once_and_resumes_bit_for_bit(uninterrupted, tmp_path):
    asked = iter([False] * 11 + [True])
    outcome = train(Toy(CONFIG), CONFIG, tmp_path, stopped=lambda: next(asked))
    assert (outcome.ending, outcome.steps, outcome.success) == (Ending.STOPPED, 12, False)
    train(Toy(CONFIG), CONFIG, tmp_path, resume=True)
    assert_same_bits(uninterrupted, tmp_path)


def test_resuming_a_finished_training_changes_nothing(uninterrupted, tmp_path):
    train(Toy(CONFIG), CONFIG, tmp_path)
    assert train(Toy(CONFIG), CONFIG, tmp_path, resume=True).steps == 30
    assert_same_bits(uninterrupted, tmp_path)


def test_a_line_that_a_kill_cut_off_is_dropped(uninterrupted, tmp_path):
    toy = InterruptedToy(CONFIG)
    toy.at = 24
    with pytest.raises(BrokenOffError):
        train(toy, CONFIG, tmp_path)
    with (tmp_path / "train.csv").open("a") as file:
        file.write("2")  # of a line that would have been 25,...
    train(Toy(CONFIG), CONFIG, tmp_path, resume=True)
    assert_same_bits(uninterrupted, tmp_path)


def test_without_resume_an_earlier_training_is_replaced(uninterrupted, tmp_path):
    train(Toy(CONFIG), replace(CONFIG, steps=5, seed=3), tmp_path)
    train(Toy(CONFIG), CONFIG, tmp_path)
    assert_same_bits(uninterrupted, tmp_path)
    assert len(list((tmp_path / "tensorboard").iterdir())) == 1


def test_the_seed_decides_and_the_callers_random_numbers_go_on(uninterrupted, tmp_path):
    def state() -> tuple:
        return random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()

    before = state()
    train(Toy(CONFIG), replace(CONFIG, seed=1), tmp_path)
    assert state() == before
    assert any(not torch.equal(value, weights(tmp_path)[name]) for name, value in weights(uninterrupted).items())


def test_the_best_network_is_that_of_the_best_validation(tmp_path):
    config = replace(CONFIG, watch="-score")

    class Scored(Toy):
        def validate(self, module):
            self.seen = [*getattr(self, "seen", []), {k: v.clone() for k, v in module.state_dict().items()}]
            return {"score": [0.1, 0.7, math.nan, 0.3][len(self.seen) - 1]}

    toy = Scored(config)
    outcome = train(toy, config, tmp_path, made_by="a command")
    assert (outcome.best, outcome.best_step) == (0.7, 10)
    assert all(torch.equal(value, toy.seen[1][name]) for name, value in weights(tmp_path, "best").items())
    config = read_config(outcome.checkpoint)
    assert config["made_by"] == "a command"
    assert config["figures"] == {"score": 0.7, "steps": 10}
    module = load_checkpoint(outcome.checkpoint, toy_module)
    assert not module.training


def test_training_ends_when_the_watched_figure_gets_no_better(tmp_path):
    config = replace(CONFIG, patience=2, validate_every=3)

    class Flat(Toy):
        def validate(self, module):
            return {"loss": 1.0}

    outcome = train(Flat(config), config, tmp_path)
    assert (outcome.ending, outcome.steps, outcome.best_step) == (Ending.EARLY, 6, 0)


def test_training_ends_when_its_time_is_up_and_can_go_on(uninterrupted, tmp_path):
    outcome = train(Toy(CONFIG), replace(CONFIG, max_minutes=1e-6), tmp_path)
    assert outcome.ending is Ending.TIME
    assert outcome.steps < 5
    train(Toy(CONFIG), CONFIG, tmp_path, resume=True)
    assert_same_bits(uninterrupted, tmp_path)


@pytest.mark.parametrize("what", ["loss", "gradient"])
def test_a_step_without_finite_numbers_changes_neither_weights_nor_running_means(tmp_path, what):
    config = replace(CONFIG, steps=7, save_every=1, schedule="constant", warmup_steps=0)

    class Spoiled(Toy):
        def losses(self, module, batch):
            self.seen = [*getattr(self, "seen", []), {k: v.clone() for k, v in module.state_dict().items()}]
            losses = super().losses(module, batch)
            if module.training and len(self.seen) in (4, 5):
                losses["loss"] = losses["loss"] * math.nan if what == "loss" else FalseGradient.apply(losses["loss"])
            return losses

    toy = Spoiled(config)
    outcome = train(toy, config, tmp_path)
    assert (outcome.ending, outcome.skipped, outcome.steps) == (Ending.FINISHED, 2, 7)
    before, *skipped, after = toy.seen[3:7]
    assert all(torch.equal(before[name], value) for state in skipped for name, value in state.items())
    assert not any(torch.equal(before[name], value) for name, value in after.items())
    told = [row["loss"] == "" or row["gradient_norm"] == "" for row in rows(tmp_path / "train.csv")]
    assert told == [False, False, False, True, True, False, False]


def test_training_ends_after_too_many_steps_without_finite_numbers_and_keeps_the_state_before(tmp_path):
    config = replace(CONFIG, max_skipped=3)
    toy = SpoiledToy(config)
    toy.steps = range(8, 1000)
    outcome = train(toy, config, tmp_path)
    assert (outcome.ending, outcome.steps, outcome.skipped, outcome.success) == (Ending.DIVERGED, 11, 3, False)
    module = Toy(config).module
    assert load_state(tmp_path / "state.safetensors", module, torch.optim.AdamW(module.parameters())).step == 7


@pytest.mark.parametrize("at", [2, 7])
def test_a_step_whose_network_gives_no_finite_numbers_is_skipped_and_resumed_behind(tmp_path, at):
    class Lost(InterruptedToy):
        def losses(self, module, batch):
            self.seen = [*getattr(self, "seen", []), {k: v.clone() for k, v in module.state_dict().items()}]
            losses = super().losses(module, batch)
            if module.training and self.now == 7:
                raise NonFiniteError("features (Net): expected finite values, got 1 of 2 that are not.")
            return losses

        def batch(self, step, part, parts):
            self.now = step
            return super().batch(step, part, parts)

    (whole := tmp_path / "whole").mkdir()
    (parts := tmp_path / "parts").mkdir()
    toy = Lost(CONFIG)
    toy.at = -1
    outcome = train(toy, CONFIG, whole)
    assert (outcome.ending, outcome.skipped) == (Ending.FINISHED, 1)
    assert [row["step"] for row in rows(whole / "train.csv") if not row["loss"]] == ["8"]
    assert all(torch.equal(value, toy.seen[8][name]) for name, value in toy.seen[7].items())
    toy = Lost(CONFIG)
    toy.at = at
    with pytest.raises(BrokenOffError):
        train(toy, CONFIG, parts)
    toy = Lost(CONFIG)
    toy.at = -1
    train(toy, CONFIG, parts, resume=True)
    assert_same_bits(whole, parts)


def test_a_network_that_was_never_finite_is_told(tmp_path):
    class Lost(Toy):
        def losses(self, module, batch):
            raise NonFiniteError("features (Net): expected finite values, got 1 of 2 that are not.")

    with pytest.raises(NonFiniteError, match=r"^features \(Net\)"):
        train(Lost(CONFIG), CONFIG, tmp_path)


def test_gradients_are_no_longer_than_the_clip_norm(tmp_path):
    lengths = []

    class Watched(Toy):
        def batch(self, step, part, parts):
            lengths.append(sum(p.grad.square().sum() for p in self.module.parameters() if p.grad is not None) ** 0.5)
            return super().batch(step, part, parts)

    config = replace(CONFIG, clip_norm=0.1)
    train(Watched(config), config, tmp_path)
    assert max(map(float, lengths[1:])) < 0.1001
    assert min(float(row["gradient_norm"]) for row in rows(tmp_path / "train.csv")) > 0.1


def test_tensorboard_shows_scalars_and_pictures_and_after_a_resume_no_step_twice(tmp_path):
    toy = InterruptedToy(CONFIG)
    toy.at = 24
    with pytest.raises(BrokenOffError):
        train(toy, CONFIG, tmp_path)
    train(Toy(CONFIG), CONFIG, tmp_path, resume=True)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [event.step for event in events.Scalars("train/loss")] == list(range(1, 31))
    assert [event.step for event in events.Scalars("validation/loss")] == [0, 10, 20, 30]
    (last,) = [event for event in events.Images("shifted") if event.step == 30]
    assert (last.width, last.height) == (8, 6)


def test_the_learning_rate_rises_over_the_warm_up_and_falls_to_its_final_share():
    config = TrainerConfig(steps=100, warmup_steps=20, learning_rate=0.4, final_share=0.1)
    rates = [learning_rate(config, step) for step in range(100)]
    assert all(later > sooner for sooner, later in pairwise(rates[:20]))
    assert all(later <= sooner for sooner, later in pairwise(rates[20:]))
    assert rates[0] == pytest.approx(0.02)
    assert max(rates) == 0.4
    assert rates[-1] == pytest.approx(0.04)
    assert learning_rate(replace(config, schedule="constant"), 99) == 0.4


@pytest.mark.parametrize(
    ("experiment", "settings", "sentence"),
    [
        ({}, {"watch": "rmse"}, "watch: expected one of loss, got rmse."),
        ({}, {"device": "cuda"}, "device: expected cpu, as PyTorch finds no CUDA device here, got cuda."),
        ({"losses": lambda *_: {"mse": torch.ones(())}}, {}, "losses: expected loss, with a gradient .*, got mse."),
        ({"losses": lambda *_: {"loss": torch.ones(())}}, {}, "losses: expected loss, with a gradient .*, got loss."),
        ({"module": nn.Tanh()}, {}, "module: expected parameters to learn, got none in Tanh."),
        ({"spec": {}}, {}, "config: expected _target_, the name of the network's class, got None."),
    ],
)
def test_what_an_experiment_breaks_is_told_in_one_sentence(tmp_path, experiment, settings, sentence):
    if settings.get("device") == "cuda" and torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    toy = Toy(CONFIG)
    for name, value in experiment.items():
        setattr(toy, name, value)
    with pytest.raises(InputError, match=f"^{sentence}$"):
        train(toy, replace(CONFIG, **settings), tmp_path)


def test_a_state_of_another_network_or_a_damaged_one_is_refused(tmp_path):
    train(Toy(CONFIG), CONFIG, tmp_path)
    with pytest.raises(InputError, match=r"expected the tensors of Sequential, got .* with .*\.$"):
        train(Toy(CONFIG, plain=True), CONFIG, tmp_path, resume=True)
    state = tmp_path / "state.safetensors"
    state.write_bytes(state.read_bytes()[:-5])
    with pytest.raises(InputError, match="expected a whole safetensors file"):
        train(Toy(CONFIG), CONFIG, tmp_path, resume=True)
    (tmp_path / "last.safetensors").replace(state)
    with pytest.raises(InputError, match="resume: expected the state of a training"):
        train(Toy(CONFIG), CONFIG, tmp_path, resume=True)


@pytest.mark.parametrize(
    "changes",
    [
        *({"step": value} for value in (None, -3, 1.5, True, "7", 2**70)),
        *({"best": value} for value in (math.nan, math.inf, "0.1", [])),
        {"best_step": 31}, {"skipped": -1}, {"skipped_in_a_row": 31}, {"without_better": 40},
        {"seconds": -1.0}, {"seconds": None}, {"watch": None}, {"losses": "loss"}, {"losses": [1]}, {"more": 1},
    ],
)  # fmt: skip
def test_a_state_that_cannot_be_is_refused_and_changes_nothing(uninterrupted, tmp_path, changes):
    tensors, metadata = read_tensors(uninterrupted / "state.safetensors")
    progress = json.loads(metadata["progress"]) | changes
    state = tmp_path / "state.safetensors"
    state.write_bytes(tensors_to_bytes(tensors, metadata | {"progress": json.dumps(progress)}))
    assert_refused_unchanged(state)


def assert_refused_unchanged(state: Path) -> None:
    toy = Toy(CONFIG)
    before = {name: value.clone() for name, value in toy.module.state_dict().items()}
    with pytest.raises(InputError, match=r"^resume: expected .*, got .*\.$"):
        train(toy, CONFIG, state.parent, resume=True)
    assert all(torch.equal(value, before[name]) for name, value in toy.module.state_dict().items())
    assert [path.name for path in state.parent.iterdir()] == ["state.safetensors"]


@pytest.mark.parametrize("key", ["step", "best", "watch"])
def test_a_state_without_a_field_is_refused(uninterrupted, tmp_path, key):
    tensors, metadata = read_tensors(uninterrupted / "state.safetensors")
    progress = {name: value for name, value in json.loads(metadata["progress"]).items() if name != key}
    state = tmp_path / "state.safetensors"
    state.write_bytes(tensors_to_bytes(tensors, metadata | {"progress": json.dumps(progress)}))
    assert_refused_unchanged(state)


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.pop("optimizer.0.exp_avg"),
        lambda t: [t.pop(f"optimizer.0.{name}") for name in ("step", "exp_avg", "exp_avg_sq")],
        lambda t: t.update({"optimizer.0.exp_avg": torch.zeros(())}),
        lambda t: t.update({"optimizer.0.step": torch.tensor(math.nan)}),
        lambda t: t.update({"optimizer.0.exp_avg_sq": -1 - t["optimizer.0.exp_avg_sq"]}),
        lambda t: t.update({"optimizer.99.step": t.pop("optimizer.0.step")}),
        lambda t: t.update({"optimizer.0.more": t.pop("optimizer.0.step")}),
    ],
)
def test_a_state_of_another_optimizer_is_refused(uninterrupted, tmp_path, change):
    tensors, metadata = read_tensors(uninterrupted / "state.safetensors")
    change(tensors)
    state = tmp_path / "state.safetensors"
    state.write_bytes(tensors_to_bytes(tensors, metadata))
    assert_refused_unchanged(state)


def test_checkpoints_without_a_state_are_not_resumed_and_stay(tmp_path):
    train(Toy(CONFIG), CONFIG, tmp_path)
    (tmp_path / "state.safetensors").unlink()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    with pytest.raises(
        InputError, match=r"^resume: expected state.safetensors beside the checkpoints in .*, got none.$"
    ):
        train(Toy(CONFIG), CONFIG, tmp_path, resume=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


def test_a_training_is_not_resumed_with_another_figure_to_watch(tmp_path):
    train(Toy(CONFIG), CONFIG, tmp_path)
    with pytest.raises(InputError, match=r"^watch: expected loss, by which .* its best, got -loss\.$"):
        train(Toy(CONFIG), replace(CONFIG, watch="-loss"), tmp_path, resume=True)


@pytest.mark.parametrize("name", ["state.safetensors", "train.csv"])
def test_what_a_kill_leaves_is_cleared_away(tmp_path, name):
    with atomic_path(tmp_path / name) as temporary:
        temporary.write_bytes(b"whole")
    temporary.write_bytes(b"half")  # of a second writing, which was killed
    (tmp_path / ".notes.part").write_text("of somebody else")
    train(Toy(CONFIG), replace(CONFIG, steps=1), tmp_path)
    assert not temporary.exists()
    assert (tmp_path / ".notes.part").exists()


def test_a_wrong_name_to_watch_leaves_an_earlier_training_as_it_was(uninterrupted, tmp_path):
    train(Toy(CONFIG), CONFIG, tmp_path)
    with pytest.raises(InputError, match=r"^watch: "):
        train(Toy(CONFIG), replace(CONFIG, watch="rmse"), tmp_path)
    assert_same_bits(uninterrupted, tmp_path)


def test_a_place_of_tensorboards_folder_that_is_taken_is_told(tmp_path):
    (tmp_path / "tensorboard").write_text("a file")
    with pytest.raises(InputError, match=r"^tensorboard: expected a folder to write to, got .*tensorboard: .*\.$"):
        train(Toy(CONFIG), CONFIG, tmp_path)


def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    with pytest.raises(InputError, match=r"^train.csv: expected a folder to write to, got .*\.$"):
        train(Toy(CONFIG), CONFIG, tmp_path / "absent")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps", 0), ("batch_size", 0), ("learning_rate", 0.0), ("learning_rate", math.nan), ("weight_decay", -1.0),
        ("warmup_steps", -1), ("final_share", 1.5), ("clip_norm", 0.0), ("max_skipped", 0), ("validate_every", 0),
        ("save_every", 0), ("watch", "-"), ("patience", 0), ("max_minutes", 0.0), ("seed", -1), ("device", "tpu"),
        ("precision", "16-mixed"), ("strategy", "fsdp"), ("schedule", "step"),
    ],
)  # fmt: skip
def test_a_setting_that_cannot_be_is_refused_by_its_name(name, value):
    with pytest.raises(InputError, match=f"^{name}: expected .*, got .*\\.$"):
        TrainerConfig(**{name: value})


def test_the_progress_bar_shows_the_losses_where_there_is_a_terminal(tmp_path, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    def slowly() -> bool:
        time.sleep(0.01)  # the bar is drawn every 0.1 s at most
        return False

    for progress, shown in ((True, True), (False, False)):
        monkeypatch.setattr(sys, "stderr", terminal := Terminal())
        train(Toy(CONFIG), replace(CONFIG, progress=progress), tmp_path, stopped=slowly)
        assert ("rmse=" in terminal.getvalue()) is shown


def test_importing_the_package_takes_no_extra():
    extras = ("lightning_fabric", "tensorboard", "safetensors", "hydra")
    code = f"import sys, torchvo360.learn; print([name for name in {extras} if name in sys.modules])"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True, timeout=60)
    assert done.stdout.decode().strip() == "[]"


@pytest.mark.parametrize(
    ("module", "extra"), [("lightning_fabric", "train"), ("torch.utils.tensorboard", "train"), ("safetensors", "learn")]
)
def test_the_extra_that_is_missing_is_named(tmp_path, monkeypatch, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"^\w+: expected .*pip install 'torchvo360\[{extra}\]' brings\.$"):
        train(Toy(CONFIG), CONFIG, tmp_path)
