"""A moving object that covers a given share of the view: an upright textured cylinder that goes along with the camera.

It keeps near the camera, wherever that goes, but sways about it from side to side, nearer and farther, up and down:
neither the camera's motion in the world nor none at all explains what is seen of it.
"""

import math
from dataclasses import fields, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.data.synthetic.surfaces import Faces
from torchvo360.data.synthetic.world import Traveller, World

MOST_SHARE = 0.4
DISTANCE = 0.4
"""From the camera to the cylinder's axis on average, metres: within the free width beside the walkway."""
TALLNESS = 1.4
"""Height over diameter."""
SWAY, NEARER, HIGHER = 0.7, 0.02, 0.03
"""How far it sways: about the camera, radians; towards it, as a share of the distance; upwards, metres."""
TEXELS_AT_1_M = 100.0
"""Texels a metre that show structure at every pyramid level from a distance of 1 m."""


def with_companion(world: World, T_world_cam: Float64[Tensor, "N 4 4"], fps: float, share: float, seed: int) -> World:
    """Return the world with a cylinder that covers a share of the sphere around a moving camera.

    Args:
        world: A world; what is in it keeps its place and its looks.
        T_world_cam: The camera's path.
        fps: Poses a second.
        share: Part of the whole solid angle, above 0 and up to 0.4: the average, which varies by about a tenth of it.
        seed: Where it is, how it moves and which part of its material is seen.
    """
    generator = torch.Generator().manual_seed(seed + 2)
    phase = math.tau * torch.rand(4, generator=generator, dtype=torch.float64)
    time = torch.arange(len(T_world_cam), dtype=torch.float64) / fps
    towards = phase[0] + 0.25 * time + SWAY * torch.sin(1.3 * time + phase[1])
    away = DISTANCE * (1 + NEARER * torch.sin(2.3 * time + phase[2]))
    up = HIGHER * torch.sin(1.1 * time + phase[3])
    path = (T_world_cam[:, :3, 3] + torch.stack([away * towards.cos(), away * towards.sin(), up], -1)).float()

    radius = _radius(share)
    visible = ((DISTANCE - radius) + math.sqrt(DISTANCE**2 - radius**2)) / 2
    solids, faces = world.solids, world.surfaces.faces
    number = len(solids.centre)
    solids = replace(
        solids,
        centre=torch.cat([solids.centre, path[:1]]),
        half=torch.cat([solids.half, torch.tensor([[radius, radius, TALLNESS * radius]])]),
        heading=torch.cat([solids.heading, torch.tensor([[1.0, 0.0]])]),
        is_round=torch.cat([solids.is_round, torch.tensor([True])]),
    )
    side = torch.eye(3).repeat_interleave(2, 1) * torch.tensor([1.0, -1.0] * 3)
    added = Faces(
        chart=faces.chart[6:-1].amax().expand(6),  # the last material that a solid wears: none is plain
        corner=512 * torch.rand(2, 6, generator=generator),
        density=torch.full((6,), TEXELS_AT_1_M / visible),
        tint=torch.ones(3, 6),
        normal=side,
    )
    # the faces of the sky stay the last
    joined = (
        torch.cat([getattr(faces, f.name)[..., :-1], getattr(added, f.name), getattr(faces, f.name)[..., -1:]], -1)
        for f in fields(Faces)
    )
    surfaces = replace(world.surfaces, faces=Faces(*joined))
    return replace(
        world, solids=solids, surfaces=surfaces, movers=(*world.movers, Traveller(number, path - path[0], fps))
    )


def _radius(share: float) -> float:
    """Return the cylinder's radius, metres, by bisection."""
    low, high = 0.0, DISTANCE
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if _share(middle) < share else (low, middle)
    return low


def _share(radius: float) -> float:
    """Return the share of the sphere that a cylinder covers, seen from its middle height.

    At the azimuth phi it begins at the distance rho and ends at the elevations +-atan(h / rho): the integral of
    2 sin(atan(h / rho)) over phi.
    """
    # phi = asin(r / d) sin(x): more samples where the silhouette is steep
    x = (torch.arange(4096, dtype=torch.float64) + 0.5) / 4096 * math.pi - math.pi / 2
    most = math.asin(radius / DISTANCE)
    phi = most * x.sin()
    rho = DISTANCE * phi.cos() - (radius**2 - (DISTANCE * phi.sin()) ** 2).clamp_min(0).sqrt()
    covered = 2 * (TALLNESS * radius) / torch.hypot(rho, torch.full_like(rho, TALLNESS * radius))
    return float((covered * most * x.cos()).sum() * (math.pi / 4096) / (4 * math.pi))
