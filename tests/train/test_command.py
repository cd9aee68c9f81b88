"""The command line of trainings: settings, folders, signals, resuming, sweeps, and one sentence for each mistake."""

import os
import shutil
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
import yaml
from toy_training import ToyConfig, run

from command import main
from features import FeaturesConfig
from features import run as features_run
from torchvo360.learn.checkpoint import read_config, read_tensors

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def conf(tmp_path_factory) -> Path:
    """The configuration of trainings, with one for the toy."""
    folder = tmp_path_factory.mktemp("conf") / "train"
    shutil.copytree(ROOT / "conf" / "train", folder)
    trainer = {"steps": 12, "validate_every": 4, "save_every": 5, "warmup_steps": 2, "progress": False}
    settings = {"defaults": ["base", "_self_"], "trainer": trainer}
    (folder / "toy.yaml").write_text(yaml.safe_dump(settings))
    return folder


@pytest.fixture
def toy(conf, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: main("toy", ToyConfig, run, arguments, conf=conf)


def assert_same_network(first: Path, second: Path) -> None:
    one, other = (read_tensors(folder / "last.safetensors")[0] for folder in (first, second))
    assert all(torch.equal(value, other[name]) for name, value in one.items())


def test_a_training_leaves_its_checkpoints_settings_and_closing_lines(toy, tmp_path, capsys):
    assert toy("out=a b=c", "trainer.seed=3") == 0
    folder = tmp_path / "a b=c"
    said = capsys.readouterr()
    assert said.err == ""
    assert said.out.startswith("toy: 12 steps in ")
    assert said.out.endswith("it was measured\nresults: a b=c\n")
    text = (folder / "config.yaml").read_text()
    assert text.startswith("# python train/toy.py trainer.seed=3\n")
    assert yaml.safe_load(text)["trainer"]["seed"] == 3
    assert read_config(folder / "best")["made_by"] == "python train/toy.py trainer.seed=3"


def test_without_a_folder_it_is_named_by_script_and_time(toy, tmp_path):
    assert toy("trainer.steps=1") == 0
    (folder,) = (tmp_path / "runs" / "train" / "toy").iterdir()
    assert (folder / "best.safetensors").is_file()


def test_a_training_stopped_by_sigterm_goes_on_with_its_own_settings_to_the_same_bits(toy, tmp_path, capsys):
    assert toy("out=whole", "trainer.seed=1", "trainer.learning_rate=0.01") == 0
    assert toy("out=broken", "trainer.seed=1", "trainer.learning_rate=0.01", "stop_at=6") == 128 + signal.SIGTERM
    said = capsys.readouterr().out
    assert "7 steps" in said
    assert said.count("it was measured") == 1
    assert toy("out=broken", "resume=true", "stop_at=null") == 0
    assert_same_network(tmp_path / "whole", tmp_path / "broken")
    made_by = "python train/toy.py trainer.seed=1 trainer.learning_rate=0.01 stop_at=6 stop_at=null"
    assert read_config(tmp_path / "broken" / "last")["made_by"] == made_by


def test_resuming_takes_what_is_given_anew_and_keeps_the_rest(toy, tmp_path):
    assert toy("out=run", "trainer.seed=5", "trainer.steps=3") == 0
    assert toy("out=run", "resume=true", "trainer.steps=4") == 0
    settings = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert (settings["trainer"]["steps"], settings["trainer"]["seed"]) == (4, 5)
    assert read_config(tmp_path / "run" / "last")["figures"]["steps"] == 4


def test_overwriting_begins_anew(toy, tmp_path):
    assert toy("out=first", "trainer.seed=1") == 0
    assert toy("out=second", "trainer.seed=2") == 0
    assert toy("out=second", "trainer.seed=1", "overwrite=true") == 0
    assert_same_network(tmp_path / "first", tmp_path / "second")


def test_a_training_begun_by_overwriting_can_be_resumed(toy, tmp_path):
    assert toy("out=run", "trainer.steps=2", "overwrite=true") == 0
    assert toy("out=run", "resume=true", "trainer.steps=3") == 0
    assert read_config(tmp_path / "run" / "last")["figures"]["steps"] == 3


def test_a_refused_call_leaves_the_settings_as_they_were(toy, tmp_path, capsys):
    assert toy("out=run", "trainer.steps=2") == 0
    before = (tmp_path / "run" / "config.yaml").read_bytes()
    assert toy("out=run", "resume=true", "trainer.steps=5", "trainer.watch=nonsense") == 2
    assert (tmp_path / "run" / "config.yaml").read_bytes() == before
    assert toy("out=run", "resume=true", "trainer.steps=3") == 0


def test_a_run_of_the_command_is_not_written_over(toy, tmp_path, capsys):
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "config.yaml").write_text("input: walk.mp4\n")
    assert toy("out=walk") == 2
    assert "another run" in capsys.readouterr().err
    assert (tmp_path / "walk" / "config.yaml").read_text() == "input: walk.mp4\n"


