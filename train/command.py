"""The command line that all training scripts share: settings, folder, signals, sweeps, and what the user reads.

Exit codes: 0 done, 1 a defect of the program or a training that diverged, 2 the caller's mistake (with one sentence),
130 and 143 stopped by Ctrl-C and SIGTERM (what was done is kept, `resume=true` continues it).
"""

import argparse
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import torch

from settings import SETTINGS, TrainingConfig, command_of, compose, to_yaml, write_settings
from sweep import run_sweep
from torchvo360.checks import InputError
from torchvo360.cli.command import conf_folder
from torchvo360.files import write_atomically
from torchvo360.learn import Ending, TrainOutcome
from torchvo360.learn.trainer import CHECKPOINTS, Experiment, train
from torchvo360.outputs import new_folder
from torchvo360.runner import StopSignals

Train = Callable[[Experiment], TrainOutcome]
"""`torchvo360.learn.train` with everything but the experiment given."""

Run = Callable[[Any, Path, Train], list[str]]
"""A training's own part: from its settings, its folder and `Train` to lines that the user reads at the end.

It makes the experiment, calls `Train` once and measures what was learned, if the outcome is a `success`. Under torchrun
every process calls it, and only the first (`is_first`) may write.
"""


def main(
    name: str,
    schema: type[TrainingConfig],
    run: Run,
    argv: Sequence[str] | None = None,
    *,
    conf: Path | None = None,
) -> int:
    """Run a training script with its arguments and return the exit code.

    Args:
        name: Of the script, train/NAME.py, and of its configuration, conf/train/NAME.yaml.
        schema: Its settings.
        run: What it does.
        argv: Arguments; None for those of the process.
        conf: Another folder than conf/train.
    """
    parser = argparse.ArgumentParser(f"train/{name}.py", description="Settings are key=value; -c prints them all.")
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    parser.add_argument("-m", "--multirun", action="store_true", help="run every combination of comma-separated values")
    parser.add_argument("-c", "--cfg", action="store_true", help="print the settings and do nothing else")
    arguments = parser.parse_args(argv)
    conf = conf_folder() / "train" if conf is None else conf
    try:
        if arguments.multirun:
            return run_sweep(name, schema, arguments.overrides, conf)
        config = compose(name, schema, arguments.overrides, conf)
        if arguments.cfg:
            print(to_yaml(config), end="")
            return 0
        return _train(name, config, run, _command(name, config, arguments.overrides))
    except InputError as error:
        print(f"train/{name}.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"train/{name}.py: interrupted.", file=sys.stderr)
        return 130


def _command(name: str, config: TrainingConfig, overrides: Sequence[str]) -> str:
    """Return the command that makes a training again from scratch, wherever its folder is."""
    kept = [text for text in overrides if text.partition("=")[0] not in ("out", "resume", "overwrite")]
    if not config.resume or config.out is None:
        return shlex.join(["python", f"train/{name}.py", *kept])
    return " ".join([command_of(config.out), *map(shlex.quote, kept)])


def _train(name: str, config: TrainingConfig, run: Run, command: str) -> int:
    """Do one training, say what came of it, and return the exit code."""
    if config.threads is not None:
        torch.set_num_threads(config.threads)
        cv2.setNumThreads(config.threads)
    outcomes: list[tuple[TrainOutcome, signal.Signals | None]] = []
    with _folder(name, config) as folder:

        def train_here(experiment: Experiment) -> TrainOutcome:
            with _settings_in(folder, config, command), _stop_signals() as stop:
                outcome = train(
                    experiment,
                    config.trainer,
                    folder,
                    resume=config.resume,
                    made_by=command,
                    stopped=lambda: stop.received is not None,
                )
            outcomes.append((outcome, stop.received))
            return outcome

        torch.manual_seed(config.trainer.seed)  # of the network's first weights
        lines = run(config, folder, train_here)
    ((outcome, received),) = outcomes
    if is_first():
        print("\n".join([_summary(name, config, outcome), *lines, f"results: {folder}"]), flush=True)
    if outcome.ending is Ending.DIVERGED:
        got = f"{config.trainer.max_skipped} steps in a row without; a lower trainer.learning_rate may help"
        print(f"train/{name}.py: training: expected finite losses and gradients, got {got}.", file=sys.stderr)
        return 1
    return 128 + received if outcome.ending is Ending.STOPPED and received else 0


@contextmanager
def _settings_in(folder: Path, config: TrainingConfig, command: str) -> Iterator[None]:
    """Write the settings into a training's folder; where the training is refused, they are as they were before."""
    if not is_first():
        yield
        return
    path = folder / SETTINGS
    before = path.read_bytes() if path.exists() else None
    write_settings(folder, config, command)
    try:
        yield
    except InputError:
        if before is None:
            path.unlink()
        else:
            write_atomically(path, before)
        raise


def _stop_signals() -> StopSignals:
    if "RANK" in os.environ:
        # torchrun passes a signal on to its processes, which may have had it from the terminal already: a second one
        # is not to end them before they have saved.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return StopSignals()


def _summary(name: str, config: TrainingConfig, outcome: TrainOutcome) -> str:
    best = "never finite" if outcome.best is None else f"{outcome.best:.4g} at step {outcome.best_step}"
    skipped = f", {outcome.skipped} of them skipped" if outcome.skipped else ""
    watched = config.trainer.watch.removeprefix("-")
    done = f"{outcome.steps} steps in {outcome.seconds:.0f} s{skipped}"
    return f"{name}: {done}; {outcome.ending}. best {watched}: {best}"


def is_first() -> bool:
    """Return whether this is the only process, or the first of those that torchrun started: the one that writes."""
    return os.environ.get("RANK", "0") == "0"


@contextmanager
def _folder(name: str, config: TrainingConfig) -> Iterator[Path]:
    """Make the folder of a training.

    Raises:
        InputError: It cannot be written, holds another training, or processes would not agree on it.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and config.out is None:
        raise InputError("out: expected a folder, as several processes are to agree on it, got null.")
    if not is_first():
        assert config.out is not None
        yield Path(config.out).expanduser()
        return
    with new_folder(config.out, Path("runs", "train", name)) as folder:
        if not (config.resume or config.overwrite) and any((folder / name).exists() for name in CHECKPOINTS):
            expected = "a folder without a training, resume=true or overwrite=true"
            raise InputError(f"out: expected {expected}, got {folder}, which holds one.")
        settings = folder / SETTINGS
        if not config.resume and settings.exists() and not settings.read_bytes().startswith(b"# python "):
            raise InputError(f"out: expected a new folder or a training's, got {folder}, which is that of another run.")
        yield folder
