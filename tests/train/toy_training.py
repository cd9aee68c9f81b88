"""A training script of a moment: a line learns to lie flat."""

import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from command import Train, TrainingConfig, main
from torchvo360.checks import InputError


@dataclass(kw_only=True)
class ToyConfig(TrainingConfig):
    stop_at: int | None = None
    """Step at which the process asks itself to end."""
    spoiled: bool = False
    """Losses are not finite."""
    refuse: bool = False


class Toy:
    def __init__(self, config: ToyConfig) -> None:
        self.config = config
        self.module = nn.Linear(3, 1)
        self.spec = {"_target_": "torch.nn.Linear", "in_features": 3, "out_features": 1}

    def batch(self, step: int, part: int, parts: int) -> Tensor:
        if step == self.config.stop_at:
            os.kill(os.getpid(), signal.SIGTERM)
        generator = torch.Generator().manual_seed(step)
        return torch.randn(self.config.trainer.batch_size, 3, generator=generator)

    def losses(self, module: nn.Module, batch: Tensor) -> dict[str, Tensor]:
        loss = module(batch).square().mean()
        return {"loss": loss * torch.inf if self.config.spoiled else loss}

    def validate(self, module: nn.Module) -> dict[str, float]:
        return {"loss": float(module(torch.ones(1, 3)).square())}

    def pictures(self, module: nn.Module) -> dict[str, Tensor]:
        return {}


def run(config: ToyConfig, folder: Path, train: Train) -> list[str]:
    if config.refuse:
        raise InputError("refuse: expected false, got true.")
    return ["it was measured"] if train(Toy(config)).success else []


if __name__ == "__main__":
    sys.exit(main("toy", ToyConfig, run, conf=Path(os.environ["TOY_CONF"])))
