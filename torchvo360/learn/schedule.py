"""The settings of a training, and the learning rate that follows from them at every step."""

import math
from dataclasses import dataclass

from torchvo360.checks import InputError, check_choice, check_finite_number

MAX_SEED = 2**31 - 1


@dataclass(kw_only=True)
class TrainerConfig:
    """Settings of one training; mirrored by conf/train/trainer/default.yaml."""

    steps: int = 2000
    batch_size: int = 8
    """Elements of a step, of all processes together; each process gets an equal share."""
    learning_rate: float = 1e-3
    """Of AdamW, at its highest."""
    weight_decay: float = 1e-4
    schedule: str = "cosine"
    """After the warm-up: constant, or cosine, which falls to `final_share`."""
    warmup_steps: int = 100
    """Steps over which the learning rate rises linearly."""
    final_share: float = 0.01
    """Share of the learning rate that is left at the last step."""
    clip_norm: float | None = 1.0
    """Norm to which longer gradients are shortened; null for none."""
    max_skipped: int = 20
    """Steps in a row without a finite loss and gradient after which training ends; each of them changes nothing."""
    validate_every: int = 200
    """Steps between validations; there is one before the first and one after the last step, too."""
    save_every: int = 100
    """Steps between saved states, from which `resume` continues."""
    watch: str = "loss"
    """The figure of the validation that picks the best network; smaller is better, unless it is written -figure."""
    patience: int | None = None
    """Validations in a row without a better figure after which training ends; null for never."""
    max_minutes: float | None = None
    """Time after which training ends, that before a `resume` included; null for none."""
    seed: int = 0
    device: str = "cpu"
    """cpu or cuda."""
    precision: str = "32-true"
    """32-true, or bf16-mixed: the losses are computed under autocast."""
    strategy: str = "auto"
    """Of Lightning Fabric for several processes (torchrun): auto, ddp or ddp_find_unused_parameters_true."""
    progress: bool = True
    """Show a progress bar where standard error is a terminal."""

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "max_skipped", "validate_every", "save_every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        if self.patience is not None and self.patience < 1:
            raise InputError(f"patience: expected at least 1 or null, got {self.patience}.")
        if self.warmup_steps < 0:
            raise InputError(f"warmup_steps: expected at least 0, got {self.warmup_steps}.")
        check_finite_number("learning_rate", self.learning_rate, above=0.0)
        if not 0.0 <= self.weight_decay < math.inf:
            raise InputError(f"weight_decay: expected a finite number of at least 0, got {self.weight_decay}.")
        if not 0.0 <= self.final_share <= 1.0:
            raise InputError(f"final_share: expected 0 to 1, got {self.final_share}.")
        for name in ("clip_norm", "max_minutes"):
            if getattr(self, name) is not None:
                check_finite_number(name, getattr(self, name), above=0.0)
        if not self.watch.removeprefix("-"):
            raise InputError(f"watch: expected the name of a figure, got {self.watch!r}.")
        if not 0 <= self.seed <= MAX_SEED:
            raise InputError(f"seed: expected 0 to {MAX_SEED}, got {self.seed}.")
        check_choice("schedule", self.schedule, ("constant", "cosine"))
        check_choice("device", self.device, ("cpu", "cuda"))
        # Half precision needs a scaled loss, whose state would belong to what is saved; sharded weights likewise.
        check_choice("precision", self.precision, ("32-true", "bf16-mixed"))
        check_choice("strategy", self.strategy, ("auto", "ddp", "ddp_find_unused_parameters_true"))

    def share(self, part: int, parts: int) -> range:
        """Return the elements of a step's batch that fall to process `part` of `parts`."""
        size = self.batch_size // parts
        return range(part * size, (part + 1) * size)


def learning_rate(config: TrainerConfig, step: int) -> float:
    """Return the learning rate of a step, counted from 0: a function of nothing else, so that it need not be saved."""
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    if config.schedule == "constant":
        return config.learning_rate
    done = (step - config.warmup_steps) / max(config.steps - config.warmup_steps - 1, 1)
    share = config.final_share + (1.0 - config.final_share) * 0.5 * (1.0 + math.cos(math.pi * min(done, 1.0)))
    return config.learning_rate * share
