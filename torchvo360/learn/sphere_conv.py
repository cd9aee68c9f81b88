"""Convolution and enlargement on the sphere: panoramas continue around the seam and over the poles.

A map's pixel is the centre of the pixels that it came from, as in image pyramids (mathematics.md, section 1): a stride
takes an even kernel, so that no level is shifted against the images by half a pixel.
"""

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from torchvo360.cameras import Equirectangular
from torchvo360.checks import InputError, check_shape
from torchvo360.image import pad_image


def pad_sphere(features: Float[Tensor, "B C H W"], margin: int) -> Float[Tensor, "B C Hp Wp"]:
    """Extend full panoramas by `margin` pixels on each side, around the seam and across the poles.

    Raises:
        ShapeError: There are not four axes.
        InputError: The width is odd, or the margin is larger than the map.
    """
    size = check_shape("features", features, "B C H W")
    return pad_image(features, Equirectangular(size["W"], size["H"]), margin)


class SphericalConv2d(nn.Conv2d):
    """A convolution whose neighbours are those on the sphere; a map [B, C, H, W] becomes [B, C', H / s, W / s].

    It turns with the panorama: rolling the input by a multiple of the stride rolls the output.

    Args:
        in_channels: Channels of the input.
        out_channels: Channels of the output.
        kernel_size: Side of the square kernel: odd for stride 1, even for stride 2.
        stride: Side of the blocks of pixels, each of which becomes one.
        groups: Groups of channels that are convolved apart.
        bias: Whether a constant is added to each channel.

    Raises:
        InputError: The kernel does not lie symmetrically on the block: their difference is odd or negative.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int = 3,
        *,
        stride: int = 1,
        groups: int = 1,
        bias: bool = True,
    ) -> None:
        if kernel_size < stride or (kernel_size - stride) % 2:
            sizes = f"{kernel_size} and {stride}"
            raise InputError(f"kernel_size, stride: expected a kernel larger by 0, 2, 4, ... pixels, got {sizes}.")
        super().__init__(in_channels, out_channels, kernel_size, stride=stride, groups=groups, bias=bias)
        self.margin = (kernel_size - stride) // 2

    def forward(self, input: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D h w"]:
        return super().forward(pad_sphere(input, self.margin))


def enlarge(features: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C 2H 2W"]:
    """Return maps of twice the size, bilinear around the seam and over the poles."""
    double = F.interpolate(pad_sphere(features, 1), scale_factor=2, mode="bilinear", align_corners=False)
    return double[..., 2:-2, 2:-2]
