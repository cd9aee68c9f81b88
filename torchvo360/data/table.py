"""Text files with one record a line: times, numbers and file names, every complaint with its line."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path, PureWindowsPath

import numpy as np
from jaxtyping import Float64, Int64

from torchvo360.checks import InputError

LARGEST_T_NS = 2**63 - 1

LARGEST_SECONDS = 1e12
"""A time with a fraction below this many is one in seconds: nanoseconds of any clock since 1970 are larger."""

SHOWN = 60
"""Longest piece of a bad line that a message repeats, characters."""


def read_text(path: Path, what: str) -> str:
    """Return a text file's content.

    Args:
        path: The file.
        what: What it should be, for the message.

    Raises:
        InputError: It is missing, a folder, not permitted or not text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: expected {what}, got {error.strerror or error}.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected {what}, got a binary file.") from None


@dataclass(frozen=True)
class Table:
    """The lines of a text file that are neither empty nor comments (# in front), split into words."""

    path: Path
    columns: str
    """What a line should hold, for messages."""
    numbers: list[int]
    """Of each kept line in the file, from 1 on."""
    words: list[list[str]]

    @classmethod
    def read(cls, path: Path, columns: str, *, separator: str | None = None) -> "Table":
        """Read a file whose words are separated by spaces, or by `separator`.

        Raises:
            InputError: It cannot be read as text, or holds no lines.
        """
        numbers: list[int] = []
        words: list[list[str]] = []
        for number, line in enumerate(read_text(path, f"a text file with lines `{columns}`").splitlines(), 1):
            line = line.strip()
            if line and not line.startswith("#"):
                numbers.append(number)
                words.append([word.strip() for word in line.split(separator)])
        if not words:
            raise InputError(f"{path}: expected lines `{columns}`, got none.")
        return cls(path, columns, numbers, words)

    def __len__(self) -> int:
        return len(self.words)

    def only(self, row: int) -> "Table":
        """Return the table of one row."""
        return Table(self.path, self.columns, [self.numbers[row]], [self.words[row]])

    def complaint(self, row: int, expected: str, got: str) -> InputError:
        """Return the exception that names a row's line."""
        got = got if len(got) <= SHOWN else got[:SHOWN] + "..."
        return InputError(f"{self.path}, line {self.numbers[row]}: expected {expected}, got {got}.")

    def check_width(self, least: int, most: float | None = None) -> None:
        """Refuse lines with another number of words than `least`, or `least` to `most`.

        Raises:
            InputError: A line has fewer or more.
        """
        most = least if most is None else most
        for row, words in enumerate(self.words):
            if not least <= len(words) <= most:
                fewest = "" if most == least else "at least "
                columns = "column" if least == 1 else "columns"
                raise self.complaint(row, f"{fewest}{least} {columns}, {self.columns}", str(len(words)))

    def values(self, first: int, last: int) -> Float64[np.ndarray, "N n"]:
        """Return the columns from `first` to before `last` as numbers.

        Raises:
            InputError: One is no finite number.
        """
        rows: list[list[float]] = []
        for row, words in enumerate(self.words):
            try:
                rows.append([float(word) for word in words[first:last]])
            except ValueError:
                wrong = next(word for word in words[first:last] if not _is_number(word))
                raise self.complaint(row, f"numbers, {self.columns}", repr(wrong)) from None
        values = np.array(rows, dtype=np.float64)
        finite = np.isfinite(values)
        if not finite.all():
            row, column = np.argwhere(~finite)[0]
            raise self.complaint(int(row), "finite numbers", repr(self.words[row][first + column]))
        return values

    def seconds(self) -> Int64[np.ndarray, "N"]:
        """Return the first column, decimal seconds, as nanoseconds, without going through a float.

        Raises:
            InputError: One is no time, or not later than the one before.
        """
        return self._times(_nanoseconds_of_seconds, "a time in seconds", repr)

    def nanoseconds(self) -> Int64[np.ndarray, "N"]:
        """Return the first column, whole nanoseconds.

        Raises:
            InputError: One is no whole number, or not later than the one before.
        """
        return self._times(int, "a time in whole nanoseconds", _perhaps_seconds)

    def _times(self, parse: Callable[[str], int], expected: str, show: Callable[[str], str]) -> Int64[np.ndarray, "N"]:
        times: list[int] = []
        for row, words in enumerate(self.words):
            try:
                time = parse(words[0])
            except (ValueError, InvalidOperation):
                raise self.complaint(row, expected, show(words[0])) from None
            if abs(time) > LARGEST_T_NS:
                raise self.complaint(row, expected, words[0])
            times.append(time)
        t_ns = np.array(times, dtype=np.int64)
        late = np.flatnonzero(t_ns[1:] <= t_ns[:-1])
        if late.size:
            row = int(late[0]) + 1
            raise self.complaint(row, "a time later than the line before", self.words[row][0])
        return t_ns

    def paths(self, column: int, folder: Path) -> list[Path]:
        """Return a column of file names as paths inside a folder.

        Raises:
            InputError: A name leads out of the folder.
        """
        return [self._inside(row, words[column], folder) for row, words in enumerate(self.words)]

    def _inside(self, row: int, name: str, folder: Path) -> Path:
        as_parts = PureWindowsPath(name)  # knows both kinds of separators, and drives
        if not name or as_parts.anchor or ".." in as_parts.parts:
            raise self.complaint(row, "the name of a file inside the folder", repr(name))
        return folder / name


def _nanoseconds_of_seconds(word: str) -> int:
    seconds = Decimal(word)
    if not seconds.is_finite() or abs(seconds) > LARGEST_T_NS // 10**9:
        raise ValueError
    return int((seconds * 10**9).to_integral_value())


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _perhaps_seconds(word: str) -> str:
    """Return what to say of a time that is no whole number."""
    in_seconds = _is_number(word) and math.isfinite(float(word)) and abs(float(word)) < LARGEST_SECONDS
    return f"{word}, which looks like seconds" if in_seconds else repr(word)
