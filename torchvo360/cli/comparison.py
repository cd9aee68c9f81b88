"""From the words of `torchvo360-eval` to a table: run folders and trajectory files against true poses."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra

from torchvo360.checks import InputError, check_choice, check_finite_number
from torchvo360.cli import overrides as ours
from torchvo360.cli.command import conf_folder
from torchvo360.cli.run_folder import truth_of
from torchvo360.data import Trajectory
from torchvo360.data.tum import read_tum
from torchvo360.evaluation import evaluate
from torchvo360.evaluation.errors import ALIGNMENTS
from torchvo360.evaluation.estimate import read_estimate
from torchvo360.evaluation.figures import FIGURES, Column, Row, error_figures, run_figures, summary_rows
from torchvo360.evaluation.table import Table, check_table_path, write_table

NAME = "torchvo360-eval"


@dataclass(kw_only=True)
class EvaluateConfig:
    """Settings of an evaluation; `truth` and `out`, which may be given several times, stand beside them."""

    align: str = "sim3"
    """What is chosen to make the positions agree: sim3, se3 or none."""
    frames: int = 10
    """Poses from the beginning to the end of a relative motion."""
    metres: float | None = None
    """True path from the beginning to the end of one; None for a tenth of it all."""
    lengths: Any = None
    """Sub-lengths of the true path for the drift, metres; None for 10 to 50 % of it."""

    def options(self) -> dict[str, Any]:
        """Return the arguments of `evaluate`."""
        return {"align": self.align, "rpe_frames": self.frames, "rpe_metres": self.metres, "lengths": self.lengths}


@dataclass(frozen=True)
class Call:
    """What was asked for."""

    estimates: Sequence[str]
    truths: Sequence[str]
    """One for all, one for each, or none."""
    outs: Sequence[str]
    config: EvaluateConfig


def run(words: Sequence[str]) -> int:
    """Evaluate what the words behind the command's name ask for, and return the exit code.

    What cannot be evaluated or written is told and does not keep the others from it.

    Raises:
        InputError: The words are not ours, or a truth for all cannot be read.
    """
    call = parse(words)
    one_truth = _read_truth(call.truths[0]) if len(call.truths) == 1 else None
    rows: list[Row] = []
    complaints = []
    for number, path in enumerate(call.estimates):
        try:
            truth = _read_truth(call.truths[number]) if len(call.truths) > 1 else one_truth
            rows.append(_row(path, truth, call.config))
        except InputError as error:
            complaints.append(str(error))
    if rows:
        summary = summary_rows(rows, "name") if len(rows) > 1 else []
        table = Table([Column("name", "name"), *FIGURES], rows, summary)
        print(f"{caption(call.config, rows)}\n\n{table.as_text()}", end="", flush=True)
        for out in call.outs:
            try:
                write_table(out, table)
            except InputError as error:
                complaints.append(str(error))
    for complaint in complaints:
        print(f"{NAME}: {complaint}", file=sys.stderr)
    return 2 if complaints else 0


def parse(words: Sequence[str]) -> Call:
    """Tell estimates, truths, tables and settings apart: a word is a setting if it has a = and names no file.

    Raises:
        InputError: A key or a value is not one of ours, there is nothing to evaluate, or truths do not go with it.
    """
    estimates = [word for word in words if "=" not in word or Path(word).expanduser().exists()]
    settings = [word for word in words if word not in estimates]
    if option := next((word for word in estimates if word.startswith("-")), None):
        raise InputError(f"{option}: expected a run's folder, a trajectory, key=value or --help.")
    truths, outs, overrides = [], [], []
    for word in settings:
        key, _, value = word.partition("=")
        {"truth": truths, "out": outs}.get(key, overrides).append(value if key in ("truth", "out") else word)
    for out in outs:
        check_table_path(out)
    if not truths and len(estimates) > 1 and not Path(estimates[-1]).expanduser().is_dir():
        truths = [estimates.pop()]
    if not estimates:
        raise InputError(f"runs: expected run folders or trajectory files ({NAME} --help), got none.")
    if len(truths) not in (0, 1, len(estimates)):
        raise InputError(f"truth: expected one for all or {len(estimates)}, one for each, got {len(truths)}.")
    return Call(estimates, truths, outs, _settings(overrides))


def _settings(overrides: Sequence[str]) -> EvaluateConfig:
    ours.check_keys(overrides, EvaluateConfig, ["truth", "out"], example="align=se3", printed_by=f"{NAME} --help")
    with ours.hydra_ready(EvaluateConfig, conf_folder(), "evaluate"):
        config = ours.resolved(ours.explained(hydra.compose, "schema", overrides))
    check_choice("align", config.align, ALIGNMENTS)
    if config.frames < 1:
        raise InputError(f"frames: expected at least 1, got {config.frames}.")
    if config.metres is not None:
        check_finite_number("metres", config.metres, above=0.0)
    if config.lengths is not None and not (isinstance(config.lengths, list) and config.lengths):
        raise InputError(f"lengths: expected a list of metres such as [1,2,5], got {config.lengths}.")
    for length in config.lengths or []:
        check_finite_number("lengths", length, above=0.0)
    return config


def caption(config: EvaluateConfig, rows: Sequence[Row]) -> str:
    """Return what the columns of the table rest on; a short estimate has its RPE over fewer poses than asked for."""
    lengths = "10 to 50 % of the path"
    if config.lengths is not None:
        lengths = ", ".join(f"{length:g}" for length in config.lengths) + " m"
    frames = sorted({row["rpe_frames"] for row in rows if isinstance(row["rpe_frames"], int)})
    over = f"RPE over {' to '.join(map(str, frames[:1] + frames[1:][-1:]))} poses, drift over {lengths}"
    return f"Alignment {config.align}; ATE and RPE are root mean squares; {over}."


def _row(path: str, truth: Trajectory | None, config: EvaluateConfig) -> Row:
    estimate = read_estimate(path)
    if truth is None and Path(path).expanduser().is_dir():
        truth = truth_of(path)
    if truth is None:
        raise InputError(f"{path}: expected truth=FILE, as it has no true poses of its own, got none.")
    try:
        evaluation = evaluate(estimate.trajectory, truth, **config.options())
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return {"name": estimate.name, **run_figures(estimate), "align": config.align, **error_figures(evaluation)}


def _read_truth(path: str) -> Trajectory:
    if not path:
        raise InputError("truth: expected a TUM file, got an empty name.")
    try:
        return read_tum(path)
    except InputError as error:
        raise InputError(f"truth: {error}") from None
