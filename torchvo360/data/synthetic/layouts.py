"""The named worlds: what stands where, and what it is made of, drawn from a seed."""

from pathlib import Path

import cv2
import torch
from torch import Tensor

from torchvo360.checks import InputError, check_choice
from torchvo360.data.synthetic.builder import Builder
from torchvo360.data.synthetic.surfaces import Lamp
from torchvo360.data.synthetic.texture import HEIGHT, WIDTH
from torchvo360.data.synthetic.world import Walkway, World

WORLDS = ("room", "pillars", "courtyard")
FIELD = "field"


def make_world(name: str, *, seed: int = 0, panorama: str | Path | None = None, moving_objects: int = 0) -> World:
    """Make one of the named worlds.

    Args:
        name: `room` (7.5 x 6 x 2.8 m, furnished), `pillars` (a hall of 14 x 11 x 4 m) or `courtyard` (18 x 14 m, walls
            of 3.6 m and sky) or `field` (30 x 24 m, nothing but a few stems rises above the eye: sky over half of the
            view, without clouds).
        seed: Where things stand and what they look like.
        panorama: An equirectangular image that the walls wear, or the sky where there is one; None for procedural
            looks.
        moving_objects: Boxes that swing beside the walkway.

    Raises:
        InputError: The name is another one, or the panorama cannot be read.
    """
    check_choice("world", name, (*WORLDS, FIELD))
    generator = torch.Generator().manual_seed(seed)
    image = None if panorama is None else _read_panorama(Path(panorama))
    makers = {"room": _room, "pillars": _pillars, "courtyard": _courtyard, "field": _field}
    return makers[name](generator, moving_objects, image)


def _read_panorama(path: Path) -> Tensor:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        raise InputError(f"panorama: expected the path of a readable image, got {str(path)!r}.")
    size = cv2.INTER_AREA if image.shape[1] > WIDTH else cv2.INTER_CUBIC
    rgb = cv2.cvtColor(cv2.resize(image, (WIDTH, HEIGHT), interpolation=size), cv2.COLOR_BGR2RGB)
    return torch.from_numpy(rgb).permute(2, 0, 1).float() / 255


def _room(generator: torch.Generator, movers: int, panorama: Tensor | None) -> World:
    walkway = Walkway(centre=(0.2, -0.1), radii=(1.4, 1.15), eye_height=1.5)
    materials = ("plaster", "brick", "planks", "stones", "collage", "mural")
    b = Builder(generator, (7.5, 6.0, 2.8), walkway, materials, 100.0)
    b.place(3, ("planks", "mural"), radius=(0.18, 0.3), height=(1.6, 2.2), turned=False)
    b.place(2, ("brick", "stones"), radius=(0.14, 0.2), height=(2.8, 2.8), rounds=0.6)
    b.place(9, ("planks", "collage", "mural", "plaster"), radius=(0.2, 0.5), height=(0.35, 0.95))
    b.place(4, ("collage", "mural"), radius=(0.1, 0.18), height=(0.3, 1.3), rounds=0.7)
    b.stack(6, ("collage", "mural", "planks"), most_height=1.0)
    b.hang(6, ("collage", "mural"))
    shell = [
        (b.chart("plaster"), b.tint(0.85)), (b.chart("brick"), (1.0, 0.78, 0.66)), (b.chart("mural"), b.tint(0.8)),
        (b.chart("plaster"), b.tint(0.85)), (b.chart("stones"), (0.95, 0.95, 1.0)),
        (b.chart("planks"), (0.95, 0.9, 0.85)),
    ]  # fmt: skip
    lamps = (Lamp((1.2, 0.8, 2.6), 0.75, 2.6), Lamp((-2.0, -1.2, 2.6), 0.55, 2.2))
    return b.build("room", shell, lamps=lamps, ambient=0.6, movers=movers, panorama=panorama)


