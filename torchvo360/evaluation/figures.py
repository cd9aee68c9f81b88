"""The figures of one estimate as columns of a table, and what many of them come to."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from torchvo360.evaluation.errors import Evaluation
from torchvo360.evaluation.estimate import Estimate
from torchvo360.evaluation.statistics import Statistics
from torchvo360.vo import State

Value = str | float | int | None
"""What stands in a cell; None for nothing."""

Row = dict[str, Value]

SUMMARIES = {"mean": statistics.fmean, "median": statistics.median, "min": min, "max": max}


@dataclass(frozen=True)
class Column:
    """A column of the tables that are read by people; a CSV holds all figures by their keys."""

    key: str
    title: str


FIGURES = (
    Column("coverage_percent", "cover %"),
    Column("ate_rmse_m", "ATE m"),
    Column("ate_percent", "ATE %"),
    Column("rotation_median_deg", "rot deg"),
    Column("rpe_rmse_m", "RPE m"),
    Column("rpe_rmse_deg", "RPE deg"),
    Column("drift_percent", "drift %"),
    Column("drift_deg_per_m", "drift deg/m"),
    Column("scale", "scale"),
    Column("milliseconds_median", "ms"),
    Column("tracking_percent", "tracking %"),
    Column("lost_percent", "lost %"),
)
"""Those that people read, of the keys that `error_figures` and `run_figures` give."""


def error_figures(evaluation: Evaluation) -> Row:
    """Return the errors of an estimate: metres, degrees and percent."""
    return {
        "pairs": evaluation.pairs,
        "coverage_percent": 100 * evaluation.coverage,
        "path_length_m": evaluation.path_length_m,
        "scale": evaluation.scale,
        **_spread("ate", "m", evaluation.ate_m),
        "ate_percent": evaluation.ate_percent,
        "rotation_median_deg": evaluation.rotation_median_deg,
        "rpe_frames": evaluation.rpe_frames,
        **_spread("rpe", "m", evaluation.rpe_m),
        **_spread("rpe", "deg", evaluation.rpe_deg),
        "rpe_median_percent": evaluation.rpe_translation_percent,
        "rpe_metres": evaluation.rpe_metres,
        **_spread("rpe_metres", "m", evaluation.rpe_metres_m),
        **_spread("rpe_metres", "deg", evaluation.rpe_metres_deg),
        "drift_percent": evaluation.drift.mean_translation_percent,
        "drift_deg_per_m": evaluation.drift.mean_rotation_deg_per_m,
    }


def run_figures(estimate: Estimate) -> Row:
    """Return the number of poses, and of a run the time per frame and the share of frames in each state, percent."""
    row: Row = {"poses": len(estimate.trajectory)}
    times = estimate.milliseconds
    row["milliseconds_median"] = statistics.median(times) if times else None
    row["milliseconds_mean"] = statistics.fmean(times) if times else None
    frames = sum(estimate.states.values())
    return row | {
        f"{state}_percent": 100 * estimate.states.get(state, 0) / frames if frames else None for state in State
    }


def summary_rows(rows: Sequence[Row], label: str, **labels: Value) -> list[Row]:
    """Return a row each for the mean, the median, the least and the largest of every figure of rows.

    Args:
        rows: The rows; figures that are missing or not finite are left out of account.
        label: Key under which the name of the summary stands.
        labels: What else stands in the summary's rows.
    """
    figures: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.items():
            if isinstance(value, float | int) and key not in labels and math.isfinite(value):
                figures.setdefault(key, []).append(value)
    return [
        {label: name, **labels, **{key: float(of(values)) for key, values in figures.items()}}
        for name, of in SUMMARIES.items()
    ]


def _spread(name: str, unit: str, figures: Statistics | None) -> Row:
    parts = ("rmse", "mean", "median", "max")
    return {f"{name}_{part}_{unit}": None if figures is None else getattr(figures, part) for part in parts}
