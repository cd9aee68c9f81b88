"""Batches of rendered views: every world is rendered when it is first needed, and changed as a camera may change it."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int64
from torch import Tensor

from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError
from torchvo360.data.synthetic.rays import CameraRays
from worlds import ViewsConfig, places, world_of


@dataclass(kw_only=True)
class AppearanceConfig:
    """How the looks of a view vary: each number is the largest change, drawn evenly, for all pixels alike."""

    log_gain: float = 0.6
    log_gamma: float = 0.3
    offset: float = 0.05
    log_white: float = 0.15
    """Gain of each colour."""
    noise: float = 0.02
    """Standard deviation of the noise of each pixel and colour."""
    blur: float = 1.0
    """Share of a smoothed image in the mixture."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < math.inf:
                raise InputError(f"{name}: expected a finite number of at least 0, got {value}.")


@dataclass(frozen=True)
class Batch:
    """Views, the first of each K being the one whose range is asked for."""

    image: Float[Tensor, "B K 3 H W"]
    rho: Float[Tensor, "B H W"]
    """True inverse range of the first, 1/m; 0 for the sky."""


class Views:
    """All views of a configuration, kept in 8 and 16 bits once they are rendered."""

    def __init__(self, config: ViewsConfig, camera: Equirectangular, *, neighbours: bool) -> None:
        """Prepare to render.

        Args:
            config: What is rendered.
            camera: The camera of all views.
            neighbours: Whether each view comes with its two neighbours.
        """
        self.config, self._poses = config, 3 if neighbours else 1
        self._rays = CameraRays.of(camera)
        self._worlds: dict[int, tuple[Tensor, Tensor]] = {}

    def __len__(self) -> int:
        return self.config.views

    def first_of_kinds(self) -> dict[str, int]:
        """Return the first view of each kind of world."""
        a_world = len(self) // self.config.worlds
        return {kind: number * a_world for number, kind in enumerate(self.config.kinds[: self.config.worlds])}

    def take(self, indices: list[int]) -> Batch:
        """Return some of the views as they were rendered."""
        image, rho = zip(*(self._view(index) for index in indices), strict=True)
        return Batch(torch.stack(image).float() / 255, torch.stack(rho).float())

    def _view(self, index: int) -> tuple[Tensor, Tensor]:
        number, within = divmod(index, len(self) // self.config.worlds)
        if number not in self._worlds:
            seed = self.config.first_seed + number
            world = world_of(self.config.kinds[number % len(self.config.kinds)], seed)
            image, reach = world.render(self._rays, places(world, seed, self.config)[:, : self._poses])
            self._worlds[number] = image.mul_(255).round_().to(torch.uint8), (1 / reach[:, 0]).half()
        image, rho = self._worlds[number]
        return image[within], rho[within]


def turned(batch: Batch, shift: Int64[Tensor, "B"], mirrored: Tensor) -> Batch:
    """Turn each view about its vertical by whole columns, and mirror some: both are exact on a panorama."""
    width = batch.image.shape[-1]
    column = torch.arange(width).expand(len(shift), -1)
    column = torch.where(mirrored[:, None], width - 1 - column, column)
    column = (column + shift[:, None]) % width
    image = batch.image.gather(-1, column[:, None, None, None].expand_as(batch.image))
    return Batch(image, batch.rho.gather(-1, column[:, None].expand_as(batch.rho)))


def repainted(
    image: Float[Tensor, "B K 3 H W"], config: AppearanceConfig, generator: torch.Generator
) -> Float[Tensor, "B K 3 H W"]:
    """Change exposure, colours, sharpness and noise, in one way for all views of an element."""

    def draw(size: float, *shape: int) -> Tensor:
        return size * (2 * torch.rand(len(image), 1, *shape, 1, 1, generator=generator) - 1)

    gain, gamma, offset = (draw(size, 1) for size in (config.log_gain, config.log_gamma, config.offset))
    colour, noise, mixture = draw(config.log_white, 3), draw(config.noise, 1).abs(), draw(config.blur, 1).abs()
    soft = F.avg_pool2d(image.flatten(0, 1), 3, 1, padding=1, count_include_pad=False).view_as(image)
    out = torch.lerp(image, soft, mixture.clamp_max(1.0)).clamp_min(1e-4) ** gamma.exp()
    out = out * (gain + colour).exp() + offset
    return (out + noise * torch.randn(image.shape, generator=generator)).clamp(0, 1)