def test_a_folder_to_resume_is_not_trusted_to_name_a_class(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stranger").mkdir()
    given = "# python train/features.py\nfeatures:\n  _target_: os.mkdir\n  path: broken_in\n"
    (tmp_path / "stranger" / "config.yaml").write_text(given)
    assert main("features", FeaturesConfig, features_run, ["out=stranger", "resume=true"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("train/features.py: features._target_: expected to be given again")
    assert "os.mkdir" in said
    assert not (tmp_path / "broken_in").exists()


def test_a_training_that_diverges_says_so_and_fails(toy, capsys):
    assert toy("out=run", "spoiled=true", "trainer.max_skipped=4") == 1
    said = capsys.readouterr()
    assert "4 steps" in said.out
    assert "it was measured" not in said.out
    assert said.err.startswith("train/toy.py: training: expected finite losses and gradients, got 4 steps in a row")


def test_settings_are_printed_and_nothing_is_done(toy, tmp_path, capsys):
    assert toy("-c", "trainer.steps=7") == 0
    assert yaml.safe_load(capsys.readouterr().out)["trainer"]["steps"] == 7
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["trainer.stepss=3"], "trainer.stepss: expected a known key such as trainer.steps, got trainer.stepss=3."),
        (["nonsense"], "nonsense: expected key=value, such as trainer.steps=1000."),
        (["trainer.steps=many"], "trainer.steps: expected an integer, got many."),
        (["trainer.steps=0"], "trainer.steps: expected at least 1, got 0."),
        (["trainer.seed=1,2"], "trainer.seed: expected one value (or a list [...], or -m for a sweep), got 1,2."),
        (["threads=0"], "threads: expected at least 1, got 0."),
        (["refuse=true"], "refuse: expected false, got true."),
        (["out="], "out: expected a folder, got an empty name."),
        (["out=/dev/null/x"], "out: expected a folder that can be written, got /dev/null/x: Not a directory."),
        (["resume=true"], "out: expected the folder of the training to resume, got null."),
        (["resume=true", "out=absent"], "out: expected a folder with a training to resume, got absent."),
        (["resume=true", "out=damaged"], "out: expected settings in damaged/config.yaml, got a damaged file."),
        (["resume=true", "out=other"], "settings: expected values that fit their keys, got: Key 'speed' not in "),
        (["resume=true", "overwrite=true", "out=taken"], "overwrite: expected false where resume=true, got true."),
        (["out=taken"], "out: expected a folder without a training, resume=true or overwrite=true, got taken, which"),
        (["cluster=absent"], "cluster: expected one of joblib, none, ray, submitit, got absent."),
        (["-m", "out=a,b"], "out: expected one folder for the whole sweep, got a,b."),
        (["-m", "trainer.sed=1,2"], "trainer.sed: expected a known key such as trainer.seed, got trainer.sed=1,2."),
    ],
)
def test_a_mistake_is_told_in_one_sentence_and_leaves_nothing(toy, tmp_path, capsys, arguments, sentence):
    before = {"damaged": "a: [", "other": "speed: 3", "taken": "resume: false"}
    for name, text in before.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").write_text(text)
    (tmp_path / "taken" / "best.json").touch()
    assert toy(*arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"train/toy.py: {sentence}")
    assert said.err.count("\n") == 1
    left = {path.name: (path / "config.yaml").read_text() for path in tmp_path.iterdir()}
    assert left == before


def test_several_processes_need_a_folder_in_common(toy, monkeypatch, capsys):
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert toy() == 2
    assert "out: expected a folder, as several processes are to agree on it" in capsys.readouterr().err


@pytest.mark.slow
def test_a_sweep_runs_every_combination_in_a_folder_of_its_own_through_joblib(conf, tmp_path):
    paths = [str(ROOT), str(ROOT / "train"), str(Path(__file__).parent)]
    command = [sys.executable, str(Path(__file__).with_name("toy_training.py")), "-m"]
    sweep = ["hydra.launcher.n_jobs=2", "trainer.seed=1,2", "out=sweep"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1", "TOY_CONF": str(conf)}
    options = {
        "cwd": tmp_path,
        "env": environment,
        "capture_output": True,
        "text": True,
        "timeout": 180,
        "check": False,
    }
    done = subprocess.run([*command, *sweep], **options)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("results: sweep\n")
    for number in (0, 1):
        settings = yaml.safe_load((tmp_path / "sweep" / str(number) / "config.yaml").read_text())
        assert settings["trainer"]["seed"] == number + 1
        assert (tmp_path / "sweep" / str(number) / "best.safetensors").is_file()


@pytest.mark.parametrize("cluster", ["submitit", "ray"])
def test_a_cluster_without_its_launcher_is_told_with_what_brings_it(toy, capsys, cluster):
    if find_spec(f"hydra_plugins.hydra_{cluster}_launcher"):
        pytest.skip("it is installed")
    assert toy("-m", f"cluster={cluster}", "trainer.seed=1,2") == 2
    said = capsys.readouterr().err
    assert f"cluster: expected the launcher {cluster}, which pip install hydra-{cluster}-launcher brings" in said
