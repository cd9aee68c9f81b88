"""What a training tells while it runs: a progress bar, two CSV files, and TensorBoard."""

import csv
import importlib
import io
import math
from collections.abc import Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from types import TracebackType
from typing import Any

from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from torchvo360.checks import InputError
from torchvo360.files import write_atomically

TRAIN, VALIDATION, TENSORBOARD = "train.csv", "validation.csv", "tensorboard"
"""Two files and a folder."""


class Record:
    """Write down what happens in a training, from a step on; what the files hold of later steps is dropped.

    Args:
        folder: It exists.
        step: Steps done before.
        steps: Steps in all.
        progress: Show the progress bar, where standard error is a terminal.

    Raises:
        InputError: TensorBoard is not installed, or the folder cannot be written.
    """

    def __init__(self, folder: Path, step: int, steps: int, *, progress: bool) -> None:
        tensorboard = _tensorboard()
        with ExitStack() as opened:
            tables = {name: opened.enter_context(closing(_Table(folder / name, step))) for name in (TRAIN, VALIDATION)}
            try:
                board = tensorboard.SummaryWriter(str(folder / TENSORBOARD), purge_step=step + 1 if step else None)
            except OSError as error:
                expected = f"{TENSORBOARD}: expected a folder to write to"
                raise InputError(f"{expected}, got {folder / TENSORBOARD}: {error.strerror}.") from None
            self._tables, self._board = tables, opened.enter_context(closing(board))
            disable = None if progress else True  # None: where standard error is no terminal
            bar = tqdm(total=steps, initial=step, unit="step", disable=disable, leave=False, dynamic_ncols=True)
            self._bar = opened.enter_context(bar)
            self._opened = opened.pop_all()

    def __enter__(self) -> "Record":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._opened.close()

    def train(self, step: int, losses: Mapping[str, float], others: Mapping[str, float]) -> None:
        """Note a step's losses, which the bar shows, and other figures of it."""
        self._tables[TRAIN].add(step, {**losses, **others})
        for name, value in (*losses.items(), *others.items()):
            self._board.add_scalar(f"train/{name}", value, step)
        self._bar.set_postfix({name: f"{value:.4g}" for name, value in losses.items()}, refresh=False)
        self._bar.update()

    def validation(
        self, step: int, figures: Mapping[str, float], pictures: Mapping[str, Float[Tensor, "3 H W"]]
    ) -> None:
        """Note the figures of a validation and its pictures, in [0, 1]."""
        self._tables[VALIDATION].add(step, figures)
        for name, value in figures.items():
            self._board.add_scalar(f"validation/{name}", value, step)
        for name, picture in pictures.items():
            self._board.add_image(name, picture.detach().float().clamp(0, 1).cpu(), step)

    def flush(self) -> None:
        """Write out what is held back, before a state is saved that counts on it."""
        self._board.flush()


def add_picture(folder: Path, step: int, name: str, picture: Float[Tensor, "3 H W"]) -> None:
    """Add a picture of what a training came to, values in [0, 1], to the TensorBoard files in its folder."""
    with _tensorboard().SummaryWriter(str(folder / TENSORBOARD)) as board:
        board.add_image(name, picture, step)


def _tensorboard() -> Any:
    try:
        return importlib.import_module("torch.utils.tensorboard")
    except ModuleNotFoundError:
        raise InputError("train: expected tensorboard, which pip install 'torchvo360[train]' brings.") from None


class _Table:
    """A CSV file with one line a step; its columns are those of the first line."""

    def __init__(self, path: Path, step: int) -> None:
        """Continue a table behind a step, or begin one."""
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if step and path.is_file() else []
        whole = [line for line in lines if line.endswith("\n")]  # a kill may have cut the last one
        rows = [
            line for line in whole[1:] if line.partition(",")[0].isdecimal() and int(line.partition(",")[0]) <= step
        ]
        write_atomically(path, "".join(whole[:1] + rows))
        self._columns = next(csv.reader(whole[:1]), [])
        self._path = path
        self._file = path.open("a", encoding="utf-8", buffering=1)  # a line is written out when it is complete

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Append a line.

        Raises:
            InputError: The names are not those of the first line.
        """
        columns = ["step", *values]
        if not self._columns:
            self._columns = columns
            self._file.write(_line(columns))
        if columns != self._columns:
            expected, got = (", ".join(names[1:]) for names in (self._columns, columns))
            raise InputError(f"{self._path.name}: expected the same figures in every step, {expected}, got {got}.")
        self._file.write(_line([step, *(f"{value:.9g}" if math.isfinite(value) else "" for value in values.values())]))

    def close(self) -> None:
        self._file.close()


def _line(cells: list[object] | list[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()
