"""Everything around a learning experiment: optimizer, schedule, validation, files, ends, and how it is continued."""

import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from torchvo360.checks import InputError
from torchvo360.learn.checkpoint import save_checkpoint
from torchvo360.learn.experiment import Experiment, Objective, Share
from torchvo360.learn.processes import join, own_random_numbers, reduced, seed_random_numbers
from torchvo360.learn.record import TENSORBOARD, Record
from torchvo360.learn.resume import STATE, Progress, load_state, save_state
from torchvo360.learn.schedule import TrainerConfig, learning_rate

if TYPE_CHECKING:
    from lightning_fabric import Fabric

BEST, LAST = "best", "last"
"""Names of the checkpoints in a training's folder."""

CHECKPOINTS = (STATE, *(f"{name}.{suffix}" for name in (BEST, LAST) for suffix in ("safetensors", "json")))
"""By these files a folder holds a training."""

LEFTOVERS = f".*.{'[0-9a-f]' * 8}.part*"
"""The temporary files of `torchvo360.files.atomic_path`, which a kill leaves behind."""


class Ending(StrEnum):
    """Why a training ended."""

    FINISHED = "all steps were done"
    EARLY = "the watched figure did not get better any more"
    TIME = "its time was up"
    STOPPED = "it was stopped"
    DIVERGED = "losses or gradients were not finite"


@dataclass(frozen=True)
class TrainOutcome:
    """How a training ended."""

    ending: Ending
    steps: int
    """Steps done, skipped ones included."""
    skipped: int
    """Steps without a finite loss and gradient, which changed nothing."""
    best: float | None
    """The best value of the watched figure; None if it was never finite."""
    best_step: int
    seconds: float
    checkpoint: Path
    """The best network, for `load_checkpoint`; the first process has written it."""

    @property
    def success(self) -> bool:
        """Whether what was learned is to be measured: training ended neither by a signal nor by numbers."""
        return self.ending not in (Ending.STOPPED, Ending.DIVERGED)


def train(
    experiment: Experiment,
    config: TrainerConfig,
    folder: Path,
    *,
    resume: bool = False,
    made_by: str = "",
    stopped: Callable[[], bool] = lambda: False,
) -> TrainOutcome:
    """Train a network and keep its best and its last state as checkpoints.

    The folder gets best and last (.safetensors and .json), state.safetensors, train.csv, validation.csv and
    tensorboard/. Only the first process writes. On a CPU with a given number of threads, a training that was killed
    and resumed ends with the same bits as one that was not.

    Args:
        experiment: What is learned.
        config: Settings.
        folder: Where the files go; it exists. Those of an earlier training are replaced.
        resume: Continue from the folder's state; where there is no training, begin.
        made_by: The command, for the checkpoints.
        stopped: Asked after every step; where it answers yes in any process, the training is saved and ends.

    Raises:
        InputError: The extra `train` is not installed, there is no such device, the folder cannot be written, its
            state is missing or does not fit, or the experiment gives no `loss` or not the figure to watch.
    """
    with own_random_numbers():
        training = _Training(experiment, config, folder, join(config), made_by, stopped)
        training.begin(resume)
        return training.run()


