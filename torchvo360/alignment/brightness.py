"""How bright two images are: where a solve starts with gain and offset."""

import math

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.backends import Comparison, compare, numba, use_numba
from torchvo360.residuals.direct import Reference, Target


def match_brightness(reference: Reference, target: Target, T_tgt_ref: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 2"]:
    """Return (a, b) that give the reference's points the mean and spread of what the target shows at their places.

    The places are those of the start. It need not be close: where the same things are in view, moments are much the
    same, and exposure jumps of several stops are bridged before the first step. The gain is held within a factor of
    five; where nothing is seen the brightness is taken as equal.

    Args:
        reference: Points.
        target: Images.
        T_tgt_ref: Starts.
    """
    if use_numba() and numba.serves(reference, target, T_tgt_ref, T_tgt_ref):
        moments = numba.brightness_moments(reference, target, T_tgt_ref)
    else:
        moments = _moments(compare(reference, target, T_tgt_ref, T_tgt_ref.new_zeros(len(T_tgt_ref), 2)))
    mean_tgt, variance_tgt, mean_ref, variance_ref = moments.unbind(-1)
    # The floor keeps the root's slope finite where an image has no contrast.
    spread_tgt, spread_ref = (variance_tgt + 1e-16).sqrt(), (variance_ref + 1e-16).sqrt()
    a = ((spread_tgt + 1e-4) / (spread_ref + 1e-4)).log().clamp(-math.log(5), math.log(5))
    return torch.stack([a, mean_tgt - a.exp() * mean_ref], -1)


def _moments(found: Comparison) -> Float64[Tensor, "B 4"]:
    """Return mean and variance of the target, and of the reference, over the means of their channels."""
    weight = found.weight.double().mean(1)
    # A few heavy pixels say where to align, not how bright the images are.
    weight = torch.minimum(weight, weight.mean(1, keepdim=True))
    total = weight.sum(1).clamp_min(1e-12)
    moments = []
    for value in (found.value, found.value - found.residual):
        each = value.double().mean(1)
        mean = (each * weight).sum(1) / total
        moments += [mean, ((each - mean[:, None]).square() * weight).sum(1) / total]
    return torch.stack(moments, -1)
