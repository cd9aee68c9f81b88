"""The pattern of pixels through which a point is seen."""

import torch
from jaxtyping import Float
from torch import Tensor

PATTERN = ((0, -2), (-1, -1), (1, -1), (-2, 0), (0, 0), (2, 0), (-1, 1), (0, 2))
"""DSO's pattern, pixels to the right and down. Single pixels leave too little once each has its own inverse range."""

CENTRE = PATTERN.index((0, 0))
"""Where the point itself stands in the pattern."""


def pattern_rays(
    ray: Float[Tensor, "3 N"], pixel_angle: float, pattern: tuple[tuple[int, int], ...] = PATTERN
) -> Float[Tensor, "3 N P"]:
    """Return the pattern's unit rays around each ray, laid in its tangent plane, so that it has one size everywhere.

    Args:
        ray: Unit rays.
        pixel_angle: The angle of one pixel, radians.
        pattern: Offsets to the right and down, pixels.
    """
    x, _, z = ray
    # Rightwards along the parallel; on the vertical axis any direction serves.
    flat = torch.stack([z, torch.zeros_like(z), -x])
    flat = torch.where((x.abs() + z.abs() > 1e-6), flat, flat.new_tensor([[1.0], [0.0], [0.0]]))
    right = flat / torch.linalg.vector_norm(flat, dim=0)
    # x right, y down, z forward is right-handed: forward x right = down.
    down = torch.linalg.cross(ray, right, dim=0)
    offset = ray.new_tensor(pattern) * pixel_angle
    rays = ray[..., None] + right[..., None] * offset[:, 0] + down[..., None] * offset[:, 1]
    return rays / torch.linalg.vector_norm(rays, dim=0)
