"""Furnishing: puts solids where they stand free, gives them looks, and joins them into a world."""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchvo360.data.synthetic.geometry import Solids
from torchvo360.data.synthetic.materials import draw
from torchvo360.data.synthetic.surfaces import Faces, Lamp, Surfaces
from torchvo360.data.synthetic.texture import HEIGHT, WIDTH, TextureAtlas
from torchvo360.data.synthetic.world import Mover, Walkway, World

FREE_WIDTH = 0.55
"""Distance kept between the walkway and any solid, metres."""
NORMALS = ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
SKY_DENSITY = 140.0
"""Texels a radian at the zenith."""


@dataclass
class Builder:
    """Collects solids that keep clear of the walkway and of each other."""

    generator: torch.Generator
    size: tuple[float, float, float]
    walkway: Walkway
    materials: tuple[str, ...]
    texels_per_metre: float
    boxes: list[tuple[float, ...]] = field(default_factory=list)
    """Centre, half sizes, heading, 1 for a cylinder, of each solid."""
    looks: list[list[tuple[int, tuple[float, ...]]]] = field(default_factory=list)
    """Chart and tint of the six faces of each solid."""

    def uniform(self, low: float, high: float) -> float:
        """Draw a number in [low, high)."""
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def tint(self, low: float = 0.65, high: float = 1.1) -> tuple[float, ...]:
        """Draw a colour factor."""
        return tuple(self.uniform(low, high) for _ in range(3))

    def chart(self, *names: str) -> int:
        """Draw one of the named materials."""
        return self.materials.index(names[int(self.uniform(0, len(names)))])

    def is_free(self, x: float, y: float, radius: float, gap: float) -> bool:
        """Return whether a disc keeps off the walkway, the walls and what stands on the floor."""
        angle = torch.linspace(0, math.tau, 181, dtype=torch.float64)
        (ox, oy), (a, b) = self.walkway.centre, self.walkway.radii
        to_path = torch.hypot(ox + a * angle.cos() - x, oy + b * angle.sin() - y).amin()
        others = [
            math.hypot(box[0] - x, box[1] - y) > radius + gap + (box[3] if box[7] else math.hypot(box[3], box[4]))
            for box in self.boxes
        ]
        inside = abs(x) + radius < self.size[0] / 2 and abs(y) + radius < self.size[1] / 2
        return inside and all(others) and float(to_path) > radius + FREE_WIDTH

    def add(
        self, *, centre: tuple[float, ...], half: tuple[float, ...], heading: float, chart: int, is_round: bool = False
    ) -> None:
        """Add a solid of one material, each face with its own shade of one colour."""
        colour = self.tint()
        self.boxes.append((*centre, *half, heading, float(is_round)))
        self.looks.append([(chart, tuple(c * self.uniform(0.75, 1.0) for c in colour)) for _ in range(6)])

    def place(
        self, count: int, charts: tuple[str, ...], *, radius: tuple[float, float], height: tuple[float, float],
        rounds: float = 0.0, gap: float = 0.1, turned: bool = True,
    ) -> None:  # fmt: skip
        """Stand up to `count` solids on the floor where they fit.

        Args:
            count: How many are tried for.
            charts: Materials to draw from.
            radius: Range of the half size in plan, metres.
            height: Range of the height, metres.
            rounds: Share of cylinders.
            gap: Least distance to the others, metres.
            turned: Whether boxes stand at any heading, or along the walls.
        """
        placed = 0
        for _ in range(60 * count):
            if placed == count:
                return
            is_round = self.uniform(0, 1) < rounds
            a, b = self.uniform(*radius), self.uniform(*radius)
            b = a if is_round else b
            x, y = (self.uniform(-side / 2, side / 2) for side in self.size[:2])
            if self.is_free(x, y, a if is_round else math.hypot(a, b), gap):
                h = self.uniform(*height) / 2
                heading = self.uniform(0, math.pi / 2) if turned and not is_round else 0.0
                self.add(
                    centre=(x, y, h), half=(a, b, h), heading=heading, chart=self.chart(*charts), is_round=is_round
                )
                placed += 1

    def hang(self, count: int, charts: tuple[str, ...]) -> None:
        """Hang pictures on the walls, away from the corners."""
        length, width, height = self.size
        for k in range(count):
            depth = 0.02 + 0.003 * k  # where two overlap, one is in front
            along_x = k % 2 == 0
            side = 1 if k % 4 < 2 else -1
            half, tall = self.uniform(0.3, 0.6), self.uniform(0.25, 0.5)
            span = (length if along_x else width) / 2 - half - 0.2
            at, z = self.uniform(-span, span), self.uniform(1.1 + tall - 0.3, min(2.2, height - tall - 0.1))
            wall = side * ((width if along_x else length) / 2 - depth / 2)
            centre, size = ((at, wall), (half, depth)) if along_x else ((wall, at), (depth, half))
            self.add(centre=(*centre, z), half=(*size, tall), heading=0.0, chart=self.chart(*charts))

    def stack(self, count: int, charts: tuple[str, ...], *, most_height: float) -> None:
        """Put small boxes on top of low ones."""
        low = [box for box in self.boxes if not box[7] and 0.3 < 2 * box[5] < most_height and box[2] == box[5]]
        for x, y, _, a, b, h, heading, _ in low[:count]:
            share, tall = self.uniform(0.25, 0.55), self.uniform(0.08, 0.25)
            half = (a * share, b * share, tall)
            self.add(centre=(x, y, 2 * h + tall), half=half, heading=heading + 0.4, chart=self.chart(*charts))

    def build(
        self, name: str, shell: list[tuple[int, tuple[float, ...]]], *, lamps: tuple[Lamp, ...], ambient: float,
        sky: int | None = None, movers: int = 0, panorama: Tensor | None = None,
    ) -> World:  # fmt: skip
        """Join everything into a world; the shell gets six faces, the sky one."""
        images = [draw(material, self.generator) for material in self.materials]
        panorama_chart = -1
        if panorama is not None:
            panorama_chart = len(images)
            images.append(panorama)
            if sky is None:
                shell = [(panorama_chart, (1.0, 1.0, 1.0))] * 6
            else:
                sky = panorama_chart
        place = self._places()
        still = len(self.boxes)
        swings = [self._add_mover(number) for number in range(movers)]
        # movers are drawn last: the static world is the same with and without them
        place = torch.cat([place, self._places()[len(place) :], torch.tensor([[0.0, 0.0, SKY_DENSITY]])])
        length, width, height = self.size
        boxes = torch.tensor([(0, 0, height / 2, length / 2, width / 2, height / 2, 0, 0), *self.boxes]).float()
        solids = Solids(
            centre=boxes[:, :3],
            half=boxes[:, 3:6],
            heading=torch.stack([boxes[:, 6].cos(), boxes[:, 6].sin()], -1),
            is_round=boxes[:, 7] > 0,
            open_above=sky is not None,
        )
        c, s = solids.heading.mT[..., None]
        x, y, z = torch.tensor(NORMALS).mT
        normal = torch.stack([c * x - s * y, s * x + c * y, z.expand(len(boxes), 6)]).flatten(1)
        normal[:, :6] *= -1
        looks = [*shell, *(look for solid in self.looks for look in solid), (sky or 0, (1.0, 1.0, 1.0))]
        surfaces = Surfaces(
            faces=Faces(
                chart=torch.tensor([float(chart) for chart, _ in looks]),
                corner=place[:, :2].mT,
                density=place[:, 2],
                tint=torch.tensor([tint for _, tint in looks]).mT,
                normal=torch.cat([normal, torch.zeros(3, 1)], 1),
            ),
            atlas=TextureAtlas.of(torch.stack(images)),
            lamps=lamps,
            ambient=ambient,
            panorama_chart=panorama_chart,
            panorama_centre=(*self.walkway.centre, self.walkway.eye_height),
        )
        found = tuple(Mover(still + 1 + k, swing, period_s=3.0 + k) for k, swing in enumerate(swings))
        return World(name, solids, surfaces, self.walkway, found)

    def _places(self) -> Tensor:
        """Draw where in its chart each face of the shell and the solids lies, and its texels a metre."""
        place = torch.rand(6 * (len(self.boxes) + 1), 3, generator=self.generator)
        place *= torch.tensor([WIDTH, HEIGHT, 0.4 * self.texels_per_metre])
        place[:, 2] += 0.85 * self.texels_per_metre
        place[:6, 2] = self.texels_per_metre
        return place

    def _add_mover(self, number: int) -> tuple[float, float, float]:
        """Add a box that swings along the walkway's tangent, inside it or outside it, and return its swing."""
        (ox, oy), (a, b) = self.walkway.centre, self.walkway.radii
        angle = self.uniform(0, math.tau)
        outward = (max(a, b) + FREE_WIDTH + 0.35) if number % 2 == 0 else 0.0
        x, y = ox + outward * math.cos(angle), oy + outward * math.sin(angle)
        reach = 1.2 if outward else max(0.2, min(a, b) - FREE_WIDTH - 0.3)
        along = (-math.sin(angle) * reach, math.cos(angle) * reach)
        self.add(centre=(x, y, 0.7), half=(0.18, 0.18, 0.7), heading=0.3, chart=self.chart(*self.materials[-2:]))
        return (*along, 0.0)
