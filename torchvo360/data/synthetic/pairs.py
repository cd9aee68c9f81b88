"""Random image pairs with exact range and motion, to align against."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError, check_finite_number
from torchvo360.data.synthetic.layouts import make_world
from torchvo360.data.synthetic.motion import UPRIGHT
from torchvo360.data.synthetic.rays import CameraRays
from torchvo360.data.synthetic.world import World
from torchvo360.lie import se3, se3_inverse, so3_exp

PAIRS_PER_WORLD = 32
CLEARANCE = 0.4
"""Least distance of a reference camera from any surface, metres."""


@dataclass(frozen=True)
class Pairs:
    """A batch of pairs; the target is `gain * colour + bias`, clipped to [0, 1]."""

    camera: Equirectangular
    ref: Float[Tensor, "n C H W"]
    tgt: Float[Tensor, "n C H W"]
    rho: Float[Tensor, "n H W"]
    """Exact inverse range of the reference, 1/m; 0 for the sky."""
    T_tgt_ref_true: Float64[Tensor, "n 4 4"]
    gain: Float[Tensor, "n"]
    bias: Float[Tensor, "n"]

    def __len__(self) -> int:
        return len(self.ref)


def sample_pairs(
    n: int,
    *,
    seed: int = 0,
    width: int = 256,
    height: int = 128,
    max_rotation_deg: float = 4.0,
    max_translation_m: float = 0.07,
    world: str = "room",
    affine: bool = True,
    gray: bool = False,
) -> Pairs:
    """Render pairs from random places in random worlds.

    The reference stands anywhere free, 0.8 to 2.1 m high, with any heading and a tilt of up to 20 deg. The target is
    moved by a rotation and a translation with uniform directions and uniform sizes up to the given ones. Every 32 pairs
    are in a world of their own.

    Args:
        n: Number of pairs.
        seed: Seed of the worlds, poses and brightness; pair k does not depend on n.
        width: Width of the panoramas, pixels.
        height: Height of the panoramas, pixels.
        max_rotation_deg: Largest rotation, degrees.
        max_translation_m: Largest translation, metres; less than 0.35.
        world: Name of the worlds.
        affine: Whether the target's brightness is changed (gain 0.7 to 1.4, bias -0.05 to 0.05).
        gray: Whether images have one channel (the mean of the colours) instead of three.

    Raises:
        InputError: A number is out of its range, or the world's name is another one.
    """
    if n < 1:
        raise InputError(f"n: expected at least 1, got {n}.")
    check_finite_number("max_rotation_deg", max_rotation_deg, above=-1e-9, at_most=180.0)
    check_finite_number("max_translation_m", max_translation_m, above=-1e-9, at_most=CLEARANCE - 0.05)
    camera = Equirectangular(width, height)
    ref = torch.empty(n, 1 if gray else 3, height, width)
    tgt, rho = torch.empty_like(ref), torch.empty(n, height, width)
    T_tgt_ref = torch.empty(n, 4, 4, dtype=torch.float64)
    gain, bias = torch.ones(n), torch.zeros(n)
    rays = CameraRays.of(camera)
    for start in range(0, n, PAIRS_PER_WORLD):
        part = slice(start, min(start + PAIRS_PER_WORLD, n))
        count = part.stop - start
        world_seed = seed * 100_003 + start // PAIRS_PER_WORLD
        place = make_world(world, seed=world_seed)
        generator = torch.Generator().manual_seed(world_seed)
        T_world_ref = _free_poses(place, generator)[:count]
        T_tgt_ref[part] = _small_motions(generator, max_rotation_deg, max_translation_m)[:count]
        light = torch.rand(PAIRS_PER_WORLD, 2, generator=generator)[:count]
        image, reach = place.render(rays, T_world_ref)
        moved, _ = place.render(rays, T_world_ref @ se3_inverse(T_tgt_ref[part]))
        if affine:
            gain[part], bias[part] = 0.7 + 0.7 * light[:, 0], 0.1 * light[:, 1] - 0.05
            moved = moved * gain[part, None, None, None] + bias[part, None, None, None]
        ref[part] = image.mean(1, keepdim=True) if gray else image
        moved = moved.clamp_(0, 1)
        tgt[part] = moved.mean(1, keepdim=True) if gray else moved
        rho[part] = 1 / reach
    return Pairs(camera, ref, tgt, rho, T_tgt_ref, gain, bias)


def _free_poses(world: World, generator: torch.Generator) -> Float64[Tensor, "n 4 4"]:
    """Draw poses T_world_cam in free space, PAIRS_PER_WORLD of them."""
    free: list[Tensor] = []
    while sum(len(points) for points in free) < PAIRS_PER_WORLD:
        share = torch.rand(4 * PAIRS_PER_WORLD, 3, generator=generator, dtype=torch.float64)
        plan = (2 * share[:, :2] - 1) * world.solids.half[0, :2]
        points = torch.cat([plan, 0.8 + 1.3 * share[:, 2:]], -1)
        free.append(points[world.clearance(points) > CLEARANCE])
    position = torch.cat(free)[:PAIRS_PER_WORLD]
    yaw, tilt, toward = torch.rand(3, PAIRS_PER_WORLD, generator=generator, dtype=torch.float64)
    toward = toward * math.tau
    lean = torch.stack([toward.cos(), torch.zeros_like(tilt), toward.sin()], -1) * (tilt * math.radians(20))[:, None]
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return se3(so3_exp(math.tau * yaw[:, None] * z) @ UPRIGHT @ so3_exp(lean), position)


def _small_motions(generator: torch.Generator, rotation_deg: float, translation_m: float) -> Float64[Tensor, "n 4 4"]:
    direction = F.normalize(torch.randn(2, PAIRS_PER_WORLD, 3, generator=generator, dtype=torch.float64), dim=-1)
    size = torch.rand(2, PAIRS_PER_WORLD, 1, generator=generator, dtype=torch.float64)
    R = so3_exp(direction[0] * size[0] * math.radians(rotation_deg))
    return se3(R, direction[1] * size[1] * translation_m)
