"""Measure basins of convergence: `python train/basin.py --checkpoint PATH`.

From how far away does an alignment find the true pose? Pairs of views in worlds never trained on are aligned from
starts displaced by given angles and distances in random directions, by raw intensity and by learned features, under
the same light and under another. A pair has CONVERGED if it ends within 1 deg and 5 % of the scene's median range of
the true pose, whatever the solver says of itself.
"""

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor, nn

from basin_report import BOTH, OTHER, ROTATION, SAME, TRANSLATION, Row, report_basin
from illumination import IlluminationConfig, relit
from pairs import PairsConfig, ViewPairs, displaced, median_range, render_pairs, turned
from torchvo360 import AlignConfig, align
from torchvo360.checks import InputError, check_choice
from torchvo360.data.synthetic import WORLDS
from torchvo360.learn import FeaturePyramid, load_checkpoint
from torchvo360.learn.features import (
    COARSE,
    align_features,
    feature_alignment,
    pair_features,
    spread,
    spread_matrix,
    standardise,
)
from torchvo360.lie import so3_angle

MAX_ROTATION_DEG = 1.0
MAX_SHARE_OF_RANGE = 0.05
"""Within both of these of the true pose a pair has converged: a third of a pixel of 128 x 64 panoramas."""

END_OF_CURVE = 0.1
"""A method that so few pairs converge by is not tried from farther away."""

Aligner = Callable[[Float64[Tensor, "n 4 4"]], Float64[Tensor, "n 4 4"]]
"""Starts to solutions, of one set of pairs."""


@dataclass(kw_only=True)
class BasinConfig:
    """What is measured."""

    kinds: list[str] = field(default_factory=lambda: ["room", "pillars", "courtyard"])
    """Kinds of worlds; the courtyard is none to train on."""
    pairs: int = 32
    """Pairs of each kind."""
    seed: int = 1001
    """Seed of the worlds, none of those trained on."""
    width: int = 128
    """Width of the panoramas, pixels."""
    rotations_deg: list[float] = field(default_factory=lambda: [10, 20, 30, 45, 60, 75, 90, 105, 120, 135, 150, 165])
    """Errors of starts that are wrong by 2 cm besides."""
    translations_m: list[float] = field(default_factory=lambda: [0.2, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0])
    """Errors of starts that are wrong by 2 deg besides."""
    both_deg: list[float] = field(default_factory=lambda: [15, 30, 45, 60, 75, 90, 105, 120])
    """Errors of starts that are wrong by 2 cm for each degree besides."""
    coarsest_widths: list[int] = field(default_factory=lambda: [64, 32, 16])
    """`AlignConfig.coarsest_width` of intensity, of which the best is taken at every point."""

    def __post_init__(self) -> None:
        for kind in self.kinds:
            check_choice("kinds", kind, WORLDS)
        if (
            not self.kinds
            or not self.coarsest_widths
            or not (self.rotations_deg or self.translations_m or self.both_deg)
        ):
            raise InputError(
                "basin: expected at least one kind, one coarsest width and one error of a start, got none."
            )
        if self.pairs < 1:
            raise InputError(f"pairs: expected at least 1, got {self.pairs}.")

    def scans(self) -> Iterator[tuple[str, float, float, float]]:
        """Yield what is displaced, by how much, and that in degrees and metres."""
        for angle in self.rotations_deg:
            yield ROTATION, angle, angle, 0.02
        for distance in self.translations_m:
            yield TRANSLATION, distance, 2.0, distance
        for angle in self.both_deg:
            yield BOTH, angle, angle, 0.02 * angle


def intensity(pairs: ViewPairs, config: AlignConfig, *, colour: bool) -> Aligner:
    """Align by the images themselves, three channels or their mean."""
    ref, tgt = (image if colour else image.mean(1, keepdim=True) for image in (pairs.ref, pairs.tgt))
    return lambda start: align(ref, tgt, pairs.rho, pairs.camera, T_tgt_ref=start, config=config).T_tgt_ref


def learned(pairs: ViewPairs, network: nn.Module) -> Aligner:
    """Align by what a network makes of the images."""
    with torch.no_grad():
        ref, tgt = pair_features(network, pairs.ref, pairs.tgt)
    settings = feature_alignment(backward="none")
    return lambda start: align_features(ref, tgt, pairs.rho, T_tgt_ref=start, config=settings).T_tgt_ref


class SpreadColour(nn.Module):
    """The image itself as features, halved and spread as the learned ones are: what spreading does without learning."""

    def forward(self, image: Float[Tensor, "B 3 H W"]) -> FeaturePyramid:
        """Return the pyramid of panoramas with values in [0, 1]."""
        maps = [image]
        while maps[-1].shape[-1] > COARSE.width:
            maps.append(nn.functional.avg_pool2d(maps[-1], 2))
        spreads = [spread(maps[-1], spread_matrix(COARSE, math.radians(angle))) for angle in (15.0, 30.0, 60.0)]
        maps = [standardise(each) for each in maps + spreads]
        return FeaturePyramid(maps, [torch.ones_like(each[:, 0]) for each in maps])


