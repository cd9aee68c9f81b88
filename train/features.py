"""Learn features by aligning with them: `python train/features.py [key=value ...]`.

A batch of pairs under changing light is aligned from wrong starts, from the coarsest level to the finest; the loss is
the error of the pose after every level, whose gradient flows back through all steps of the solver into the network.
The starts become worse during the first part of the training. At the end the basin of convergence is measured.
"""

import math
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64
from torch import Tensor, nn

from basin import BasinConfig, measure_basin
from basin_report import figures_of, report_basin
from command import Train, TrainingConfig, is_first, main
from illumination import IlluminationConfig, relit
from pairs import PairsConfig, ViewPairs, displaced, drawn, median_range, render_pairs, turned
from torchvo360 import AlignConfig
from torchvo360.checks import InputError
from torchvo360.learn import FeatureExtractor, FeaturePyramid, build, load_checkpoint, save_checkpoint
from torchvo360.learn.checkpoint import read_config
from torchvo360.learn.features import align_features, feature_alignment, pair_features
from torchvo360.learn.range_losses import warped
from torchvo360.learn.record import add_picture
from torchvo360.lie import se3_exp, se3_inverse, se3_log

ASTRAY_PX = 2.0
"""In training, a level that ends farther from the truth than so many of its pixels hands over a pose as far as that."""

TINY = 1e-12
"""Added to squares under a root: at zero its gradient is infinite."""


def _network() -> dict[str, Any]:
    return {"_target_": "torchvo360.learn.features.PanoramaFeatures"}


