"""Tables of figures: printed, and as CSV, Markdown and LaTeX."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torchvo360.checks import InputError
from torchvo360.evaluation.figures import Column, Row, Value
from torchvo360.files import write_atomically

SPECIAL_IN_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}

DIGITS = 4
"""Significant digits for people; a CSV holds nine."""


@dataclass(frozen=True)
class Table:
    """Rows of figures, and rows that sum them up."""

    columns: Sequence[Column]
    """Those that people read; one in which no row has anything is left out."""
    rows: Sequence[Row]
    summary: Sequence[Row] = ()
    """Rows below a line."""

    def as_text(self) -> str:
        """Return it in columns of one width, names on the left, figures on the right."""
        head, body, foot = self._words()
        lines = [head, *body, *foot]
        widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
        left = [self._holds_words(column.key) for column in self._shown]

        def line(words: list[str]) -> str:
            cells = zip(words, widths, left, strict=True)
            return "  ".join(f"{word:<{width}}" if to_left else f"{word:>{width}}" for word, width, to_left in cells)

        rule = ["-" * (sum(widths) + 2 * (len(widths) - 1))]
        text = [line(head), *rule, *map(line, body), *(rule + [line(words) for words in foot] if foot else [])]
        return "\n".join(words.rstrip() for words in text) + "\n"

    def as_markdown(self) -> str:
        """Return it as a table of GitHub's Markdown."""
        head, body, foot = self._words()
        rule = ["---" if self._holds_words(column.key) else "---:" for column in self._shown]
        lines = [head, rule, *body, *foot]
        safe = [" | ".join(word.replace("|", "\\|") for word in words) for words in lines]
        return "".join(f"| {words} |\n" for words in safe)

    def as_latex(self) -> str:
        """Return it as a `tabular`, which needs no package."""
        head, body, foot = self._words()
        layout = "".join("l" if self._holds_words(column.key) else "r" for column in self._shown)

        def line(words: list[str]) -> str:
            return " & ".join("".join(SPECIAL_IN_LATEX.get(c, c) for c in word) for word in words) + r" \\"

        lines = [rf"\begin{{tabular}}{{{layout}}}", r"\hline", line(head), r"\hline", *map(line, body), r"\hline"]
        if foot:
            lines += [*map(line, foot), r"\hline"]
        return "\n".join([*lines, r"\end{tabular}"]) + "\n"

    def as_csv(self) -> str:
        """Return every figure of every row by its key, `row` telling rows from `summary`; cells may be empty."""
        marked = [
            *({"row": "result", **row} for row in self.rows),
            *({"row": "summary", **row} for row in self.summary),
        ]
        keys = dict.fromkeys(key for row in marked for key in row)
        file = io.StringIO()
        writer = csv.DictWriter(file, list(keys), restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _exactly(value) for key, value in row.items()} for row in marked)
        return file.getvalue()

    @property
    def _shown(self) -> list[Column]:
        """The columns in which any row has something."""
        rows = [*self.rows, *self.summary]
        return [column for column in self.columns if any(row.get(column.key) is not None for row in rows)]

    def _words(self) -> tuple[list[str], list[list[str]], list[list[str]]]:
        def words(rows: Sequence[Row]) -> list[list[str]]:
            return [[_briefly(row.get(column.key)) for column in self._shown] for row in rows]

        return [column.title for column in self._shown], words(self.rows), words(self.summary)

    def _holds_words(self, key: str) -> bool:
        return any(isinstance(row.get(key), str) for row in (*self.rows, *self.summary))


WRITERS = {".csv": Table.as_csv, ".md": Table.as_markdown, ".tex": Table.as_latex}
"""What the suffix of a file's name asks for."""


def check_table_path(path: str | Path) -> None:
    """Refuse a name whose suffix is not that of a table.

    Raises:
        InputError: It is another.
    """
    if Path(path).suffix.lower() not in WRITERS:
        raise InputError(f"out: expected a name that ends with {', '.join(WRITERS)}, got {path}.")


def write_table(path: str | Path, table: Table) -> None:
    """Write a table in the format that the suffix names: .csv, .md or .tex; the file is complete or absent.

    Raises:
        InputError: The suffix is another, or it cannot be written.
    """
    check_table_path(path)
    file = Path(path).expanduser()
    write_atomically(file, WRITERS[file.suffix.lower()](table))


def _briefly(value: Value) -> str:
    if isinstance(value, float):
        return f"{value:.{DIGITS}g}" if math.isfinite(value) else "undefined"
    return "" if value is None else " ".join(str(value).split())


def _exactly(value: Value) -> str:
    if isinstance(value, float):
        return f"{value:.9g}" if math.isfinite(value) else ""
    return "" if value is None else str(value)