def methods(pairs: ViewPairs, network: nn.Module, config: BasinConfig) -> dict[str, Aligner]:
    """Return what is compared, on one set of pairs; the names of intensity's settings begin with `intensity`."""
    aligners = {
        f"intensity {'colour' if colour else 'gray'} {width}{' affine' if affine else ''}": intensity(
            pairs, AlignConfig(coarsest_width=width, affine=affine, backward="none"), colour=colour
        )
        for colour in (False, True)
        for width in config.coarsest_widths
        for affine in (True, False)
    }
    return {**aligners, "spread colour": learned(pairs, SpreadColour()), "features": learned(pairs, network)}


def has_converged(
    T_tgt_ref: Float64[Tensor, "n 4 4"], pairs: ViewPairs
) -> tuple[Bool[Tensor, "n"], Float64[Tensor, "n"], Float64[Tensor, "n"]]:
    """Return which pairs have converged, and the errors: degrees, and shares of the scene's median range."""
    true = pairs.T_tgt_ref
    rotation = so3_angle(T_tgt_ref[:, :3, :3] @ true[:, :3, :3].mT).rad2deg()
    share = torch.linalg.vector_norm((T_tgt_ref - true)[:, :3, 3], dim=-1) / median_range(pairs.rho)
    return (rotation < MAX_ROTATION_DEG) & (share < MAX_SHARE_OF_RANGE), rotation, share


def measure_basin(network: nn.Module, config: BasinConfig, illumination: IlluminationConfig) -> list[Row]:
    """Measure every method on every scan under both lights; all see the same pairs and the same starts.

    Args:
        network: Gives the features.
        config: What is measured.
        illumination: The strongest change of light.

    Returns:
        Points of the curves of every method, scan and light, over all worlds and over each kind.
    """
    kinds = PairsConfig(kinds=config.kinds, pairs=config.pairs, seed=config.seed, width=config.width)
    generator = torch.Generator().manual_seed(config.seed)
    same = turned(render_pairs(kinds), generator)
    other = same.with_images(same.ref, relit(same.tgt, illumination, generator))
    starts = [
        displaced(same.T_tgt_ref, math.radians(angle), distance, generator) for _, _, angle, distance in config.scans()
    ]
    rows = []
    for light, pairs in ((SAME, same), (OTHER, other)):
        for method, aligned in methods(pairs, network, config).items():
            ended: set[str] = set()
            for (scan, size, _, _), start in zip(config.scans(), starts, strict=True):
                if scan in ended:
                    continue
                converged, rotation, share = has_converged(aligned(start), pairs)
                if float(converged.double().mean()) < END_OF_CURVE:
                    ended.add(scan)
                for kind, part in _parts(config):
                    good = converged[part]
                    errors = (float(each[part][good].nanmedian()) for each in (rotation, share))
                    rows.append(Row(method, light, scan, size, kind, float(good.double().mean()), *errors))
    return rows


def _parts(config: BasinConfig) -> Iterator[tuple[str, slice]]:
    yield "all", slice(None)
    for k, kind in enumerate(config.kinds):
        yield kind, slice(k * config.pairs, (k + 1) * config.pairs)


def main(argv: list[str] | None = None) -> int:
    """Measure a checkpoint and write basin.csv, basin.md and basin.png; return the exit code."""
    parser = argparse.ArgumentParser("train/basin.py", description="Measure basins of convergence.")
    parser.add_argument("--checkpoint", required=True, type=Path, help="a .safetensors with its .json beside it")
    parser.add_argument("--target", help="dotted name of the network's class, where it is not one of the package's")
    parser.add_argument("--out", type=Path, default=Path("runs/basin"), help="folder of the results (%(default)s)")
    parser.add_argument("--pairs", type=int, default=BasinConfig.pairs, help="pairs of each kind (%(default)s)")
    parser.add_argument("--kinds", nargs="+", default=BasinConfig().kinds, help="kinds of worlds (%(default)s)")
    parser.add_argument("--seed", type=int, default=BasinConfig.seed, help="of the worlds (%(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="threads to compute with (%(default)s)")
    arguments = parser.parse_args(argv)
    try:
        torch.set_num_threads(arguments.threads)
        config = BasinConfig(kinds=arguments.kinds, pairs=arguments.pairs, seed=arguments.seed)
        network = load_checkpoint(arguments.checkpoint, arguments.target)
        arguments.out.mkdir(parents=True, exist_ok=True)
        lines = report_basin(arguments.out, measure_basin(network, config, IlluminationConfig()))
    except InputError as error:
        print(f"train/basin.py: {error}", file=sys.stderr)
        return 2
    print("\n".join([*lines, f"results: {arguments.out}"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
