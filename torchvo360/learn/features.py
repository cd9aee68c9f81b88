"""Learned features of panoramas for direct alignment: a small network that gives a pyramid and its confidences.

Down and up again (a U-Net) for the levels that end a solve well, and heat flow on the sphere for those that begin it:
the coarsest features, spread by tens of degrees around each direction, have few minima left, wherever a solve starts.
Spreading commutes with every rotation of the camera, so that only what is spread need be learned.
"""

import math
import reprlib
from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchvo360.alignment import AlignConfig, AlignResult, align
from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError, check_finite_number, check_shape
from torchvo360.image import resample
from torchvo360.learn.plugin import FeaturePyramid, checked_features
from torchvo360.learn.sphere_conv import SphericalConv2d, enlarge
from torchvo360.residuals.weights import LossConfig

COARSE = Equirectangular(16, 8)
"""The camera of the spread maps: pixels of 22.5 deg are fine enough for what is smooth over 15 deg and more."""

DARK = 0.03
"""Intensity below which the logarithm of the input flattens: about the noise of a dark image."""


MAX_LEVELS, MAX_CHANNELS = 8, 1024
"""Bounds of what a checkpoint, which may be a stranger's, can have made."""


class PanoramaFeatures(nn.Module):
    """A feature extractor for panoramas of 128 x 64 pixels and more.

    The levels are those of the image, halved until there is one for each of `widths`, and then 16 x 8 pixels for each
    of `spread_deg`. All maps of an image have mean 0 and mean square 1 over the sphere, so that a robust loss has one
    scale. The network turns with the panorama about its vertical axis, by whole pixels of its smallest map.

    Args:
        widths: Channels inside the network at each of at most 8 sizes, the finest first: at most 1024.
        channels: Channels of each map, one number for each of `widths`: at most 1024.
        spread_deg: At most 8 angles by which the coarse maps are spread, the finest first, degrees.

    Raises:
        InputError: Numbers of channels do not fit each other, are too large or no multiples of 4, or an angle is not in
            (5, 90].
    """

    def __init__(
        self,
        widths: Sequence[int] = (16, 24, 32, 48),
        channels: Sequence[int] = (4, 6, 8, 8),
        spread_deg: Sequence[float] = (15.0, 30.0, 60.0),
    ) -> None:
        super().__init__()
        fit = len(channels) == len(widths) and 1 <= len(widths) <= MAX_LEVELS
        if not fit or any(width not in range(4, MAX_CHANNELS + 1, 4) for width in widths):
            expected = f"as many of each, 1 to {MAX_LEVELS}, widths multiples of 4 up to {MAX_CHANNELS}"
            given = f"{reprlib.repr(list(widths))} and {reprlib.repr(list(channels))}"
            raise InputError(f"widths, channels: expected {expected}, got {given}.")
        if any(count not in range(1, MAX_CHANNELS + 1) for count in channels):
            raise InputError(f"channels: expected 1 to {MAX_CHANNELS} each, got {reprlib.repr(list(channels))}.")
        if len(spread_deg) > MAX_LEVELS:
            raise InputError(f"spread_deg: expected at most {MAX_LEVELS} angles, got {len(spread_deg)}.")
        for angle in spread_deg:
            check_finite_number("spread_deg", angle, above=5.0, at_most=90.0)
        inputs = (3, *widths[:-1])
        self.down = nn.ModuleList(
            _block(before, width, stride=2 if level else 1)
            for level, (before, width) in enumerate(zip(inputs, widths, strict=True))
        )
        self.up = nn.ModuleList(_layer(below + width, width) for width, below in pairwise(widths))
        self.heads = nn.ModuleList(
            SphericalConv2d(width, count + 1, 1) for width, count in zip(widths, channels, strict=True)
        )
        self.coarse_head = SphericalConv2d(widths[-1], channels[-1] * len(spread_deg), 1)
        spreads = [spread_matrix(COARSE, math.radians(angle)) for angle in spread_deg]
        self.spread: Tensor
        self.register_buffer("spread", torch.stack(spreads) if spreads else torch.zeros(0, 0, 0), persistent=False)

    def forward(self, image: Float[Tensor, "B 3 H W"]) -> FeaturePyramid:
        """Return the pyramid of panoramas with values in [0, 1].

        Raises:
            ShapeError: The image has no three channels.
            InputError: It is not twice as wide as high, or its width is not a multiple of the smallest map's pixels.
        """
        self._check(image)
        # Exposure and white balance are constants in the logarithm; the mean takes away what is common to all.
        x = (image.clamp_min(0.0) + DARK).log()
        x = x - x.mean((1, 2, 3), keepdim=True)
        down: list[Tensor] = []
        for block in self.down:
            x = block(x)
            down.append(x)
        levels = [x]
        for skip, layer in zip(reversed(down[:-1]), reversed(self.up), strict=True):
            levels.append(layer(torch.cat([enlarge(levels[-1]), skip], 1)))
        maps: list[Tensor] = []
        confidence: list[Tensor] = []
        for level, head in zip(reversed(levels), self.heads, strict=True):
            out = head(level)
            maps.append(standardise(out[:, :-1]))
            confidence.append(torch.sigmoid(out[:, -1] + 1.0))
        coarse = self._coarse(down[-1])
        return FeaturePyramid(maps + coarse, confidence + [torch.ones_like(each[:, 0]) for each in coarse])

    def _coarse(self, x: Float[Tensor, "B C h w"]) -> list[Float[Tensor, "B D 8 16"]]:
        """Return the coarse maps, each spread by its own angle."""
        if not len(self.spread):
            return []
        small = resample(torch.tanh(self.coarse_head(x)), COARSE)
        parts = small.chunk(len(self.spread), 1)
        return [standardise(spread(part, matrix)) for part, matrix in zip(parts, self.spread, strict=True)]

    def _check(self, image: Tensor) -> None:
        size = check_shape("image", image, "B 3 H W")
        step = 2 ** len(self.down)
        height, width = size["H"], size["W"]
        least = COARSE.width * step // 2
        if width != 2 * height or width % step or width < least:
            expected = f"a panorama of W x W/2 pixels with W of at least {least} and a multiple of {step}"
            raise InputError(f"image: expected {expected}, got {width} x {height}.")


