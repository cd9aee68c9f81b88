"""From the words of `torchvo360-bench` to its jobs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra

from torchvo360.checks import InputError, check_choice
from torchvo360.cli import configuration
from torchvo360.cli import overrides as ours
from torchvo360.cli.benchmark.job import Job, is_finished, read_record
from torchvo360.cli.benchmark.suite import find_sequences
from torchvo360.evaluation.errors import ALIGNMENTS
from torchvo360.settings import MAX_SEED, SYNTHETIC

NAME = "torchvo360-bench"

DEFAULT = "default"

OF_A_RUN = ("input", "truth", "out", "overwrite", "seed", "vo", "progress")
"""Settings of a run that are the benchmark's own affair."""


@dataclass(kw_only=True)
class BenchConfig:
    """Settings of a benchmark; settings of a run beside them hold for all its runs."""

    dataset: str = SYNTHETIC
    """The name of a suite (conf/bench/suite), a list of sequences (.yaml), or a folder of them."""
    seeds: Any = 1
    """How many, counted from 0, or a list. A rendered sequence takes them for its world, too."""
    presets: Any = DEFAULT
    """Presets of the odometry (conf/vo), one or a list; default leaves what a sequence says of `vo`."""
    align: str = "sim3"
    """What is chosen to make estimate and truth agree: sim3, se3 or none."""
    out: str | None = None
    """Folder of the results; null for runs/bench/<date_time>. One that holds such a benchmark is gone on with."""

    def __post_init__(self) -> None:
        check_choice("align", self.align, ALIGNMENTS)
        if self.out == "":
            raise InputError("out: expected a folder, got an empty name.")
        seeds = [*range(self.seeds)] if isinstance(self.seeds, int) else self.seeds
        whole = isinstance(seeds, list) and all(type(seed) is int and 0 <= seed <= MAX_SEED for seed in seeds)
        if not whole or not seeds or len({*seeds}) < len(seeds):
            raise InputError(f"seeds: expected their number or a list of different ones, got {self.seeds!r}.")
        presets = self.presets if isinstance(self.presets, list) else [self.presets]
        if not presets or not all(type(preset) is str for preset in presets) or len({*presets}) < len(presets):
            raise InputError(f"presets: expected one or a list of different ones, got {self.presets!r}.")
        self.seeds, self.presets = seeds, presets


@dataclass(frozen=True)
class Plan:
    """What is to be done."""

    config: BenchConfig
    run_overrides: Sequence[str]
    """Settings of all runs."""
    hydra_overrides: Sequence[str]
    """The launcher and what it is to do."""


def parse(words: Sequence[str], conf: Path) -> Plan:
    """Tell the benchmark's own settings from those of its runs and from those of Hydra.

    Raises:
        InputError: A key or a value is not one of these.
    """
    own, runs, launcher = [], [], []
    for word in words:
        key, equal, value = word.partition("=")
        if not equal:
            raise InputError(f"{word}: expected key=value, such as dataset=synthetic, or --help.")
        if key in BenchConfig.__dataclass_fields__:
            own.append(ours.literal(word) if key in ("dataset", "out") else word)
        elif key == "cluster":
            launcher.append(f"train/cluster={value}")
        elif key.lstrip("+").startswith(("hydra.", "hydra/")):
            launcher.append(word)
        elif key in OF_A_RUN:
            instead = {"seed": "seeds", "vo": "presets", "out": "out as a folder"}.get(key, "dataset")
            raise InputError(f"{key}: expected {instead} in its place for a benchmark, got {word}.")
        else:
            runs.append(word)
    configuration.check_keys(runs)
    ours.check_keys(own, BenchConfig, [], example="seeds=5", printed_by=f"{NAME} --help")
    with ours.hydra_ready(BenchConfig, conf, "bench"):
        config = ours.resolved(ours.explained(hydra.compose, "schema", own))
    return Plan(config, runs, launcher)


def make_jobs(plan: Plan, folder: Path, conf: Path) -> list[Job]:
    """Return all jobs of a benchmark, the seeds of a sequence side by side.

    Raises:
        InputError: The dataset cannot be used, a preset or a setting of the runs is none, or the folder holds runs with
            other settings.
    """
    sequences = find_sequences(plan.config.dataset, conf / "bench" / "suite")
    of_runs = dict(text.split("=", 1) for text in plan.run_overrides)
    jobs: list[Job] = []
    for sequence in sequences:
        for preset in plan.config.presets:
            settings = {**sequence.overrides, **({} if preset == DEFAULT else {"vo": preset}), **of_runs}
            rendered = settings.get("input", "").strip("'") == SYNTHETIC
            for seed in plan.config.seeds:
                seeds = {"seed": str(seed)}
                if rendered and "synthetic.seed" not in settings:
                    seeds["synthetic.seed"] = str(seed)
                overrides = (f"{key}={value}" for key, value in {**settings, **seeds, "progress": "false"}.items())
                place = folder.resolve() / sequence.name / preset / f"seed_{seed}"
                jobs.append(Job(sequence.name, preset, seed, tuple(overrides), str(place)))
    for preset in plan.config.presets:
        _check_settings([job for job in jobs if job.preset == preset and job.seed == plan.config.seeds[0]], conf)
    for job in filter(is_finished, jobs):
        record = read_record(job.folder)
        if record is not None and tuple(record.overrides) != job.overrides:
            raise InputError(f"out: expected runs with these settings or a new folder, got {job.folder} with others.")
    return jobs


def _check_settings(jobs: Sequence[Job], conf: Path) -> None:
    """Refuse settings with which no sequence can be run; those that one alone has no use for are told in its line."""
    complaints = []
    for job in jobs:
        try:
            configuration.compose(job.overrides, conf)
            return
        except InputError as error:
            complaints.append(error)
    raise complaints[0]
