"""What learned range is worth to the odometry: how far its metre is off, and what becomes of the accuracy.

python train/odometry.py --checkpoint torchvo360/learn/checkpoints/depth --seeds 101 102 103 104 --frames 90
"""

import argparse
import csv
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median

import torch
from torch import nn

from torchvo360.checks import InputError, check_choice
from torchvo360.data.synthetic import WORLDS, SyntheticConfig, SyntheticSequence
from torchvo360.evaluation import evaluate
from torchvo360.files import atomic_path
from torchvo360.learn import load_checkpoint
from torchvo360.vo import State, VisualOdometry


@dataclass(kw_only=True)
class WalksConfig:
    """Walks through worlds never trained on, as `torchvo360 input=synthetic` renders them."""

    worlds: list[str] = field(default_factory=lambda: list(WORLDS))
    seeds: list[int] = field(default_factory=lambda: [1, 2, 3])
    frames: int = 60
    """Frames of each walk; 0 leaves the odometry out."""
    exposure: str = "steps"
    """Brightness over time: constant, steps or drift."""

    def __post_init__(self) -> None:
        for world in self.worlds:
            check_choice("worlds", world, WORLDS)
        if self.frames and not (self.worlds and self.seeds):
            raise InputError(f"worlds, seeds: expected at least one each, got {self.worlds} and {self.seeds}.")
        if self.frames and self.frames < 3:
            raise InputError(f"frames: expected at least 3, or 0, got {self.frames}.")


@dataclass(frozen=True)
class Walk:
    """How the odometry did on one walk."""

    world: str
    seed: int
    scale_error: float
    """Share by which lengths of the estimate are off."""
    ate_percent: float
    ate_percent_without: float
    """The same without learned range."""
    untracked: int
    """Frames in another state than TRACKING."""


def walk_through(network: nn.Module, config: WalksConfig) -> list[Walk]:
    """Run the odometry with and without a network on every walk."""
    walks = []
    for world in config.worlds if config.frames else ():
        for seed in config.seeds:
            settings = SyntheticConfig(world=world, seed=seed, frames=config.frames, exposure=config.exposure)
            sequence = SyntheticSequence(settings)
            frames = list(sequence)
            results = []
            for depth in (network, None):
                odometry = VisualOdometry(sequence.camera, depth=depth)
                with torch.inference_mode():
                    for frame in frames:
                        odometry.step(frame)
                results.append(odometry.finish())
            learned, without = (evaluate(result.trajectory, sequence.truth) for result in results)
            states = [estimate.state for estimate in results[0].frames]
            untracked = sum(state is not State.TRACKING for state in states)
            walks.append(Walk(world, seed, 1 / learned.scale - 1, learned.ate_percent, without.ate_percent, untracked))
    return walks


def write_walks(path: Path, walks: Sequence[Walk]) -> None:
    """Write one line a walk as CSV."""
    with atomic_path(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, list(Walk.__dataclass_fields__), lineterminator="\n")
        table.writeheader()
        table.writerows(asdict(walk) for walk in walks)


def figures_of(walks: Sequence[Walk]) -> dict[str, float]:
    """Return medians and worst values over all walks."""
    scale = [abs(walk.scale_error) for walk in walks]
    return {
        "walk_scale_error": median(scale),
        "walk_scale_error_worst": max(scale),
        "walk_ate_percent": median(walk.ate_percent for walk in walks),
        "walk_ate_percent_without": median(walk.ate_percent_without for walk in walks),
    }


def main(argv: list[str] | None = None) -> int:
    """Run the odometry with a checkpoint and without, print a line a walk, and return the exit code."""
    usual = WalksConfig()
    parser = argparse.ArgumentParser("train/odometry.py", description="Odometry with learned ranges and without.")
    parser.add_argument("--checkpoint", required=True, type=Path, help="a .safetensors with its .json beside it")
    parser.add_argument("--target", help="dotted name of the network's class, where it is not one of the package's")
    parser.add_argument("--worlds", nargs="+", default=usual.worlds, help="kinds of worlds (%(default)s)")
    parser.add_argument("--seeds", nargs="+", type=int, default=usual.seeds, help="of the worlds (%(default)s)")
    parser.add_argument("--frames", type=int, default=usual.frames, help="of each walk (%(default)s)")
    parser.add_argument("--exposure", default=usual.exposure, help="constant, steps or drift (%(default)s)")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    try:
        kinds = {name: getattr(arguments, name) for name in ("worlds", "seeds", "frames", "exposure")}
        walks = walk_through(load_checkpoint(arguments.checkpoint, arguments.target), WalksConfig(**kinds))
    except InputError as error:
        print(f"train/odometry.py: {error}", file=sys.stderr)
        return 2
    for walk in walks:
        print(
            f"{walk.world} {walk.seed}: scale off by {100 * walk.scale_error:+.2f} %, ATE {walk.ate_percent:.3f} % "
            f"(without the network {walk.ate_percent_without:.3f} %), {walk.untracked} frames not tracked"
        )
    print(", ".join(f"{name} {value:.4g}" for name, value in figures_of(walks).items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