def feature_alignment(**changes: Any) -> AlignConfig:
    """Return the settings to align such features with: no brightness, and a robust loss at their scale.

    The agreement of true solutions is 0.2 to 0.95 where light changes, that of false minima 0 (measured).

    Args:
        changes: Fields of `AlignConfig` that are to be others.
    """
    usual = {"affine": False, "saturation": None, "min_pixels": 16, "min_agreement": 0.1, "loss": LossConfig(scale=0.5)}
    return AlignConfig(**{**usual, **changes})


def pair_features(
    network: nn.Module, ref: Float[Tensor, "B 3 H W"], tgt: Float[Tensor, "B 3 H W"]
) -> tuple[FeaturePyramid, FeaturePyramid]:
    """Return the features of both images of pairs, in one pass; the network is held to `FeatureExtractor`."""
    # Autocast may have halved them, and alignment needs all their digits.
    maps, confidence = ([each.float() for each in part] for part in checked_features(network, torch.cat([ref, tgt])))
    first, second = (
        FeaturePyramid([each[part] for each in maps], [each[part] for each in confidence])
        for part in (slice(None, len(ref)), slice(len(ref), None))
    )
    return first, second


def align_features(
    ref: FeaturePyramid,
    tgt: FeaturePyramid,
    rho: Float[Tensor, "B H W"],
    *,
    T_tgt_ref: Float[Tensor, "B 4 4"] | None = None,
    config: AlignConfig | None = None,
    outputs: Collection[str] = (),
) -> AlignResult:
    """Align panoramas by their features, weighing pixels by the confidences of both.

    Args:
        ref: Features of the references.
        tgt: Features of the targets.
        rho: Inverse range of the references' pixels, 1/m, at the images' size.
        T_tgt_ref: Where to start; the identity by default.
        config: Settings; those of `feature_alignment` by default.
        outputs: As of `align`.

    Raises:
        InputError: As of `align`.
    """
    return align(
        ref.maps,
        tgt.maps,
        rho,
        Equirectangular(rho.shape[-1], rho.shape[-2]),
        T_tgt_ref=T_tgt_ref,
        weight_ref=ref.confidence,
        weight_tgt=tgt.confidence,
        config=feature_alignment() if config is None else config,
        outputs=outputs,
    )


def spread_matrix(camera: Equirectangular, angle: float) -> Float[Tensor, "N N"]:
    """Return the means over the sphere, weighted by `exp((cos d - 1) / angle^2)` of the distance d, as a matrix.

    That is the density of von Mises and Fisher, which for small angles is a Gaussian of that standard deviation and for
    large ones leaves little but the spherical harmonics of degree 1: a direction, to which any rotation finds back.

    Args:
        camera: Of the maps; N is its number of pixels.
        angle: In radians.
    """
    ray = camera.ray_grid(dtype=torch.float64).reshape(-1, 3)
    area = camera.solid_angle(camera.pixel_grid(dtype=torch.float64)).reshape(-1)
    weight = torch.exp((ray @ ray.mT - 1) / angle**2) * area
    return (weight / weight.sum(1, keepdim=True)).float()


def spread(features: Float[Tensor, "B C H W"], matrix: Float[Tensor, "N N"]) -> Float[Tensor, "B C H W"]:
    """Apply a matrix of `spread_matrix` to maps of its camera."""
    return (features.flatten(2) @ matrix.mT).view_as(features)


def standardise(features: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
    """Give every image's features mean 0 in each channel and mean square 1 over channels and sphere."""
    camera = Equirectangular(features.shape[-1], features.shape[-2])
    area = camera.solid_angle(camera.pixel_grid(dtype=features.dtype, device=features.device))
    area = area / area.sum()
    centred = features - (features * area).sum((2, 3), keepdim=True)
    power = (centred.square() * area).sum((2, 3), keepdim=True).mean(1, keepdim=True)
    return centred * (power + 1e-6).rsqrt()


def _layer(in_channels: int, out_channels: int, stride: int = 1) -> nn.Sequential:
    kernel_size = 4 if stride == 2 else 3
    convolution = SphericalConv2d(in_channels, out_channels, kernel_size, stride=stride, bias=False)
    return nn.Sequential(convolution, nn.GroupNorm(4, out_channels), nn.GELU())


def _block(in_channels: int, out_channels: int, stride: int) -> nn.Sequential:
    first = _layer(in_channels, out_channels, stride)
    return first if stride == 1 else nn.Sequential(first, _layer(out_channels, out_channels))
