"""Where two keyframes lie to each other, from nothing: any orientation, a few decimetres, any scale.

A search over all rotations on the smoothed coarsest level; from each distinct rotation that makes the images agree,
five starts: at the place and a fifth of the median range to each side. All are solved in one batch on the coarsest
level, and the best goes on to the finer ones. With the start at the place alone, 21 of 42 pairs at 0.5 m are found
(median range 2 m), with five 40 of 42; more rotations in place of shifts find none more.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.loop.config import VerifyConfig
from torchvo360.loop.frame import LoopFrame
from torchvo360.loop.similarity import LevelPair, directions, solve_similarity
from torchvo360.motion.rotation import rotation_grid, search_rotation
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.solve import Status

GRID_STEP_RAD = 0.43
"""Spacing of the rotation search, as in relocalisation: about a thousand rotations."""
BLUR_PX = 1.0
"""Smoothing of the coarsest level for the rotation search."""
SAME_ROTATION_RAD = 0.35
"""Rotations nearer to a better one than this are the same start."""
MIN_ROTATION_AGREEMENT = 0.05
"""Rotations that match less of the small images' gradient are not followed. True ones reach 0.1 at a distance of a
quarter of the median range."""
MIN_COARSE_AGREEMENT = 0.1
"""Share of agreeing gradient on the coarsest level, in the worse direction, below which no finer one is tried: true
solutions reach 0.17, and of 126 pairs of other places 123 do not reach this and are done in a third of the time."""
SHIFTS = ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (-0.2, 0.0, 0.0), (0.0, 0.0, 0.2), (0.0, 0.0, -0.2))
"""Translations tried, in median ranges of B's points along B's axes; people carry cameras at one height."""


class Registration(NamedTuple):
    """The joint solution of two keyframes on the finest level."""

    pair: LevelPair
    S_b_a: Float64[Tensor, "1 4 4"]
    affine: Float64[Tensor, "1 4"]
    """Brightness (a, b) from A to B and from B to A."""
    equations: NormalEquations
    """By (v, w, sigma, a, b, a, b), of batch 1."""
    status: Status


def search_starts(a: LoopFrame, b: LoopFrame, most: int) -> tuple[Float64[Tensor, "K 3 3"], Float64[Tensor, "K 2"]]:
    """Return distinct rotations R_b_a, the best first, and the brightness of each; none where no images agree."""
    coarsest = len(a.cameras) - 1
    grid = rotation_grid(GRID_STEP_RAD).to(a.ray.device)
    found = search_rotation(_all_pixels(a.target(coarsest, BLUR_PX)), b.target(coarsest, BLUR_PX), grid)
    apart = lie.so3_angle(found.R_tgt_ref[:, None] @ found.R_tgt_ref.mT)
    repeats = (apart < SAME_ROTATION_RAD).tril(-1).any(-1)
    index = (~repeats & (found.agreement >= MIN_ROTATION_AGREEMENT)).nonzero()[:most, 0]
    return found.R_tgt_ref[index], found.affine[index]


def _all_pixels(target: Target) -> Reference:
    camera = target.camera
    value = target.padded[..., 1:-1, 1:-1].reshape(1, 1, -1)
    area = camera.solid_angle(camera.pixel_grid(device=value.device)).reshape(1, -1)
    weight = area / area.mean()
    if target.confidence is not None:
        weight = weight * target.confidence[..., 1:-1, 1:-1].reshape(1, -1)
    ray = camera.ray_grid(device=value.device).permute(2, 0, 1).reshape(1, 3, -1).contiguous()
    return Reference(ray, torch.zeros_like(weight), value, weight)


def _median_scale(pair: LevelPair, R_b_a: Float64[Tensor, "K 3 3"]) -> Float64[Tensor, "K"]:
    """Return the scale that makes the ranges of neighbouring points equal, as if the cameras stood at one place."""
    forward = pair.ranges_forward(lie.se3(R_b_a, R_b_a.new_zeros(len(R_b_a), 3)))
    # A scale s divides the moved rho: what is too large by a factor needs that factor.
    difference = forward.difference.masked_fill(forward.weight == 0, torch.nan)
    return difference.nanmedian(-1).values.nan_to_num(nan=0.0).double().clamp(-5, 5).exp()


def _spread_starts(
    pair: LevelPair, R_b_a: Float64[Tensor, "K 3 3"], affine: Float64[Tensor, "K 2"]
) -> tuple[Float64[Tensor, "M 4 4"], Float64[Tensor, "M 4"]]:
    """Return similarities and brightness in both directions: every shift from every rotation."""
    scale = _median_scale(pair, R_b_a)
    shift = R_b_a.new_tensor(SHIFTS) / pair.points_b.rho.median().double()
    turned = (R_b_a * scale[:, None, None]).repeat_interleave(len(shift), 0)
    back = torch.stack([-affine[:, 0], -affine[:, 1] * (-affine[:, 0]).exp()], -1)
    return lie.se3(turned, shift.repeat(len(R_b_a), 1)), torch.cat([affine, back], -1).repeat_interleave(len(shift), 0)


def register(
    a: LoopFrame, b: LoopFrame, R_b_a: Float64[Tensor, "K 3 3"], affine: Float64[Tensor, "K 2"], config: VerifyConfig
) -> Registration | None:
    """Align two keyframes by Sim(3) from rotations, coarse to fine; None where the coarsest level shows two places.

    Args:
        a: A keyframe.
        b: Another, with levels of the same cameras.
        R_b_a: Rotations to start from, at least one (`search_starts`).
        affine: Brightness (a, b) from A to B, for each.
        config: Settings.
    """
    coarsest = len(a.cameras) - 1
    pair = _level_pair(a, b, coarsest, config)
    found = _best(pair, *_spread_starts(pair, R_b_a, affine), config, coarsest=True)
    if min(way.agreement for way in directions(pair, found.S_b_a, found.affine)) < MIN_COARSE_AGREEMENT:
        return None
    for level in range(coarsest - 1, -1, -1):
        found = _best(_level_pair(a, b, level, config), found.S_b_a, found.affine, config, coarsest=False)
    return found


def _best(
    pair: LevelPair,
    S_b_a: Float64[Tensor, "K 4 4"],
    affine: Float64[Tensor, "K 4"],
    config: VerifyConfig,
    *,
    coarsest: bool,
) -> Registration:
    """Solve one level from every start and return the solution of lowest cost."""
    solution = solve_similarity(pair, S_b_a, affine, config.align_config(coarsest=coarsest), config.max_steps)
    equations = solution.equations
    cost = equations.cost / equations.weight.clamp_min(1.0)
    unusable = (solution.status == Status.TOO_FEW_PIXELS) | ~torch.isfinite(cost)
    best = cost.masked_fill(unusable, torch.inf).argmin()[None]
    S, ab = (part[best] for part in solution.state)
    at_best = NormalEquations(*(part[best] for part in equations))
    return Registration(pair, S, ab, at_best, Status(int(solution.status[best])))


def _level_pair(a: LoopFrame, b: LoopFrame, level: int, config: VerifyConfig) -> LevelPair:
    most, compared = config.most_points(level), config.range_points
    image_a, image_b = a.target(level), b.target(level)
    coarsest = level == len(a.cameras) - 1
    return LevelPair(
        a.points(image_a, most), b.points(image_b, most), image_a, image_b, compared // 4 if coarsest else compared
    )
