"""A sweep: every combination of settings is a training of its own, started where Hydra's launcher says."""

import os
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import cast

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from settings import check_keys, composed, hydra_ready
from torchvo360.checks import InputError
from torchvo360.cli.command import ENVIRONMENT
from torchvo360.cli.overrides import quoted
from torchvo360.outputs import new_folder


def run_sweep(name: str, schema: type, overrides: Sequence[str], conf: Path) -> int:
    """Run every combination, each into a numbered folder of its own, and return the worst exit code.

    A job is the script in a process of its own, so that a launcher has nothing to pass on but words. One that fails by
    the caller's mistake does not keep the others from running; one that is stopped does.

    Raises:
        InputError: The overrides are no sweep of ours, or its folder cannot be written or holds files.
    """
    check_keys(schema, overrides)
    out = next((text.removeprefix("out=") for text in reversed(overrides) if text.startswith("out=")), None)
    if out is not None and "," in out:
        raise InputError(f"out: expected one folder for the whole sweep, got {out}.")
    script = Path(getattr(sys.modules["__main__"], "__file__", None) or "").resolve()
    # A launcher's workers on other machines import this module; PYTHONPATH travels with the environment.
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    os.environ["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
    with new_folder(out, Path("runs", "train", name, "sweep")) as folder, hydra_ready(schema, conf):
        if any(folder.iterdir()):
            raise InputError(f"out: expected a new or empty folder for a sweep, got {out}, which holds files.")
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        arguments = [text for text in overrides if not text.startswith("out=")]
        arguments.append(f"hydra.sweep.dir={quoted(str(folder.resolve()))}")
        job = partial(start_job, script=str(script))
        try:
            batches = composed(name, hydra.multirun, arguments, task_function=job, with_log_configuration=False)
        except SystemExit as stopped:
            return cast("int", stopped.code)
        finally:
            if not any(path.is_dir() for path in folder.iterdir()):  # no job left anything
                (folder / "multirun.yaml").unlink(missing_ok=True)
        print(f"results: {folder}")
        return max(job.return_value for batch in batches for job in batch)


def start_job(_: DictConfig, script: str) -> int:
    """Run one training of a sweep, in a process of its own, and return its exit code.

    Raises:
        SystemExit: It was stopped by a signal: the jobs that wait are not to be started.
    """
    hydra = HydraConfig.get()
    overrides = [text for text in hydra.overrides.task if not text.startswith("cluster=")]
    out = f"out={Path(hydra.sweep.dir, str(hydra.job.num))}"
    # The bars of jobs side by side would overwrite each other.
    arguments = [*overrides, out, "trainer.progress=false"]
    print(f"job {hydra.job.num}: {' '.join(overrides)}", flush=True)
    with subprocess.Popen([sys.executable, script, *arguments], env=ENVIRONMENT | os.environ) as process:
        while True:
            try:
                code = process.wait()
                break
            except KeyboardInterrupt:  # the job has it from the terminal, too, and is saving what it did
                continue
    if code > 128 or code < 0:
        raise SystemExit(code)
    return code
