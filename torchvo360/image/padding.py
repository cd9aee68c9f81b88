"""Neighbours beyond the image's edge: around the seam and over the poles, or the edge itself."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.cameras import Camera, check_image_size
from torchvo360.checks import InputError


def pad_image(image: Float[Tensor, "*batch H W"], camera: Camera, margin: int) -> Float[Tensor, "*batch Hp Wp"]:
    """Extend an image by `margin` pixels on each side.

    A full panorama continues around the seam, and across a pole on the opposite meridian (u + width / 2), as a sphere
    does. Other cameras repeat their edge.

    Raises:
        ShapeError: The image is not of the camera's size.
        InputError: The margin is larger than the image, or a panorama's width is odd: no opposite column.
    """
    check_image_size("image", image, camera)
    if camera.wraps and margin > min(camera.height, camera.width):
        raise InputError(f"margin: expected at most the image's size, got {margin}.")
    if not camera.wraps:
        rows = torch.arange(-margin, camera.height + margin, device=image.device).clamp(0, camera.height - 1)
        columns = torch.arange(-margin, camera.width + margin, device=image.device).clamp(0, camera.width - 1)
        return image.index_select(-2, rows).index_select(-1, columns)
    if camera.width % 2:
        raise InputError(f"image: expected an even width for a full panorama, got {camera.width}.")
    if margin == 0:
        return image
    half_turn = camera.width // 2
    north = image[..., :margin, :].flip(-2).roll(half_turn, -1)
    south = image[..., -margin:, :].flip(-2).roll(half_turn, -1)
    tall = torch.cat([north, image, south], -2)
    return torch.cat([tall[..., -margin:], tall, tall[..., :margin]], -1)
