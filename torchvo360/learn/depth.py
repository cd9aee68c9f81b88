"""Range from one panorama: a small network that gives every pixel's inverse range and its variance.

The network sees one size; its answer is a Laplace distribution of log rho, because ranges err by a share of themselves
and are wrong by far at the edges of things. To first order the variance of rho is `rho^2` times that of log rho.
"""

import itertools
import math
import reprlib
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError, check_shape
from torchvo360.image import resample, sample
from torchvo360.learn.plugin import RangeEstimate
from torchvo360.learn.sphere_conv import SphericalConv2d, enlarge

FOLD = 2
"""Side of the blocks of pixels whose colours enter as channels: the finest maps have half the network's width."""
LOG_RHO = (math.log(2e-3), math.log(50.0))
"""Inverse ranges the network can give, 1/m, as logarithms: a range of 500 m stands for the sky."""
LOG_SCALE = (-5.0, 1.0)
"""Scales of the Laplace distribution of log rho that the network can give, as logarithms."""


MAX_WIDTH, MAX_LEVELS, MAX_CHANNELS = 8192, 8, 1024
"""Bounds of what a checkpoint, which may be a stranger's, can have made."""


class PanoramaDepth(nn.Module):
    """A U-Net on the sphere from one panorama to inverse ranges; it turns with the panorama by whole blocks of pixels.

    Args:
        width: Width at which the network sees a panorama, pixels: a multiple of `2^(levels + 1)`, at most 8192.
        channels: Channels of each of at most 8 levels, the finest first, multiples of 8 up to 1024.

    Raises:
        InputError: The width does not halve that often, or a level has another number of channels.
    """

    def __init__(self, width: int = 256, channels: Sequence[int] = (16, 32, 48, 64, 64)) -> None:
        super().__init__()
        self.width, self.channels = width, list(channels)
        if not 1 <= len(channels) <= MAX_LEVELS or any(c not in range(8, MAX_CHANNELS + 1, 8) for c in channels):
            expected = f"1 to {MAX_LEVELS} multiples of 8 up to {MAX_CHANNELS}"
            raise InputError(f"channels: expected {expected}, got {reprlib.repr(self.channels)}.")
        blocks_px = FOLD * 2 ** len(channels)
        if width not in range(blocks_px, MAX_WIDTH + 1, blocks_px):
            expected = f"a multiple of {blocks_px} up to {MAX_WIDTH} for {len(channels)} levels"
            raise InputError(f"width: expected {expected}, got {reprlib.repr(width)}.")
        steps = list(itertools.pairwise(channels))
        self.entry = SphericalConv2d(3 * FOLD**2 + 2, channels[0])
        self.encoders = nn.ModuleList(_Block(count) for count in channels)
        self.shrink = nn.ModuleList(SphericalConv2d(fine, coarse) for fine, coarse in steps)
        self.whole = nn.Sequential(
            nn.Linear(channels[-1], channels[-1]), nn.SiLU(), nn.Linear(channels[-1], channels[-1])
        )
        self.widen = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in steps)
        self.decoders = nn.ModuleList(_Block(count) for count in channels[:-1])
        self.exit = SphericalConv2d(channels[0], 2)
        # At the start: 3 m everywhere, known to a third.
        nn.init.zeros_(self.exit.weight)
        with torch.no_grad():
            assert self.exit.bias is not None
            self.exit.bias.copy_(torch.tensor([-1.1, -1.1]))

    def forward(self, image: Float[Tensor, "B 3 H W"]) -> RangeEstimate:
        """Estimate the range of every pixel.

        Args:
            image: Full panoramas of any size, colours in [0, 1].

        Returns:
            Inverse ranges, 1/m, and their variances, both positive, of the images' size and type.

        Raises:
            ShapeError: The images do not have four axes and three channels.
            InputError: They are not twice as wide as high.
        """
        size = check_shape("image", image, "B 3 H W")
        if size["W"] != 2 * size["H"]:
            raise InputError(f"image: expected a full panorama, twice as wide as high, got {size['W']} x {size['H']}.")
        log_rho, log_scale = (
            _resized(part[:, None], size["H"], size["W"])[:, 0] for part in self.distribution(self.seen(image))
        )
        rho = log_rho.clamp(*LOG_RHO).exp().to(image.dtype)
        # A Laplace distribution of scale b has the variance 2 b^2.
        variance = 2 * (log_scale.clamp(*LOG_SCALE).exp().to(image.dtype) * rho).square()
        return RangeEstimate(rho, variance)

    def seen(self, image: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 h w"]:
        """Return images at the size and in the type the network works with."""
        return _resized(image.to(self.entry.weight.dtype), self.width // 2, self.width)

    def distribution(self, image: Float[Tensor, "B 3 h w"]) -> tuple[Float[Tensor, "B h w"], Float[Tensor, "B h w"]]:
        """Return the mean of log rho and the logarithm of its scale, for images of the network's own size."""
        features = self.entry(_with_latitude(F.pixel_unshuffle(_normalised(image), FOLD)))
        skips = []
        for encoder, shrink in zip(self.encoders, self.shrink, strict=False):
            skips.append(encoder(features))
            features = shrink(F.avg_pool2d(skips[-1], 2))
        features = self.encoders[-1](features)
        features = features + self.whole((features * _area(features)).sum((2, 3)))[..., None, None]
        for widen, decoder in zip(reversed(self.widen), reversed(self.decoders), strict=True):
            features = decoder(enlarge(widen(features)) + skips.pop())
        log_rho, log_scale = enlarge(self.exit(F.silu(features))).unbind(1)
        return log_rho, log_scale


class _Block(nn.Module):
    """Two convolutions beside the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.GroupNorm(8, channels) for _ in range(2))
        self.convolutions = nn.ModuleList(SphericalConv2d(channels, channels) for _ in range(2))

    def forward(self, features: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C h w"]:
        change = features
        for norm, convolution in zip(self.norms, self.convolutions, strict=True):
            change = convolution(F.silu(norm(change)))
        return features + change


def _area(features: Float[Tensor, "B C h w"]) -> Float[Tensor, "h 1"]:
    """Return each pixel's share of the sphere."""
    height, width = features.shape[-2:]
    latitude = (torch.arange(height, device=features.device) + 0.5) / height * math.pi
    share = latitude.sin() / (width * latitude.sin().sum())
    return share[:, None].to(features.dtype)


def _normalised(image: Float[Tensor, "B 3 h w"]) -> Float[Tensor, "B 3 h w"]:
    """Return images with mean 0 and spread 1 over the sphere, so that exposure says nothing of range."""
    area = _area(image)
    centred = image - (image * area).sum((2, 3)).mean(1)[:, None, None, None]
    spread = (centred.square() * area).sum((2, 3)).mean(1).sqrt()
    return centred / (spread + 0.02)[:, None, None, None]


def _with_latitude(features: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C2 h w"]:
    """Add sine and cosine of each row's latitude, by which a floor's range follows from the height of the eye."""
    batch, _, height, width = features.shape
    latitude = ((torch.arange(height, device=features.device) + 0.5) / height - 0.5) * math.pi
    rows = torch.stack([latitude.sin(), latitude.cos()]).to(features.dtype)
    return torch.cat([features, rows[None, :, :, None].expand(batch, -1, -1, width)], 1)


def _resized(maps: Float[Tensor, "B C h w"], height: int, width: int) -> Float[Tensor, "B C H W"]:
    """Return panoramas of another size: means of pixels where they shrink, bilinear on the sphere where they grow."""
    camera = Equirectangular(width, height)
    if height <= maps.shape[-2]:
        return resample(maps, camera)
    uv = camera.pixel_grid(dtype=maps.dtype, device=maps.device) * (maps.shape[-2] / height)
    return sample(maps, uv.expand(maps.shape[0], -1, -1, -1), Equirectangular(maps.shape[-1], maps.shape[-2]))