def _pillars(generator: torch.Generator, movers: int, panorama: Tensor | None) -> World:
    walkway = Walkway(centre=(0.0, 0.0), radii=(1.9, 1.6), eye_height=1.6)
    materials = ("plaster", "stones", "paving", "brick", "collage", "mural")
    b = Builder(generator, (14.0, 11.0, 4.0), walkway, materials, 80.0)
    b.place(18, ("brick", "stones", "collage", "mural"), radius=(0.16, 0.36), height=(4.0, 4.0), rounds=0.7, gap=0.7)
    b.place(10, ("collage", "mural", "stones"), radius=(0.2, 0.5), height=(0.4, 1.2), gap=0.2)
    b.stack(5, ("collage", "mural"), most_height=1.3)
    b.hang(6, ("collage", "mural"))
    shell = [
        (b.chart("brick"), (1.0, 0.85, 0.75)), (b.chart("plaster"), b.tint(0.85)), (b.chart("stones"), b.tint(0.85)),
        (b.chart("brick"), (0.9, 0.9, 0.95)), (b.chart("mural"), (0.75, 0.75, 0.75)),
        (b.chart("paving"), (1.0, 0.97, 0.92)),
    ]  # fmt: skip
    lamps = (Lamp((3.0, 2.0, 3.8), 0.8, 4.5), Lamp((-3.5, -2.0, 3.8), 0.7, 4.0))
    return b.build("pillars", shell, lamps=lamps, ambient=0.62, movers=movers, panorama=panorama)


def _courtyard(generator: torch.Generator, movers: int, panorama: Tensor | None) -> World:
    walkway = Walkway(centre=(0.5, 0.0), radii=(1.9, 1.6), eye_height=1.6)
    materials = ("brick", "stones", "paving", "planks", "clouds", "collage", "mural")
    b = Builder(generator, (18.0, 14.0, 3.6), walkway, materials, 75.0)
    b.place(6, ("planks", "stones"), radius=(0.12, 0.25), height=(3.0, 4.5), rounds=1.0, gap=0.8)
    trunks = list(b.boxes)  # high enough to walk under their crowns
    b.place(14, ("collage", "mural", "brick", "planks"), radius=(0.25, 0.8), height=(0.4, 2.2), gap=0.4)
    b.stack(6, ("collage", "mural"), most_height=1.6)
    for x, y, _, _, _, h, _, _ in trunks:
        crown = b.uniform(0.5, 0.9)
        b.add(centre=(x, y, 2 * h), half=(crown, crown, 0.6), heading=b.uniform(0, 1.5), chart=b.chart("mural"))
    shell = [
        (b.chart("brick"), (1.0, 0.8, 0.7)), (b.chart("stones"), b.tint(0.85)), (b.chart("brick"), (0.9, 0.9, 0.9)),
        (b.chart("mural"), (0.85, 0.8, 0.75)), (b.chart("paving"), (1.0, 1.0, 1.0)),
        (b.chart("paving"), (1.0, 0.98, 0.95)),
    ]  # fmt: skip
    # the sun stands far away: one lamp whose light hardly falls off
    lamps = (Lamp((60.0, 35.0, 80.0), 0.6, 1e4),)
    sky = b.chart("clouds")
    return b.build("courtyard", shell, lamps=lamps, ambient=0.62, sky=sky, movers=movers, panorama=panorama)


def _field(generator: torch.Generator, movers: int, panorama: Tensor | None) -> World:
    walkway = Walkway(centre=(-0.5, 0.3), radii=(1.9, 1.6), eye_height=1.6)
    materials = ("brick", "stones", "paving", "haze", "collage", "mural")
    b = Builder(generator, (30.0, 24.0, 1.75), walkway, materials, 70.0)
    b.place(2, ("stones",), radius=(0.1, 0.15), height=(2.2, 2.8), rounds=1.0, gap=2.0)
    b.place(24, ("collage", "mural", "brick", "stones"), radius=(0.2, 0.7), height=(0.3, 1.5), rounds=0.3, gap=0.5)
    shell = [
        (b.chart("brick"), (1.0, 0.8, 0.7)), (b.chart("stones"), b.tint(0.85)), (b.chart("brick"), (0.9, 0.9, 0.9)),
        (b.chart("mural"), (0.85, 0.8, 0.75)), (b.chart("paving"), (1.0, 1.0, 1.0)),
        (b.chart("paving"), (1.0, 0.98, 0.95)),
    ]  # fmt: skip
    lamps = (Lamp((60.0, 35.0, 80.0), 0.6, 1e4),)
    return b.build("field", shell, lamps=lamps, ambient=0.62, sky=b.chart("haze"), movers=movers, panorama=panorama)
