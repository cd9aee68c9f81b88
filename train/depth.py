"""Learn range from one panorama, by true ranges or from neighbouring views alone, and try it in the odometry.

python train/depth.py                       by true ranges, on rendered worlds
python train/depth.py mode=neighbours       without them: photometric, with the poses that `align` finds
python train/depth.py -c                    all settings
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from command import Train, TrainingConfig, is_first, main
from odometry import WalksConfig, figures_of, walk_through, write_walks
from ranges import Neighbours, NeighboursConfig, Ranges, TrueRanges
from torchvo360.checks import InputError, check_choice, check_finite_number
from torchvo360.learn import load_checkpoint, save_checkpoint
from torchvo360.learn.checkpoint import read_config
from torchvo360.learn.depth import PanoramaDepth
from views import AppearanceConfig
from worlds import ViewsConfig

MODES = ("supervised", "neighbours")


@dataclass(kw_only=True)
class NetworkConfig:
    """The network, where it begins anew."""

    width: int = 256
    """Width at which it sees a panorama, pixels."""
    channels: list[int] = field(default_factory=lambda: [16, 32, 48, 64, 64])
    """Channels of its levels, the finest first."""


@dataclass(kw_only=True)
class DepthTraining(TrainingConfig):
    """Settings of train/depth.py."""

    mode: str = "supervised"
    """supervised, by true ranges, or neighbours, by views that must look alike (conf/train/mode)."""
    start: str | None = None
    """Checkpoint whose network is taught on; null for a new one."""
    common_error: float = 1.0
    """Weight of a view's mean error of log rho, which is that of its scale, beside the likelihood."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    views: ViewsConfig = field(default_factory=ViewsConfig)
    """What is learned from."""
    held_back: ViewsConfig = field(default_factory=ViewsConfig)
    """What is validated on."""
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    neighbours: NeighboursConfig = field(default_factory=NeighboursConfig)
    walks: WalksConfig = field(default_factory=WalksConfig)
    """What the odometry is tried on at the end."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("mode", self.mode, MODES)
        check_finite_number("common_error", self.common_error, above=-1e-9)
        ours, theirs = (range(it.first_seed, it.first_seed + it.worlds) for it in (self.views, self.held_back))
        if ours.start < theirs.stop and theirs.start < ours.stop:
            raise InputError(f"held_back.first_seed: expected worlds outside {ours}, got {theirs}.")


def experiment(config: DepthTraining) -> Ranges:
    """Make the experiment that the settings describe.

    Raises:
        InputError: The network to start from is none of ours.
    """
    module = PanoramaDepth(config.network.width, config.network.channels)
    if config.start is not None:
        learned = load_checkpoint(Path(config.start).expanduser())
        if not isinstance(learned, PanoramaDepth):
            raise InputError(f"start: expected a checkpoint of PanoramaDepth, got {type(learned).__name__}.")
        module = learned
    parts = (module, config.trainer, config.views, config.held_back, config.appearance)
    if config.mode == "supervised":
        return TrueRanges(*parts, common_error=config.common_error)
    return Neighbours(*parts, config=config.neighbours)


def run(config: DepthTraining, folder: Path, train: Train) -> list[str]:
    """Train, and try the best network in the odometry; its figures go into the checkpoint."""
    outcome = train(experiment(config))
    if not outcome.success or not config.walks.frames or not is_first():
        return []
    network = load_checkpoint(outcome.checkpoint)
    walks = walk_through(network, config.walks)
    write_walks(folder / "walks.csv", walks)
    figures = figures_of(walks)
    beside = read_config(outcome.checkpoint)
    save_checkpoint(outcome.checkpoint, network, {**beside, "figures": {**beside["figures"], **figures}})
    off, worst = (100 * figures[name] for name in ("walk_scale_error", "walk_scale_error_worst"))
    ate, without = figures["walk_ate_percent"], figures["walk_ate_percent_without"]
    return [
        f"odometry on {len(walks)} walks never trained on: scale off by {off:.1f} % (median), {worst:.1f} % (worst);",
        f"ATE {ate:.3f} % of the path (median), {without:.3f} % without learned range: walks.csv",
    ]


if __name__ == "__main__":
    sys.exit(main("depth", DepthTraining, run))
