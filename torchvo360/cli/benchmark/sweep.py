"""A benchmark from its first job to its tables, by a launcher of Hydra's."""

import re
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType

from hydra.core.global_hydra import GlobalHydra

from torchvo360.checks import InputError
from torchvo360.cli import overrides as ours
from torchvo360.cli.benchmark.job import LONGEST_COMPLAINT, Job, forget_ending, has_ended, is_finished, start_job
from torchvo360.cli.benchmark.plan import NAME, BenchConfig, Plan, make_jobs, parse
from torchvo360.cli.benchmark.report import FINISHED, row_of, table_of_runs, table_of_sequences
from torchvo360.cli.command import conf_folder
from torchvo360.evaluation.table import write_table
from torchvo360.outputs import new_folder

FRUITLESS_LAUNCHES = 2
"""Launches in a row that may fail without any job's ending, before the benchmark gives up."""


def run(words: Sequence[str]) -> int:
    """Do the benchmark that the words behind the command's name ask for, and return the exit code.

    Raises:
        InputError: The words are not ours, or name what cannot be used; then nothing is done.
    """
    conf = conf_folder()
    plan = parse(words, conf)
    with new_folder(plan.config.out, Path("runs", "bench")) as folder:
        jobs = make_jobs(plan, folder, conf)
        waiting = [job for job in jobs if not is_finished(job)]
        if len(waiting) < len(jobs):
            print(f"{len(jobs) - len(waiting)} of {len(jobs)} runs are finished already.", flush=True)
        code = _do_all(plan, waiting, folder, conf)
        rows = [row_of(job, plan.config.align) for job in jobs]
        write_table(folder / "table.csv", table_of_runs(rows))
        write_table(folder / "table.md", table_of_sequences(rows, problems=True))
        print(f"\n{table_of_sequences(rows).as_text()}")
        for job, row in zip(jobs, rows, strict=True):
            if row["problem"]:
                print(f"{job.name}: {row['problem']}")
        print(f"results: {folder}", flush=True)
    if unfinished := sum(row["ending"] != FINISHED for row in rows):
        again = f"the same call with out={folder} goes on"
        print(f"{NAME}: not finished: {unfinished} of {len(jobs)} runs; {again}.", file=sys.stderr)
    return code or int(unfinished > 0)


def _do_all(plan: Plan, jobs: Sequence[Job], folder: Path, conf: Path) -> int:
    """Have the jobs done, and return 0, or 130 or 143 where a signal stopped them.

    A launcher that fails, as when one of its workers dies, is begun anew, until that gets no job done twice in a row.

    Raises:
        InputError: The launcher is not installed, or its settings are not its own.
    """
    for job in jobs:
        forget_ending(job)
    fruitless = 0
    while jobs and fruitless < FRUITLESS_LAUNCHES:
        ending = _launch(plan, jobs, folder, conf)
        if isinstance(ending, int):
            return ending
        print(f"{NAME}: the launcher failed: {ending}", file=sys.stderr)
        left = [job for job in jobs if not has_ended(job)]
        fruitless = fruitless + 1 if len(left) == len(jobs) else 0
        jobs = left
    return 0


def _launch(plan: Plan, jobs: Sequence[Job], folder: Path, conf: Path) -> int | str:
    """Have a launcher do the jobs; return 0, or 130 or 143 after a signal, or what the launcher said when it failed."""
    arguments = [*plan.hydra_overrides, f"hydra.sweep.dir={ours.quoted(str(folder.resolve()))}"]
    arguments.append(f"+job={','.join(str(number) for number in range(len(jobs)))}")
    try:
        with _sigterm_raises(), ours.hydra_ready(BenchConfig, conf, "bench"):
            hydra = GlobalHydra.instance().hydra
            assert hydra is not None
            task = partial(start_job, jobs=jobs)
            ours.explained(hydra.multirun, "bench/base", arguments, task_function=task, with_log_configuration=False)
    except InputError as error:
        if absent := re.match(r"hydra/launcher: .*, got ([a-z]+)", str(error)):
            brings = f"which pip install hydra-{absent[1]}-launcher brings"
            raise InputError(f"cluster: expected the launcher {absent[1]}, {brings}, got none.") from None
        raise InputError(str(error).removeprefix("train/")) from None
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except SystemExit as stopped:
        return stopped.code if isinstance(stopped.code, int) else 1
    except Exception as error:  # launchers raise what they like
        return " ".join(f"{type(error).__name__}: {error}".split()).partition(". ")[0][:LONGEST_COMPLAINT]
    return 0


@contextmanager
def _sigterm_raises() -> Iterator[None]:
    """Let SIGTERM end the sweep in good order, as Ctrl-C does; outside the main thread it acts as before."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
