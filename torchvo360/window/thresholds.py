"""Which edges count: an edge whose mean energy is beyond its image's threshold is an outlier."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.window.config import WindowConfig
from torchvo360.window.points import LEAST_WEIGHT


class Judged(NamedTuple):
    """What is thought of the points that one image sees."""

    seen: Bool[Tensor, "n"]
    """Enough of the pattern is in view."""
    good: Bool[Tensor, "n"]
    """And the mean energy is within the threshold."""
    energy: Float[Tensor, "n"]
    """Points beyond the threshold count by the threshold; 0 where not seen."""
    threshold: Float[Tensor, ""]


def judge(
    cost: Float[Tensor, "n P"],
    weight: Float[Tensor, "n P"],
    own_weight: Float[Tensor, "n"],
    config: WindowConfig,
    threshold: Float[Tensor, ""] | None,
) -> Judged:
    """Judge the points that one image sees.

    Args:
        cost: Robust costs of the pattern's pixels.
        weight: Their weights in view.
        own_weight: Sum of the pattern's weights in the host.
        config: Settings.
        threshold: Mean energy from which a point is an outlier; by a quantile of those seen where it is None.
    """
    total = weight.sum(1)
    mean = (cost * weight).sum(1) / total.clamp_min(1e-6)
    seen = total > LEAST_WEIGHT * own_weight.clamp_min(1e-6)
    limit = find_threshold(mean[seen], config) if threshold is None else threshold
    return Judged(seen, seen & (mean < limit), torch.minimum(mean, limit) * total * seen, limit)


def find_threshold(mean: Float[Tensor, "n"], config: WindowConfig) -> Float[Tensor, ""]:
    """Return an image's outlier threshold by a quantile of the mean energies of the points that it sees."""
    least = mean.new_tensor(config.min_threshold)
    if len(mean) == 0:
        return least
    at = min(len(mean), max(1, round(config.outlier_quantile * len(mean))))
    return torch.maximum(config.outlier_factor * mean.kthvalue(at).values, least)
