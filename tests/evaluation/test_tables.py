"""Tables: the figures that stand in them, their summaries, and the three formats."""

import csv
import dataclasses
import math
import re

import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data.trajectory import Trajectory
from torchvo360.evaluation import evaluate
from torchvo360.evaluation.estimate import Estimate
from torchvo360.evaluation.figures import FIGURES, Column, error_figures, run_figures, summary_rows
from torchvo360.evaluation.table import Table, write_table
from torchvo360.lie import se3_exp

COLUMNS = [Column("name", "name"), Column("ate", "ATE m"), Column("n", "n"), Column("never", "never")]

ROWS = [{"name": "a_b & c|d", "ate": 1 / 3, "n": 3, "extra": 0.123456789}, {"name": "é", "ate": math.inf, "n": None}]


@pytest.fixture
def table() -> Table:
    """Two rows with special characters, nothing and an infinity."""
    return Table(COLUMNS, ROWS, summary_rows(ROWS, "name"))


def test_every_figure_that_people_read_is_among_those_of_a_run():
    tangent = torch.zeros(30, 6, dtype=torch.float64)
    tangent[:, 2] = torch.arange(30) / 10
    trajectory = Trajectory(torch.arange(30) * 10**8, se3_exp(tangent))
    estimate = Estimate("run", trajectory, {"tracking": 3, "lost": 1}, (1.0, 2.0, 6.0))
    row = run_figures(estimate) | error_figures(evaluate(trajectory, trajectory))
    assert {column.key for column in FIGURES} <= set(row)
    assert (row["tracking_percent"], row["lost_percent"], row["weak_percent"]) == (75, 25, 0)
    assert (row["milliseconds_median"], row["milliseconds_mean"]) == (2, 3)
    assert row["ate_rmse_m"] == pytest.approx(0, abs=1e-12)
    assert row["path_length_m"] == pytest.approx(2.9)


def test_a_trajectory_alone_has_no_times_and_no_states():
    row = run_figures(Estimate("a", Trajectory(torch.zeros(1, dtype=torch.int64), torch.eye(4).double()[None])))
    assert row.pop("poses") == 1
    assert set(row.values()) == {None}


def test_summaries_leave_out_what_is_missing_or_not_finite():
    rows = [{"name": "a", "x": 1.0}, {"name": "b", "x": math.inf}, {"name": "c", "x": 2}, {"name": "d", "x": None}]
    rows.append({"name": "e", "x": 6.0, "seed": 7})
    summary = {row["name"]: row for row in summary_rows(rows, "name", preset="fast")}
    assert {name: row["x"] for name, row in summary.items()} == {"mean": 3, "median": 2, "min": 1, "max": 6}
    assert {row["preset"] for row in summary.values()} == {"fast"}


def test_a_csv_holds_every_figure_with_nine_digits(table, tmp_path):
    write_table(tmp_path / "t.csv", table)
    rows = list(csv.DictReader((tmp_path / "t.csv").read_text(encoding="utf-8").splitlines()))
    assert [row["row"] for row in rows] == ["result"] * 2 + ["summary"] * 4
    assert rows[0] == {"row": "result", "name": "a_b & c|d", "ate": "0.333333333", "n": "3", "extra": "0.123456789"}
    assert (rows[1]["ate"], rows[1]["n"]) == ("", "")
    assert rows[2]["name"] == "mean"


def test_markdown_has_as_many_cells_in_every_line(table, tmp_path):
    write_table(tmp_path / "t.md", table)
    lines = (tmp_path / "t.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 2 + 2 + 4
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {4}
    assert lines[0] == "| name | ATE m | n |"
    assert lines[1] == "| --- | ---: | ---: |"
    assert lines[2] == r"| a_b & c\|d | 0.3333 | 3 |"
    assert lines[3] == "| é | undefined |  |"


def test_latex_escapes_what_is_special_and_closes_what_it_opens(table, tmp_path):
    every = r"\ & % $ # _ { } ~ ^"
    write_table(tmp_path / "t.tex", dataclasses.replace(table, rows=[*ROWS, {"name": every, "ate": 1.0}]))
    text = (tmp_path / "t.tex").read_text(encoding="utf-8")
    assert text.startswith("\\begin{tabular}{lrr}\n\\hline\nname & ATE m & n \\\\\n")
    assert text.endswith("\\end{tabular}\n")
    assert r"a\_b \& c|d & 0.3333 & 3 \\" in text
    assert r"\textbackslash{} \& \% \$ \# \_ \{ \} \textasciitilde{} \textasciicircum{} & 1 &  \\" in text


def test_printed_columns_stand_below_each_other(table):
    lines = table.as_text().splitlines()
    assert len({len(line) for line in lines if line.startswith("-")}) == 1
    ends = [line.index(word) + len(word) for line, word in zip(lines[:3:2], ("ATE m", "0.3333"), strict=True)]
    assert len({*ends}) == 1
    assert "never" not in lines[0]


def test_an_unknown_suffix_and_a_folder_that_is_not_there_are_refused(table, tmp_path):
    with pytest.raises(InputError, match=r"^out: expected a name that ends with \.csv, \.md, \.tex, got table\.xls"):
        write_table("table.xls", table)
    with pytest.raises(InputError, match=r"^t\.csv: expected a folder to write to"):
        write_table(tmp_path / "none" / "t.csv", table)


def test_an_older_table_is_replaced_in_one_step_or_not_at_all(table, tmp_path):
    path = tmp_path / "t.md"
    path.write_text("older")
    with pytest.raises(UnicodeEncodeError):
        write_table(path, dataclasses.replace(table, rows=[{"name": "\ud800"}]))
    assert path.read_text() == "older"
    assert [file.name for file in tmp_path.iterdir()] == ["t.md"]
    write_table(path, table)
    assert path.read_text(encoding="utf-8") == table.as_markdown()
