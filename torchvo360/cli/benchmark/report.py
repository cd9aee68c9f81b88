"""The tables of a benchmark: every run, and medians over the seeds with what failed."""

import statistics
from collections.abc import Sequence
from pathlib import Path

from torchvo360.checks import InputError
from torchvo360.cli.benchmark.job import Job, is_finished, read_record
from torchvo360.cli.run_folder import TRUTH, truth_of
from torchvo360.evaluation import evaluate
from torchvo360.evaluation.estimate import read_estimate
from torchvo360.evaluation.figures import FIGURES, Column, Row, error_figures, run_figures, summary_rows
from torchvo360.evaluation.table import Table
from torchvo360.export import write_tum

FINISHED, FAILED = "finished", "failed"

NOT_DONE = "not done"
"""The process has not been started, or nobody saw its end."""

LABELS = ("sequence", "preset", "seed")


def row_of(job: Job, align: str) -> Row:
    """Return the figures of a job and how it ended; without errors where its input has no true poses."""
    row: Row = {"sequence": job.sequence, "preset": job.preset, "seed": job.seed}
    record = read_record(job.folder)
    if record is None or not is_finished(job):
        complaint = record.complaint if record is not None else ""
        return row | {"ending": FAILED if complaint else NOT_DONE, "problem": complaint or None}
    row |= {"ending": FINISHED, "problem": None, "seconds": record.seconds}
    try:
        estimate = read_estimate(job.folder)
        row |= run_figures(estimate)
        truth = truth_of(job.folder)
        if truth is None:
            return row | {"problem": "no true poses"}
        if not Path(job.folder, TRUTH).is_file():
            write_tum(Path(job.folder, TRUTH), truth)  # the input is not to be opened again for the next table
        return row | {"align": align} | error_figures(evaluate(estimate.trajectory, truth, align=align))
    except InputError as error:
        return row | {"ending": FAILED, "problem": str(error)}


def table_of_runs(rows: Sequence[Row]) -> Table:
    """Return the table of all runs, with a summary of each preset."""
    columns = [*(Column(label, label) for label in LABELS), Column("ending", "ending"), *FIGURES]
    return Table([*columns, Column("problem", "problem")], rows, _summary(rows))


def table_of_sequences(rows: Sequence[Row], *, problems: bool = False) -> Table:
    """Return the table of medians over the seeds, by sequence and preset, with a summary of each preset.

    Args:
        rows: Those of `row_of`.
        problems: Whether it has a column with what went wrong.
    """
    groups: dict[tuple[object, object], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["sequence"], row["preset"]), []).append(row)
    lines: list[Row] = []
    for group in groups.values():
        finished = [row for row in group if row["ending"] == FINISHED]
        line: Row = {label: group[0][label] for label in ("sequence", "preset")}
        for column in FIGURES:
            values = [value for row in finished if isinstance(value := row.get(column.key), float)]
            line[column.key] = statistics.median(values) if values else None
        line["runs"] = f"{len(finished)}/{len(group)}"
        if problems:
            line["problem"] = (
                "; ".join(f"seed {row['seed']}: {row['problem']}" for row in group if row["problem"]) or None
            )
        lines.append(line)
    columns = [Column("sequence", "sequence"), Column("preset", "preset"), Column("runs", "finished")]
    return Table([*columns, *FIGURES, Column("problem", "problem")], lines, _summary(rows))


def _summary(rows: Sequence[Row]) -> list[Row]:
    """Return mean, median, least and largest of each preset, over its finished runs."""
    summary: list[Row] = []
    for preset in dict.fromkeys(row["preset"] for row in rows):
        figures = [_figures(row) for row in rows if row["preset"] == preset and row["ending"] == FINISHED]
        summary += summary_rows(figures, "sequence", preset=preset) if len(figures) > 1 else []
    return summary


def _figures(row: Row) -> Row:
    return {key: value for key, value in row.items() if key not in LABELS}
