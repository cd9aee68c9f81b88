"""One run of a benchmark, in a process of its own: its death is a line in the table, and not the benchmark's.

The folder of a job holds the run's results, what it said (log.txt), and a record (job.json) of how its process ended. A
launcher's workers import this module.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from torchvo360.cli.command import ENVIRONMENT
from torchvo360.files import write_atomically

LOG, RECORD, SUMMARY = "log.txt", "job.json", "summary.json"

LONGEST_COMPLAINT = 300
"""Characters of a log's last line that stand in the table."""


@dataclass(frozen=True)
class Job:
    """A run that is to be done."""

    sequence: str
    preset: str
    seed: int
    overrides: tuple[str, ...]
    """Its settings, but for the folder of the results."""
    folder: str

    @property
    def name(self) -> str:
        """What the user calls it."""
        return f"{self.sequence}, {self.preset}, seed {self.seed}"


@dataclass(frozen=True)
class JobRecord:
    """How the process of a job ended."""

    overrides: Sequence[str]
    code: int | None
    """Its exit code, negative for the signal that killed it; None while it runs, or where nobody saw its end."""
    seconds: float
    complaint: str
    """One sentence on what went wrong."""


def read_record(folder: str) -> JobRecord | None:
    """Return the record of a job; None where there is none that can be read."""
    try:
        return JobRecord(**json.loads(Path(folder, RECORD).read_text(encoding="utf-8")))
    except (OSError, TypeError, ValueError):
        return None


def is_finished(job: Job) -> bool:
    """Return whether the run is complete: its process ended well, and its summary can be read."""
    record = read_record(job.folder)
    try:
        json.loads(Path(job.folder, SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return record is not None and record.code == 0


def has_ended(job: Job) -> bool:
    """Return whether the end of the job's process was seen, since `forget_ending`."""
    record = read_record(job.folder)
    return record is not None and record.code is not None


def forget_ending(job: Job) -> None:
    """Take back what is recorded of an earlier process of the job, which is to be done anew."""
    if read_record(job.folder) is not None:
        _write(Path(job.folder), JobRecord(job.overrides, None, 0.0, ""))


def start_job(config: DictConfig, jobs: Sequence[Job]) -> int:
    """Do the run that the sweep's key `job` counts, and return the exit code of its process.

    What a half done run left in its folder goes first. Where this process is told to stop, the run is killed: it is
    done anew when the benchmark goes on.
    """
    job = jobs[config.job]
    folder = Path(job.folder)
    if (folder / RECORD).is_file():
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder, JobRecord(job.overrides, None, 0.0, ""))
    began = time.monotonic()
    # before OpenMP starts there: runs side by side would else take every core each
    environment = {"OMP_NUM_THREADS": "1"} | ENVIRONMENT | os.environ
    command = [sys.executable, "-m", "torchvo360", *job.overrides, f"out={job.folder}"]
    with (folder / LOG).open("wb") as log:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)
        try:
            code = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
    seconds = time.monotonic() - began
    complaint = _complaint(folder, code)
    _write(folder, JobRecord(job.overrides, code, seconds, complaint))
    ending = f"failed: {complaint}" if code else f"done in {seconds:.1f} s"
    print(f"[{HydraConfig.get().job.num + 1}/{len(jobs)}] {job.name}: {ending}", flush=True)
    return code


def _complaint(folder: Path, code: int) -> str:
    """Return what a process said or died of, in one sentence; empty where all went well."""
    if code == 0:
        return ""
    if code < 0 or code > 128:
        number = -code if code < 0 else code - 128
        name = f"signal {number}"
        with suppress(ValueError):
            name = signal.Signals(number).name
        return f"killed by {name}" + ", as for want of memory" * (number == signal.SIGKILL)
    lines = (folder / LOG).read_text(encoding="utf-8", errors="replace").split("\n")
    said = [line.strip() for line in lines if line.strip()] or [f"ended with exit code {code}"]
    own = [line for line in said if line.startswith("torchvo360: ")] or said
    return own[-1].removeprefix("torchvo360: ")[:LONGEST_COMPLAINT]


def _write(folder: Path, record: JobRecord) -> None:
    content: dict[str, Any] = asdict(record)
    write_atomically(folder / RECORD, json.dumps(content, indent=2) + "\n")
