"""Several processes: what torchrun starts unchanged learns what one process learns from the joint batch."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_trainer import CONFIG, rows, weights
from toy_experiment import LostToy, Toy

from torchvo360.checks import InputError
from torchvo360.learn import train

SCRIPT = Path(__file__).with_name("toy_experiment.py")


def torchrun(folder: Path, what: str = "plain") -> None:
    """Run a toy in two processes of this machine, and leave none behind whatever happens."""
    environment = os.environ | {
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(sys.path),
        "GLOO_SOCKET_IFNAME": "lo",  # nothing beyond this machine
    }
    options = ["--nproc-per-node=2", "--rdzv-backend=c10d", "--rdzv-endpoint=localhost:0", "--local-addr=localhost"]
    command = [sys.executable, "-m", "torch.distributed.run", *options, str(SCRIPT), what, str(folder)]
    with (folder / "said.txt").open("w") as said:
        process = subprocess.Popen(command, env=environment, stdout=said, stderr=subprocess.STDOUT)
        try:
            code = process.wait(timeout=120)
        finally:
            process.terminate()  # torchrun ends its processes, which are in sessions of their own
            process.wait(timeout=60)
    assert code == 0, (folder / "said.txt").read_text()


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the loopback interface bears another name")
def test_two_processes_learn_what_one_learns_from_the_joint_batch(tmp_path):
    (one := tmp_path / "one").mkdir()
    (two := tmp_path / "two").mkdir()
    train(Toy(CONFIG, plain=True, dtype=torch.float64), CONFIG, one)
    torchrun(two)
    for name, value in weights(one, "state").items():
        torch.testing.assert_close(weights(two, "state")[name], value, atol=1e-11, rtol=1e-9, msg=name)
    for name in ("loss", "rmse", "gradient_norm"):
        single, joint = ([float(row[name]) for row in rows(folder / "train.csv")] for folder in (one, two))
        if name != "rmse":  # a mean of square roots
            assert joint == pytest.approx(single, rel=1e-7)
    assert {path.name for path in one.iterdir()} == {path.name for path in two.iterdir()} - {"said.txt"}
    assert len(list((two / "tensorboard").iterdir())) == 1  # only the first process writes


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the loopback interface bears another name")
def test_a_step_that_is_not_finite_in_one_process_is_skipped_by_all(tmp_path):
    (one := tmp_path / "one").mkdir()
    (two := tmp_path / "two").mkdir()
    train(LostToy(CONFIG, plain=True, dtype=torch.float64), CONFIG, one)
    torchrun(two, "lost")
    for folder in (one, two):
        assert [row["step"] for row in rows(folder / "train.csv") if not row["loss"]] == ["13"]
    for name, value in weights(one, "state").items():
        torch.testing.assert_close(weights(two, "state")[name], value, atol=1e-11, rtol=1e-9, msg=name)


def test_a_batch_without_equal_shares_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "3")
    with pytest.raises(InputError, match=r"^batch_size: expected a multiple of 3 processes, got 4\.$"):
        train(Toy(CONFIG), CONFIG, tmp_path)


def test_the_shares_of_all_processes_are_the_batch():
    config = replace(CONFIG, batch_size=12)
    for parts in (1, 2, 3, 12):
        shares = [index for part in range(parts) for index in config.share(part, parts)]
        assert shares == list(range(12))
