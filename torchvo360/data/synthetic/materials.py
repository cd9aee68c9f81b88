"""Procedural materials: periodic colour images with structure at every scale, drawn from a seeded generator."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.data.synthetic.texture import HEIGHT, WIDTH

Chart = Float[Tensor, "3 H W"]


def draw(name: str, generator: torch.Generator) -> Chart:
    """Draw a material by name: plaster, brick, planks, paving, mural, collage, stones, clouds or haze, in [0, 1]."""
    recipes: dict[str, Callable[[torch.Generator], Chart]] = {
        "plaster": _plaster,
        "brick": _brick,
        "planks": _planks,
        "paving": _paving,
        "mural": _mural,
        "collage": _collage,
        "stones": _stones,
        "clouds": _clouds,
        "haze": _haze,
    }
    return recipes[name](generator).clamp(0, 1)


def _noise(
    generator: torch.Generator, slope: float, *, channels: int = 1, stretch: float = 1.0
) -> Float[Tensor, "C H W"]:
    """Return periodic noise of mean 0 and deviation 1 with the amplitude spectrum f^-slope.

    Args:
        generator: Source of the phases.
        slope: 1 is the slope of natural images; larger is smoother.
        channels: How many independent fields.
        stretch: How much longer structures are along u than along v.
    """
    fu = torch.fft.rfftfreq(WIDTH) * stretch
    fv = torch.fft.fftfreq(HEIGHT)
    frequency = (fu * fu + (fv * fv)[:, None]).sqrt()
    frequency[0, 0] = torch.inf
    spectrum = torch.fft.rfft2(torch.randn(channels, HEIGHT, WIDTH, generator=generator))
    field = torch.fft.irfft2(spectrum * frequency**-slope, s=(HEIGHT, WIDTH))
    return field / field.std((-2, -1), keepdim=True)


def _cells(
    generator: torch.Generator, width: int, height: int, *, bond: int = 0, gap: int = 1
) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """Return a value for each block of a wall, every second row shifted by `bond`, and where the joints are."""
    v, u = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    row = v // height
    shifted = (u + (row % 2) * bond) % WIDTH
    values = torch.rand(HEIGHT // height, WIDTH // width, generator=generator)
    joint = (v % height < gap) | (shifted % width < gap)
    return values[row, shifted // width], joint


def _plaster(generator: torch.Generator) -> Chart:
    return 0.72 + 0.035 * _noise(generator, 1.1) + 0.015 * _noise(generator, 1.6, channels=3)


def _brick(generator: torch.Generator) -> Chart:
    value, joint = _cells(generator, 32, 16, bond=16, gap=2)
    value = 0.35 + 0.35 * value + 0.07 * _noise(generator, 0.9)
    value = torch.where(joint, 0.8 + 0.04 * _noise(generator, 1.0), value)
    return value + 0.04 * _noise(generator, 1.4, channels=3)


def _planks(generator: torch.Generator) -> Chart:
    value, joint = _cells(generator, 128, 16, bond=64, gap=1)
    grain = 0.09 * _noise(generator, 1.0, stretch=12.0) + 0.05 * _noise(generator, 1.3)
    value = torch.where(joint, 0.15, 0.35 + 0.4 * value + grain)
    return value * torch.tensor([1.0, 0.82, 0.62])[:, None, None] + 0.03 * _noise(generator, 1.5, channels=3)


def _paving(generator: torch.Generator) -> Chart:
    large, large_joint = _cells(generator, 64, 64, gap=2)
    small, small_joint = _cells(generator, 16, 16, gap=1)
    value = torch.where(large > 0.5, 0.25 + 0.4 * large, 0.3 + 0.5 * small)
    value = torch.where(large_joint | (small_joint & (large <= 0.5)), 0.2, value)
    return value + 0.07 * _noise(generator, 1.0) + 0.05 * _noise(generator, 1.5, channels=3)


def _mural(generator: torch.Generator) -> Chart:
    blobs = torch.tanh(2.5 * _noise(generator, 1.3))
    colours = torch.tanh(2.0 * _noise(generator, 1.5, channels=3))
    return 0.55 + 0.2 * blobs + 0.11 * colours + 0.05 * _noise(generator, 0.8)


def _collage(generator: torch.Generator) -> Chart:
    """Draw rectangles one over another, with sizes by a power law: edges at every scale, as in natural images."""
    image = 0.5 + 0.1 * _noise(generator, 1.2, channels=3)
    count = 700
    # inverse transform of the density s^-3 on [6, 220] texels, largest first
    side = (6.0**-2 + torch.rand(count, 2, generator=generator) * (220.0**-2 - 6.0**-2)) ** -0.5
    side = side[side.prod(-1).argsort(descending=True)].long().tolist()
    corner = torch.rand(count, 2, generator=generator) * torch.tensor([WIDTH, HEIGHT])
    grey, hue = 0.15 + 0.7 * torch.rand(count, 1, generator=generator), torch.rand(count, 3, generator=generator)
    colour = (grey + 0.35 * (hue - 0.5))[..., None, None]
    for k, ((w, h), (u, v)) in enumerate(zip(side, corner.long().tolist(), strict=True)):
        rows = torch.arange(v, v + h) % HEIGHT
        columns = torch.arange(u, u + w) % WIDTH
        image[:, rows[:, None], columns] = colour[k]
    return image + 0.05 * _noise(generator, 0.9)


def _stones(generator: torch.Generator) -> Chart:
    """Draw rounded stones: the cells of jittered points, dark where two cells meet."""
    size = 32
    rows, columns = HEIGHT // size, WIDTH // size
    jitter = torch.rand(rows, columns, 2, generator=generator)
    value = torch.rand(rows, columns, generator=generator)
    v, u = torch.meshgrid(torch.arange(HEIGHT) % size, torch.arange(WIDTH) % size, indexing="ij")
    nearest = torch.full((HEIGHT, WIDTH), torch.inf)
    second, shade = nearest.clone(), torch.zeros(HEIGHT, WIDTH)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            there = torch.stack([jitter[..., 0] + du, jitter[..., 1] + dv, value]).roll((-dv, -du), (-2, -1))
            across, down, its_shade = there.repeat_interleave(size, -1).repeat_interleave(size, -2)
            distance = torch.hypot(across * size - u, down * size - v)
            closer = distance < nearest
            second = torch.where(closer, nearest, torch.minimum(second, distance))
            shade = torch.where(closer, its_shade, shade)
            nearest = torch.where(closer, distance, nearest)
    joint = ((second - nearest) / 4).clamp(0, 1)
    return (
        joint * (0.3 + 0.45 * shade + 0.08 * _noise(generator, 0.9))
        + (1 - joint) * 0.2
        + 0.05 * _noise(generator, 1.4, channels=3)
    )


def _clouds(generator: torch.Generator) -> Chart:
    cover = torch.sigmoid(1.6 * _noise(generator, 1.7))
    blue = torch.tensor([0.32, 0.5, 0.78])[:, None, None]
    return blue + cover * (0.92 - blue) + 0.015 * _noise(generator, 1.0)


def _haze(generator: torch.Generator) -> Chart:
    """Draw a sky without clouds: slow changes of 2 %, far below what a camera's noise hides."""
    return torch.tensor([0.55, 0.68, 0.86])[:, None, None] + 0.02 * _noise(generator, 2.0)