@dataclass(kw_only=True)
class FeaturesConfig(TrainingConfig):
    """Settings of train/features.py."""

    features: dict[str, Any] = field(default_factory=_network)
    """The network: features._target_=my.module.Net names another one, +features.x=... gives it an argument x."""
    pairs: PairsConfig = field(default_factory=PairsConfig)
    illumination: IlluminationConfig = field(default_factory=IlluminationConfig)
    unchanged: float = 0.2
    """Share of the pairs whose light does not change."""
    steps_by_level: list[int] = field(default_factory=lambda: [2, 2, 3, 3, 4, 4, 6])
    """Steps of the solver in training, the finest level first."""
    start_rotation_deg: list[float] = field(default_factory=lambda: [40.0, 180.0])
    """Largest error of a start's rotation at the beginning of the training, and after `harder_steps`."""
    start_translation_m: list[float] = field(default_factory=lambda: [0.5, 3.0])
    """Largest error of a start's translation, likewise."""
    harder_steps: int = 120
    """Steps over which the starts become worse."""
    validation_pairs: int = 48
    """Pairs of each kind of world in other worlds, on which training is watched."""
    measure: bool = True
    """Measure the basin of convergence at the end, which takes some minutes."""
    basin: BasinConfig = field(default_factory=BasinConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.unchanged <= 1 or self.harder_steps < 1 or self.validation_pairs < 1:
            raise InputError(
                "unchanged, harder_steps, validation_pairs: expected a share and two numbers of at least 1, "
                f"got {self.unchanged}, {self.harder_steps} and {self.validation_pairs}."
            )
        if not self.steps_by_level or min(self.steps_by_level) < 1:
            raise InputError(f"steps_by_level: expected positive numbers of steps, got {self.steps_by_level}.")
        for name in ("start_rotation_deg", "start_translation_m"):
            if len(getattr(self, name)) != 2 or min(getattr(self, name)) < 0:
                raise InputError(f"{name}: expected two numbers of at least 0, got {getattr(self, name)}.")

    def drawn_error(
        self, hardness: float, count: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Draw errors of starts, radians and metres: from those of the beginning, 0, to those of the end, 1."""
        angle, distance = (
            torch.rand(count, generator=generator) * (first + (last - first) * hardness)
            for first, last in (self.start_rotation_deg, self.start_translation_m)
        )
        return angle.deg2rad(), distance


@dataclass
class FeatureExperiment:
    """Features, learned by the error of the pose that they lead to."""

    module: nn.Module
    spec: dict[str, Any]
    config: FeaturesConfig
    pairs: ViewPairs
    held_back: ViewPairs
    """Pairs of other worlds, the target under another light."""
    start: Float64[Tensor, "n 4 4"]
    """Wrong poses of those."""

    @classmethod
    def make(cls, config: FeaturesConfig) -> "FeatureExperiment":
        """Build the network and render the worlds."""
        network = build(config.features, FeatureExtractor)
        other = PairsConfig(**{**vars(config.pairs), "pairs": config.validation_pairs, "seed": config.pairs.seed + 1})
        generator = torch.Generator().manual_seed(other.seed)
        held_back = turned(render_pairs(other), generator)
        held_back = held_back.with_images(held_back.ref, relit(held_back.tgt, config.illumination, generator))
        angle, distance = config.drawn_error(1.0, len(held_back), generator)
        start = displaced(held_back.T_tgt_ref, angle, distance, generator)
        return cls(network, dict(config.features), config, render_pairs(config.pairs), held_back, start)

    def batch(self, step: int, part: int, parts: int) -> dict[str, Tensor]:
        config = self.config
        generator = torch.Generator().manual_seed(config.trainer.seed * 1_000_003 + step)
        size = config.trainer.batch_size
        pairs = drawn(self.pairs, size, config.illumination, config.unchanged, generator)
        angle, distance = config.drawn_error(min(1.0, step / config.harder_steps), size, generator)
        start = displaced(pairs.T_tgt_ref, angle, distance, generator)
        share = config.trainer.share(part, parts)
        mine = slice(share.start, share.stop)
        return {
            "ref": pairs.ref[mine],
            "tgt": pairs.tgt[mine],
            "rho": pairs.rho[mine],
            "T_tgt_ref": pairs.T_tgt_ref[mine],
            "start": start[mine],
        }

    def losses(self, module: nn.Module, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        ref, tgt = pair_features(module, batch["ref"], batch["tgt"])
        scene = median_range(batch["rho"])
        T = batch["start"]
        terms, errors = [], []
        for level in reversed(range(len(ref.maps))):
            # Level by level: a gradient through all of them grows a hundredfold where a pair goes astray.
            one, other = (FeaturePyramid([each.maps[level]], [each.confidence[level]]) for each in (ref, tgt))
            T = align_features(one, other, batch["rho"], T_tgt_ref=T, config=self._settings(level)).T_tgt_ref
            error = pose_error(T, batch["T_tgt_ref"], scene)
            pixel = math.tau / ref.maps[level].shape[-1]
            # A fifth of a pixel is good. The logarithm keeps pairs that went astray from drowning the others.
            terms.append(torch.log1p(error / (0.2 * pixel)).mean())
            errors.append(error.detach().median())
            # The next level learns nothing from where it cannot return from.
            T = drawn_back(T.detach(), batch["T_tgt_ref"], ASTRAY_PX * pixel / error.detach())
        return {"loss": torch.stack(terms).sum(), "error_coarsest": errors[0], "error_finest": errors[-1]}

    def _settings(self, level: int) -> AlignConfig:
        steps = self.config.steps_by_level
        return feature_alignment(backward="unroll", steps_by_level=[steps[min(level, len(steps) - 1)]])

    @torch.no_grad()
    def validate(self, module: nn.Module) -> dict[str, float]:
        pairs = self.held_back.to(_device(module))
        ref, tgt = pair_features(module, pairs.ref, pairs.tgt)
        result = align_features(ref, tgt, pairs.rho, T_tgt_ref=self.start.to(pairs.ref.device))
        error = pose_error(result.T_tgt_ref, pairs.T_tgt_ref, median_range(pairs.rho))
        return {
            "log_error": float(torch.log1p(error / 0.01).mean()),
            "converged": float((error < 0.05).double().mean()),
            "median_error": float(error.median()),
        }

    @torch.no_grad()
    def pictures(self, module: nn.Module) -> dict[str, Float[Tensor, "3 H W"]]:
        pairs = self.held_back.take(slice(0, 2)).to(_device(module))
        start = self.start[:2].to(pairs.ref.device)
        ref, tgt = pair_features(module, pairs.ref, pairs.tgt)
        result = align_features(ref, tgt, pairs.rho, T_tgt_ref=start)
        before, after = (warped(pairs.tgt, pairs.rho, T, pairs.camera) for T in (start, result.T_tgt_ref))
        shown = {
            "images": torch.cat([pairs.ref, pairs.tgt]),
            "warped/from_the_start": torch.cat([pairs.ref, before]),
            "warped/by_the_solution": torch.cat([pairs.ref, after]),
        }
        for level, (one, other) in enumerate(zip(ref.maps, tgt.maps, strict=True)):
            both = torch.cat([one, other])[:, :3]
            colours = F.pad(both, (0, 0, 0, 0, 0, 3 - both.shape[1]))
            shown[f"features/{level}"] = (0.5 + 0.2 * F.interpolate(colours, pairs.ref.shape[-2:])).clamp(0.0, 1.0)
        # References above their targets, pairs side by side.
        return {
            name: torch.cat([torch.cat(list(each), -1) for each in rows.chunk(2)], -2) for name, rows in shown.items()
        }


def pose_error(
    T_tgt_ref: Float64[Tensor, "n 4 4"], true: Float64[Tensor, "n 4 4"], scene: Float64[Tensor, "n"]
) -> Float64[Tensor, "n"]:
    """Return the angle of the rotation's error plus that of the translation's as seen from the scene's range.

    The rotation's is `2 sin(angle / 2)`, which near 0 is the angle, radians. Both have gradients everywhere.
    """
    chord = (T_tgt_ref - true)[:, :3, :3].square().sum((1, 2)) / 2
    shift = ((T_tgt_ref - true)[:, :3, 3] / scene[:, None]).square().sum(-1)
    return (chord + TINY).sqrt() + (shift + TINY).sqrt()


def drawn_back(
    T_tgt_ref: Float64[Tensor, "n 4 4"], true: Float64[Tensor, "n 4 4"], share: Float64[Tensor, "n"]
) -> Float64[Tensor, "n 4 4"]:
    """Return poses of which a share of the error is left, or all where the share is above 1."""
    left = share.clamp_max(1.0)[:, None] * se3_log(T_tgt_ref @ se3_inverse(true))
    return se3_exp(left) @ true


def _device(module: nn.Module) -> torch.device:
    return next(module.parameters()).device


def run(config: FeaturesConfig, folder: Path, train: Train) -> list[str]:
    """Learn features, and measure the basin of the best network; its figures go into the checkpoint."""
    outcome = train(FeatureExperiment.make(config))
    if not (config.measure and outcome.success and is_first()):
        return []
    network = load_checkpoint(outcome.checkpoint, target=config.features["_target_"])
    rows = measure_basin(network, config.basin, config.illumination)
    beside = read_config(outcome.checkpoint)
    save_checkpoint(outcome.checkpoint, network, {**beside, "figures": {**beside["figures"], **figures_of(rows)}})
    table = report_basin(folder, rows)
    picture = torch.from_numpy(cv2.imread(str(folder / "basin.png"))).flip(-1).permute(2, 0, 1) / 255
    add_picture(folder, outcome.steps, "basin", picture)
    return table


if __name__ == "__main__":
    sys.exit(main("features", FeaturesConfig, run))
