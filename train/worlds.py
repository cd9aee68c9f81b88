"""Worlds to learn range in: the named ones, and halls of any size and furnishing, with places to look from."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import InputError, check_choice, check_finite_number
from torchvo360.data.synthetic import WORLDS, World, make_world
from torchvo360.data.synthetic.builder import Builder
from torchvo360.data.synthetic.motion import SPEED, UPRIGHT, trajectory
from torchvo360.data.synthetic.surfaces import Lamp
from torchvo360.data.synthetic.world import Walkway
from torchvo360.lie import se3, so3_exp

HALL = "hall"
MATERIALS = ("plaster", "brick", "planks", "paving", "mural", "collage", "stones")
CLEARANCE = 0.35
"""Least distance of a camera from any surface, metres."""
FPS, STRIDE = 30.0, 40
"""Frames a second of a walk, and frames between views, over which each is shifted at random."""


@dataclass(kw_only=True)
class ViewsConfig:
    """What is rendered to learn range from."""

    kinds: list[str] = field(default_factory=lambda: [HALL, *WORLDS])
    """Kinds of worlds, in turn: room, pillars, courtyard, or hall, which has another size and furnishing every time."""
    worlds: int = 240
    """Number of worlds."""
    first_seed: int = 10_000_000
    """Seed of the first world; the others follow."""
    walking: int = 10
    """Views of a world from a walk, as a sequence has them: at the height of an eye that walks, nearly upright."""
    anywhere: int = 6
    """Views of a world from anywhere in it: 0.9 to 2.1 m high, tilted by up to 15 deg."""
    neighbour_m: float = 0.15
    """Distance to a neighbour before and one behind each view, where neighbours are learned from."""

    def __post_init__(self) -> None:
        for kind in self.kinds:
            check_choice("kinds", kind, (HALL, *WORLDS))
        if not self.kinds or self.worlds < 1:
            raise InputError(f"kinds, worlds: expected at least one each, got {self.kinds} and {self.worlds}.")
        if min(self.walking, self.anywhere) < 0 or self.walking + self.anywhere < 1:
            got = f"{self.walking} and {self.anywhere}"
            raise InputError(f"walking, anywhere: expected no negative number and at least one view, got {got}.")
        if not 0 <= self.first_seed < 2**31:
            raise InputError(f"first_seed: expected 0 to {2**31 - 1}, got {self.first_seed}.")
        check_finite_number("neighbour_m", self.neighbour_m, above=0.0, at_most=CLEARANCE - 0.05)

    @property
    def views(self) -> int:
        """The number of views."""
        return self.worlds * (self.walking + self.anywhere)


def world_of(kind: str, seed: int) -> World:
    """Make a world of a kind."""
    return _hall(seed) if kind == HALL else make_world(kind, seed=seed)


def places(world: World, seed: int, config: ViewsConfig) -> Float64[Tensor, "n 3 4 4"]:
    """Draw poses T_world_cam of views, those on a walk first, each with its neighbours before and behind."""
    generator = torch.Generator().manual_seed(seed)
    gap = max(1, round(config.neighbour_m / SPEED * FPS))
    stride = STRIDE + 2 * gap
    start = torch.randint(0, STRIDE, (config.walking,), generator=generator)
    index = gap + torch.arange(config.walking) * stride + start
    walk = trajectory("walk", world.walkway, config.walking * stride, FPS, seed=seed)
    walking = walk[torch.stack([index, index - gap, index + gap], 1)]
    anywhere = _free_places(world, generator, config.anywhere)
    angle = math.tau * torch.rand(config.anywhere, generator=generator, dtype=torch.float64)
    aside = torch.zeros_like(anywhere)
    aside[:, 0, 3], aside[:, 1, 3] = angle.cos() * config.neighbour_m, angle.sin() * config.neighbour_m
    return torch.cat([walking, torch.stack([anywhere, anywhere - aside, anywhere + aside], 1)])


def _free_places(world: World, generator: torch.Generator, count: int) -> Float64[Tensor, "n 4 4"]:
    half = world.solids.half[0, :2]
    found = torch.zeros(0, 3, dtype=torch.float64)
    while len(found) < count:
        share = torch.rand(64, 3, generator=generator, dtype=torch.float64)
        point = torch.cat([(2 * share[:, :2] - 1) * half, 0.9 + 1.2 * share[:, 2:]], -1)
        found = torch.cat([found, point[world.clearance(point) > CLEARANCE]])
    yaw, tilt, toward = torch.rand(3, count, generator=generator, dtype=torch.float64)
    toward = toward * math.tau
    lean = torch.stack([toward.cos(), torch.zeros_like(tilt), toward.sin()], -1) * (tilt * math.radians(15))[:, None]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return se3(so3_exp(math.tau * yaw[:, None] * up) @ UPRIGHT @ so3_exp(lean), found[:count])


def _hall(seed: int) -> World:
    """Make a world whose size, walkway, openness, furnishing and looks are drawn."""
    generator = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    length, width, height = draw(6.0, 20.0), draw(5.0, 15.0), draw(2.4, 4.6)
    walkway = Walkway(
        radii=(min(2.0, length * draw(0.18, 0.26)), min(2.0, width * draw(0.18, 0.26))),
        centre=(draw(-0.4, 0.4), draw(-0.3, 0.3)),
        eye_height=draw(1.4, 1.75),
    )
    count = 5
    chosen = torch.randperm(len(MATERIALS), generator=generator)[:count].tolist()
    is_open = draw(0, 1) < 0.35
    materials = (*(MATERIALS[k] for k in chosen), *(("clouds",) if is_open else ()))
    looks = materials[:count]
    b = Builder(generator, (length, width, height), walkway, materials, draw(75.0, 110.0))
    area = length * width
    b.place(
        round(area * draw(0.02, 0.12)),
        looks,
        radius=(0.12, draw(0.2, 0.4)),
        height=(0.9 * height, 1.3 * height if is_open else height),
        rounds=draw(0, 1),
        gap=draw(0.2, 0.8),
    )
    b.place(round(area * draw(0.04, 0.2)), looks, radius=(0.12, draw(0.3, 0.8)), height=(0.3, draw(0.6, 2.2)))
    b.stack(6, looks, most_height=1.5)
    b.hang(6, looks)
    shell = [(b.chart(*looks), b.tint(0.7)) for _ in range(6)]
    reach = draw(2.0, 5.0)
    lamps = tuple(
        Lamp((draw(-0.4, 0.4) * length, draw(-0.4, 0.4) * width, height - 0.2), draw(0.5, 0.8), reach) for _ in range(2)
    )
    sky = b.chart("clouds") if is_open else None
    return b.build(HALL, shell, lamps=lamps, ambient=draw(0.55, 0.7), sky=sky)
