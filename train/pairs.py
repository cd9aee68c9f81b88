"""Pairs of panoramas to learn alignment from: rendered once into memory, turned, mirrored and relit at every use."""

import math
from dataclasses import dataclass, field, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from illumination import IlluminationConfig, relit
from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError, check_choice
from torchvo360.data.synthetic import WORLDS, sample_pairs
from torchvo360.lie import se3, so3_exp


@dataclass(kw_only=True)
class PairsConfig:
    """What is rendered: random places in random worlds, every 32 pairs in a world of their own."""

    kinds: list[str] = field(default_factory=lambda: ["room", "pillars"])
    """Kinds of worlds."""
    pairs: int = 384
    """Pairs of each kind."""
    seed: int = 1
    """Seed of the worlds; those of another seed are other worlds."""
    width: int = 128
    """Width of the panoramas, twice their height, pixels."""
    max_rotation_deg: float = 40.0
    """Largest rotation between two views, besides their headings, which are any."""
    max_translation_m: float = 0.3
    """Largest distance between two views, less than 0.35."""

    def __post_init__(self) -> None:
        if not self.kinds or self.pairs < 1:
            raise InputError(f"kinds, pairs: expected at least one of each, got {self.kinds} and {self.pairs}.")
        for kind in self.kinds:
            check_choice("kinds", kind, WORLDS)


@dataclass(frozen=True)
class ViewPairs:
    """Pairs of views with exact range and motion."""

    camera: Equirectangular
    ref: Float[Tensor, "n 3 H W"]
    tgt: Float[Tensor, "n 3 H W"]
    rho: Float[Tensor, "n H W"]
    """Inverse range of the reference, 1/m; 0 for the sky."""
    T_tgt_ref: Float64[Tensor, "n 4 4"]

    def __len__(self) -> int:
        return len(self.ref)

    def with_images(self, ref: Float[Tensor, "n 3 H W"], tgt: Float[Tensor, "n 3 H W"]) -> "ViewPairs":
        """Return the same pairs as seen in other images."""
        return replace(self, ref=ref, tgt=tgt)

    def to(self, device: torch.device) -> "ViewPairs":
        """Return the pairs on a device."""
        moved = (each.to(device) for each in (self.ref, self.tgt, self.rho, self.T_tgt_ref))
        return ViewPairs(self.camera, *moved)

    def take(self, index: Int64[Tensor, "m"] | slice) -> "ViewPairs":
        """Return some of the pairs."""
        return ViewPairs(self.camera, self.ref[index], self.tgt[index], self.rho[index], self.T_tgt_ref[index])


def render_pairs(config: PairsConfig) -> ViewPairs:
    """Render pairs kind by kind; the two views have the same light."""
    parts = [
        sample_pairs(
            config.pairs,
            seed=config.seed,
            width=config.width,
            height=config.width // 2,
            max_rotation_deg=config.max_rotation_deg,
            max_translation_m=config.max_translation_m,
            world=kind,
            affine=False,
        )
        for kind in config.kinds
    ]
    ref, tgt, rho, T = (
        torch.cat([getattr(part, name) for part in parts]) for name in ("ref", "tgt", "rho", "T_tgt_ref_true")
    )
    return ViewPairs(parts[0].camera, ref, tgt, rho, T)


def turned(views: ViewPairs, generator: torch.Generator) -> ViewPairs:
    """Give both views of every pair a heading of its own, so that no start is better than any other.

    Turning about the vertical axis rolls a panorama by whole columns, and no pixel is interpolated.
    """
    W = views.camera.width
    by_ref, by_tgt = torch.randint(W, (2, len(views)), generator=generator)
    T = _heading(by_tgt, W) @ views.T_tgt_ref @ _heading(-by_ref, W)
    ref, rho = _rolled(views.ref, by_ref), _rolled(views.rho[:, None], by_ref)[:, 0]
    return ViewPairs(views.camera, ref, _rolled(views.tgt, by_tgt), rho, T)


def mirrored(views: ViewPairs, which: Tensor) -> ViewPairs:
    """Exchange left and right in both views of the pairs that are named."""
    image = which[:, None, None, None]
    mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=torch.float64))
    return ViewPairs(
        views.camera,
        torch.where(image, views.ref.flip(-1), views.ref),
        torch.where(image, views.tgt.flip(-1), views.tgt),
        torch.where(which[:, None, None], views.rho.flip(-1), views.rho),
        torch.where(which[:, None, None], mirror @ views.T_tgt_ref @ mirror, views.T_tgt_ref),
    )


def drawn(
    views: ViewPairs, count: int, illumination: IlluminationConfig, unchanged: float, generator: torch.Generator
) -> ViewPairs:
    """Draw a batch of pairs, turned, mirrored and relit: the target strongly, the reference a little.

    Args:
        views: All pairs.
        count: Pairs of the batch.
        illumination: The strongest change of light.
        unchanged: Share of the pairs whose light stays.
        generator: Draws everything.
    """
    batch = turned(views.take(torch.randint(len(views), (count,), generator=generator)), generator)
    mirror, light = torch.rand(2, count, generator=generator)
    batch = mirrored(batch, mirror < 0.5)
    strength = (light >= unchanged).float()
    ref = relit(batch.ref, illumination, generator, 0.3 * strength)
    return ViewPairs(batch.camera, ref, relit(batch.tgt, illumination, generator, strength), batch.rho, batch.T_tgt_ref)


def displaced(
    T_tgt_ref: Float64[Tensor, "n 4 4"],
    rotation: Float[Tensor, "n"] | float,
    translation: Float[Tensor, "n"] | float,
    generator: torch.Generator,
) -> Float64[Tensor, "n 4 4"]:
    """Return poses that are wrong by given angles (radians) and distances (metres), in random directions."""
    n = len(T_tgt_ref)
    axis, way = F.normalize(torch.randn(2, n, 3, generator=generator, dtype=torch.float64), dim=-1)
    angle, distance = (torch.as_tensor(x, dtype=torch.float64).expand(n)[:, None] for x in (rotation, translation))
    moved = T_tgt_ref.clone()
    moved[:, :3, :3] = so3_exp(axis * angle) @ T_tgt_ref[:, :3, :3]
    moved[:, :3, 3] += way * distance
    return moved


def median_range(rho: Float[Tensor, "n H W"]) -> Float64[Tensor, "n"]:
    """Return the range that half of the sphere lies beyond, metres; 100 m where that is the sky."""
    camera = Equirectangular(rho.shape[-1], rho.shape[-2])
    area = camera.solid_angle(camera.pixel_grid(dtype=torch.float64, device=rho.device)).flatten()
    ordered, order = rho.flatten(1).double().sort(-1)
    passed = area[order].cumsum(-1) / area.sum()
    middle = (passed < 0.5).sum(-1, keepdim=True)
    return 1 / ordered.gather(-1, middle)[:, 0].clamp_min(0.01)


def _rolled(image: Float[Tensor, "n C H W"], columns: Int64[Tensor, "n"]) -> Float[Tensor, "n C H W"]:
    W = image.shape[-1]
    source = (torch.arange(W) - columns[:, None]) % W
    return image.gather(-1, source[:, None, None, :].expand_as(image))


def _heading(columns: Int64[Tensor, "n"], width: int) -> Float64[Tensor, "n 4 4"]:
    """Return the turn of the camera that rolls a panorama by so many columns to the right."""
    angle = columns.double() * (math.tau / width)
    zero = torch.zeros_like(angle)
    return se3(so3_exp(torch.stack([zero, angle, zero], -1)), torch.zeros(len(angle), 3, dtype=torch.float64))
