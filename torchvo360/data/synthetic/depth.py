"""A synthetic depth sensor: noise that grows with the range, and blobs where it sees nothing."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32
from torch import Tensor

HOLE_PX = 16
"""Size of the blobs, pixels."""


def sensed_depth(range: Float[Tensor, "H W"], noise: float, holes: float, seed: int) -> Float32[np.ndarray, "H W"]:
    """Return what a depth sensor gives of exact ranges: 0 where it knows nothing, as of the sky.

    Args:
        range: Exact ranges, inf for the sky.
        noise: Standard deviation, as a share of each range.
        holes: Share of the image where nothing is known.
        seed: Of noise and holes.
    """
    generator = torch.Generator().manual_seed(seed)
    depth = range * (1 + noise * torch.randn(range.shape, generator=generator))
    known = torch.isfinite(range) & (depth > 0)
    if holes > 0:
        height, width = range.shape
        coarse = torch.rand(1, 1, 2 + height // HOLE_PX, 2 + width // HOLE_PX, generator=generator)
        field = F.interpolate(coarse, (height, width), mode="bilinear")[0, 0]
        known = known & (field >= field.quantile(holes))
    return torch.where(known, depth, 0.0).to(torch.float32).numpy()
