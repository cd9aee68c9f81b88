"""A training of a moment: a small network with all that a state must hold (running means, dropout) learns to shift."""

import os
import signal
import sys
from pathlib import Path

import torch
from torch import Tensor, nn

from torchvo360.learn import NonFiniteError, TrainerConfig, train

SETTINGS = {"steps": 30, "batch_size": 4, "warmup_steps": 5, "validate_every": 10, "save_every": 7, "progress": False}


def toy_module(dtype: torch.dtype = torch.float32, *, plain: bool = False) -> nn.Sequential:
    """Without normalisation and dropout (plain), the joint batch of several processes is a mean over their shares."""
    with torch.random.fork_rng():
        torch.manual_seed(5)
        between = [] if plain else [nn.BatchNorm2d(3), nn.Dropout(0.2)]
        layers = [nn.Conv2d(1, 3, 3, padding=1), *between, nn.Tanh(), nn.Conv2d(3, 1, 3, padding=1)]
        return nn.Sequential(*layers).to(dtype)


class ToyNet(nn.Sequential):
    def __init__(self, *, plain: bool = False) -> None:
        super().__init__(*toy_module(plain=plain))


class Toy:
    def __init__(self, config: TrainerConfig, *, plain: bool = False, dtype: torch.dtype = torch.float32) -> None:
        self.config = config
        self.spec = {"_target_": "toy_experiment.toy_module"}
        self.dtype = dtype
        self.module: nn.Module = toy_module(dtype, plain=plain)

    def batch(self, step: int, part: int, parts: int) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(step)
        images = torch.randn(self.config.batch_size, 1, 6, 8, generator=generator, dtype=self.dtype)
        own = images[list(self.config.share(part, parts))]
        return {"image": own, "shifted": own.roll(1, -1)}

    def losses(self, module: nn.Module, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        loss = (module(batch["image"]) - batch["shifted"]).square().mean()
        return {"loss": loss, "rmse": loss.sqrt()}

    def validate(self, module: nn.Module) -> dict[str, float]:
        assert not module.training
        assert not torch.is_grad_enabled()
        return {"loss": Toy.losses(self, module, Toy.batch(self, 10_000, 0, 1))["loss"].item()}

    def pictures(self, module: nn.Module) -> dict[str, Tensor]:
        return {"shifted": Toy.batch(self, 10_000, 0, 1)["shifted"][0].expand(3, 6, 8).sigmoid()}


class KilledToy(Toy):
    def batch(self, step: int, part: int, parts: int) -> dict[str, Tensor]:
        if step == 24:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().batch(step, part, parts)


class LostToy(Toy):
    """Gives the last process features that are not finite, once."""

    def batch(self, step: int, part: int, parts: int) -> dict[str, Tensor]:
        batch = super().batch(step, part, parts)
        return batch | {"lost": torch.tensor(step == 12 and part == parts - 1)}

    def losses(self, module: nn.Module, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        losses = super().losses(module, batch)
        if batch["lost"]:
            raise NonFiniteError("features (Toy): expected finite values, got others.")
        return losses


if __name__ == "__main__":
    torch.set_num_threads(1)
    what, folder = sys.argv[1], Path(sys.argv[2])
    config = TrainerConfig(**SETTINGS)
    kind = {"killed": KilledToy, "lost": LostToy, "plain": Toy}[what]
    toy = KilledToy(config) if what == "killed" else kind(config, plain=True, dtype=torch.float64)
    train(toy, config, folder)
