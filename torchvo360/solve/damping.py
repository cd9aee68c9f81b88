"""How the damping lambda follows from step to step, every element's on its own."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.solve.config import LMConfig


class Damping(NamedTuple):
    """Lambda of each element and the growth that its next refusal brings."""

    value: Float[Tensor, "B"]
    growth: Float[Tensor, "B"]


def initial_damping(config: LMConfig, g: Float[Tensor, "B D"]) -> Damping:
    """Return the damping before the first step."""
    start = config.initial_damping if config.damping == "gain_ratio" else 0.0
    return Damping(torch.full_like(g[:, 0], start), torch.full_like(g[:, 0], 2.0))


def next_damping(config: LMConfig, damping: Damping, accepted: Bool[Tensor, "B"], gain: Float[Tensor, "B"]) -> Damping:
    """Return the damping after a step.

    Args:
        config: Names the policy.
        damping: Before the step.
        accepted: Whether the step lowered the cost.
        gain: Fall of the cost over the fall that the linear model promised.
    """
    value, growth = damping
    if config.damping == "gain_ratio":
        # Nielsen 1999: the better the model predicted, the less damping; refusals grow it ever faster.
        shrink = (1 - (2 * gain.clamp(0.0, 1.0) - 1) ** 3).clamp_min(1 / 3)
        lower = (value * shrink).clamp_min(1e-9)
    else:
        lower = torch.where(value <= 0.2, torch.zeros_like(value), value / 2)
    higher = torch.where(value == 0, torch.full_like(value, 0.2), value * growth)
    return Damping(
        torch.where(accepted, lower, higher), torch.where(accepted, torch.full_like(growth, 2.0), growth * 2)
    )