class _Training:
    """What `train` holds between its steps; every process has one, and all do the same."""

    def __init__(
        self,
        experiment: Experiment,
        config: TrainerConfig,
        folder: Path,
        fabric: "Fabric",
        made_by: str,
        stopped: Callable[[], bool],
    ) -> None:
        self.experiment = experiment
        self.config = config
        self.folder = folder
        self.fabric = fabric
        self.made_by = made_by
        self.stopped = stopped
        self.module = experiment.module
        self.parameters = [parameter for parameter in self.module.parameters() if parameter.requires_grad]
        if not self.parameters:
            raise InputError(f"module: expected parameters to learn, got none in {type(self.module).__name__}.")
        self.optimizer = torch.optim.AdamW(self.parameters, config.learning_rate, weight_decay=config.weight_decay)
        self.objective, self.wrapped_optimizer = fabric.setup(Objective(experiment), self.optimizer)
        self.progress = Progress(watch=config.watch)
        self.figures: dict[str, float] = {}
        self.began = time.perf_counter()

    def begin(self, resume: bool) -> None:
        """Take up the folder's state, where one is asked for and there is a training."""
        if resume and any((self.folder / name).exists() for name in CHECKPOINTS):
            state = self.folder / STATE
            if not state.is_file():
                raise InputError(f"resume: expected {STATE} beside the checkpoints in {self.folder}, got none.")
            self.progress = load_state(state, self.module, self.optimizer)
            if self.progress.watch != self.config.watch:
                expected = f"watch: expected {self.progress.watch}, by which the training to resume picked its best"
                raise InputError(f"{expected}, got {self.config.watch}.")
            self.began -= self.progress.seconds
        self.fabric.barrier()  # before the first process changes the files by which all decide

    def run(self) -> TrainOutcome:
        """Take steps, validate and save until there is a reason to end."""
        config, progress = self.config, self.progress
        saved_step, stop, late = progress.step, False, False
        if self.fabric.is_global_zero:
            if progress.step == 0:
                self._measure()  # a wrong name to watch is told before an earlier training is cleared away
            self._tidy()
        with self._record() as record:
            if progress.step == 0:
                self._save(record)  # whenever it is killed, there is a state to resume from
                self._validate(record)
            while (ending := self._ending(stop, late)) is None:
                stop, late = self._step(record)
                if progress.step % config.validate_every == 0 or progress.step == config.steps:
                    self._validate(record)
                if progress.step % config.save_every == 0:
                    self._save(record)
                    saved_step = progress.step
            if progress.step != saved_step and ending is not Ending.DIVERGED:
                self._save(record)
        return TrainOutcome(
            ending=ending,
            steps=progress.step,
            skipped=progress.skipped,
            best=progress.best,
            best_step=progress.best_step,
            seconds=progress.seconds,
            checkpoint=self.folder / f"{BEST}.safetensors",
        )

    def _tidy(self) -> None:
        """Clear away what a kill left and, at the beginning, what an earlier training left."""
        for leftover in self.folder.glob(LEFTOVERS):
            leftover.unlink(missing_ok=True)
        if self.progress.step == 0:
            clear(self.folder)

    def _record(self) -> AbstractContextManager[Record | None]:
        if not self.fabric.is_global_zero:
            return nullcontext()
        return Record(self.folder, self.progress.step, self.config.steps, progress=self.config.progress)

    def _ending(self, stop: bool, late: bool) -> Ending | None:
        config, progress = self.config, self.progress
        reasons = {
            Ending.DIVERGED: progress.skipped_in_a_row >= config.max_skipped,
            Ending.FINISHED: progress.step >= config.steps,
            Ending.EARLY: config.patience is not None and progress.without_better >= config.patience,
            Ending.STOPPED: stop,
            Ending.TIME: late,
        }
        return next((ending for ending, holds in reasons.items() if holds), None)

    def _step(self, record: Record | None) -> tuple[bool, bool]:
        """Take one step, and return whether any process wants to stop, and is late."""
        fabric, progress, rate = self.fabric, self.progress, learning_rate(self.config, self.progress.step)
        began = time.perf_counter()
        seed_random_numbers(self.config.seed, progress.step, fabric.global_rank)
        self.module.train()
        batch = fabric.to_device(self.experiment.batch(progress.step, fabric.global_rank, fabric.world_size))
        buffers = [(buffer, buffer.clone()) for buffer in self.module.buffers()]
        losses = self.objective(Share(batch), progress.losses)
        self.optimizer.zero_grad()
        fabric.backward(losses["loss"])
        length = nn.utils.clip_grad_norm_(self.parameters, self.config.clip_norm or math.inf).item()
        # A process that stepped while another did not would be left waiting: all decide by the same numbers.
        numbers = reduced(fabric, [float(self.stopped()), float(self._is_late()), *losses.values()], "mean")
        values = dict(zip(losses, numbers[2:], strict=True))
        progress.losses = [*losses]
        self._update(rate, math.isfinite(values["loss"]) and math.isfinite(length), buffers)
        if record is not None:
            others = {"gradient_norm": length, "learning_rate": rate, "seconds": time.perf_counter() - began}
            record.train(progress.step, values, others)
        return numbers[0] > 0.0, numbers[1] > 0.0

    def _is_late(self) -> bool:
        self.progress.seconds = time.perf_counter() - self.began
        return self.config.max_minutes is not None and self.progress.seconds > 60.0 * self.config.max_minutes

    def _update(self, rate: float, finite: bool, buffers: list[tuple[Tensor, Tensor]]) -> None:
        """Change the network by its gradients, or leave it as it was before the forward pass if they are not finite."""
        progress = self.progress
        if finite:
            for group in self.optimizer.param_groups:
                group["lr"] = rate
            self.wrapped_optimizer.step()
            progress.skipped_in_a_row = 0
        else:
            for buffer, value in buffers:
                buffer.copy_(value)
            progress.skipped += 1
            progress.skipped_in_a_row += 1
        progress.step += 1
        self.figures = {}

    def _measure(self) -> None:
        """Take the figures of the network as it is."""
        seed_random_numbers(self.config.seed)
        self.module.eval()
        with torch.no_grad():
            self.figures = {key: float(figure) for key, figure in self.experiment.validate(self.module).items()}
        if self._watched not in self.figures:
            raise InputError(f"watch: expected one of {', '.join(self.figures)}, got {self._watched}.")

    @property
    def _watched(self) -> str:
        return self.config.watch.removeprefix("-")

    def _validate(self, record: Record | None) -> None:
        """Write down the figures of the network as it is, and keep it if it is the best."""
        fabric, progress = self.fabric, self.progress
        sign = -1.0 if self.config.watch.startswith("-") else 1.0
        value = 0.0
        if record is not None:
            if not self.figures:
                self._measure()
            with torch.no_grad():
                record.validation(progress.step, self.figures, self.experiment.pictures(self.module))
            value = self.figures[self._watched]
        (value,) = reduced(fabric, [value], "sum")
        better = math.isfinite(value) and (progress.best is None or sign * value < sign * progress.best)
        if record is not None and (better or progress.step == 0):
            self._checkpoint(BEST)
        if better:
            progress.best, progress.best_step = value, progress.step
        progress.without_better = 0 if better else progress.without_better + 1

    def _save(self, record: Record | None) -> None:
        if record is None:
            return
        record.flush()
        save_state(self.folder / STATE, self.module, self.optimizer, self.progress)
        self._checkpoint(LAST)

    def _checkpoint(self, name: str) -> None:
        notes = {"made_by": self.made_by, "figures": {**self.figures, "steps": self.progress.step}}
        save_checkpoint(self.folder / name, self.module, {**self.experiment.spec, **notes})


def clear(folder: Path) -> None:
    """Remove what an earlier training left in a folder, its state first: without it there is nothing to resume."""
    for name in CHECKPOINTS:
        (folder / name).unlink(missing_ok=True)
    for events in (folder / TENSORBOARD).glob("events.out.*"):
        events.unlink(missing_ok=True)
