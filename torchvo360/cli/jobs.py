"""One run, or a sweep over many by Hydra's sweeper and launcher."""

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import cast

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from torchvo360.checks import InputError
from torchvo360.cli.configuration import check_keys, compose, explained, hydra_ready
from torchvo360.cli.overrides import quoted, to_yaml
from torchvo360.outputs import new_folder
from torchvo360.runner import run
from torchvo360.settings import RunConfig


def run_one(config: RunConfig, title: str = "") -> int:
    """Do one run, say what came of it under a title, and return the exit code.

    Raises:
        InputError: The caller's mistake.
    """
    outcome = run(config, config_yaml=to_yaml(config))
    if outcome.lines:
        print("\n".join([title] * bool(title) + outcome.lines), flush=True)
    if outcome.complaint:
        print(f"torchvo360: {outcome.complaint}", file=sys.stderr)
    return outcome.exit_code


def run_sweep(overrides: Sequence[str], conf: Path) -> int:
    """Run every combination, each into a numbered folder of its own, and return the worst exit code.

    A job that fails by the caller's mistake does not keep the others from running; one that is stopped does.

    Raises:
        InputError: The overrides are no sweep of ours, or its folder cannot be written or holds files.
    """
    check_keys(overrides)
    out = next((text.removeprefix("out=") for text in reversed(overrides) if text.startswith("out=")), None)
    if out is not None and "," in out:
        raise InputError(f"out: expected one folder for the whole sweep, got {out}.")
    with new_folder(out, Path("runs", "sweep")) as folder, hydra_ready(conf):
        if any(folder.iterdir()):
            raise InputError(f"out: expected a new or empty folder for a sweep, got {out}, which holds files.")
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        arguments = [text for text in overrides if not text.startswith("out=")]
        arguments.append(f"hydra.sweep.dir={quoted(str(folder))}")
        try:
            job = partial(_job, conf=conf)
            batches = explained(hydra.multirun, arguments, task_function=job, with_log_configuration=False)
        except SystemExit as stopped:
            return cast("int", stopped.code)
        finally:
            if not any(path.is_dir() for path in folder.iterdir()):  # no job left anything
                (folder / "multirun.yaml").unlink(missing_ok=True)
        return max(job.return_value for batch in batches for job in batch)


def _job(_: DictConfig, conf: Path) -> int:
    """Do one run of a sweep; in this process or in another one, where a launcher puts it there."""
    hydra = HydraConfig.get()
    number = hydra.job.num
    overrides = list(hydra.overrides.task)
    try:
        config = compose(overrides, conf)
        config.out = str(Path(hydra.sweep.dir, str(number)))
        code = run_one(config, f"\njob {number}: {' '.join(overrides)}")
    except InputError as error:
        print(f"torchvo360: job {number}: {error}", file=sys.stderr)
        return 2
    if code > 128:  # by a signal: the jobs that wait are not to be started
        raise SystemExit(code)
    return code
