"""Changes of light and camera between two views: what brightness constancy does not survive."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError
from torchvo360.image import blur

LOBES = 4
"""Places of the sphere that become brighter or darker."""
SHARPNESS = 8.0
"""The narrowest lobe's concentration: it falls to half within 24 deg, the widest, of concentration 1, within 72 deg."""


@dataclass(kw_only=True)
class IlluminationConfig:
    """How strong a change is at most; each change is drawn anew, uniformly up to these."""

    gain: float = 2.0
    """Factor of the exposure, up or down."""
    gamma: float = 1.6
    """Exponent, or its inverse."""
    shading: float = 0.8
    """Logarithm of the factor in the middle of each of four lobes of light or shade, wherever they fall."""
    noise: float = 0.03
    """Standard deviation of the noise."""
    blur: float = 1.0
    """Share of the image that is replaced by one smoothed by a pixel."""

    def __post_init__(self) -> None:
        if min(self.gain, self.gamma) < 1 or min(self.shading, self.noise) < 0 or not 0 <= self.blur <= 1:
            raise InputError(
                "illumination: expected gain and gamma of at least 1, shading and noise of at least 0 and blur "
                f"between 0 and 1, got {self.gain}, {self.gamma}, {self.shading}, {self.noise} and {self.blur}."
            )


def relit(
    image: Float[Tensor, "B C H W"],
    config: IlluminationConfig,
    generator: torch.Generator,
    strength: Float[Tensor, "B"] | float = 1.0,
) -> Float[Tensor, "B C H W"]:
    """Return panoramas under another light, seen by another camera: smoothed, gamma, lobes, gain, noise, clipped.

    Args:
        image: Values in [0, 1].
        config: The strongest changes.
        generator: Draws them, the same number of draws for every image.
        strength: How much of them each image gets, 0 to 1.
    """
    B, _, H, W = image.shape
    camera = Equirectangular(W, H)
    each = torch.as_tensor(strength, dtype=image.dtype).expand(B)[:, None, None, None]
    mix, gamma, gain, noise = torch.rand(4, B, 1, 1, 1, generator=generator)
    image = image + (blur(image, camera, 1.0) - image) * (mix * config.blur * each)
    image = image.clamp(1e-4, 1.0) ** torch.exp((2 * gamma - 1) * math.log(config.gamma) * each)
    exposure = (2 * gain - 1) * math.log(config.gain)
    image = image * torch.exp((exposure + _lobes(B, camera, generator) * config.shading) * each)
    image = image + torch.randn(image.shape, generator=generator) * (noise * config.noise * each)
    return image.clamp(0.0, 1.0)


def _lobes(B: int, camera: Equirectangular, generator: torch.Generator) -> Float[Tensor, "B 1 H W"]:
    """Draw sums of lobes of heights -1 to 1 around random directions."""
    centre = F.normalize(torch.randn(B, LOBES, 3, generator=generator), dim=-1)
    width, height = torch.rand(2, B, LOBES, 1, generator=generator)
    cosine = centre @ camera.ray_grid().reshape(-1, 3).mT
    lobes = (2 * height - 1) * torch.exp(SHARPNESS**width * (cosine - 1))
    return lobes.sum(1).view(B, 1, camera.height, camera.width)
