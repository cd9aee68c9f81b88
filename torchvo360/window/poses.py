"""Steps of the window's keyframes, and what lies between two estimates of them; compiled where that serves."""

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.backends import use_numba
from torchvo360.backends.numba.kernel import kernel


def move_poses(T: Float64[Tensor, "K 4 4"], xi: Float64[Tensor, "K 6"]) -> Float64[Tensor, "K 4 4"]:
    """Return poses after steps: `exp(xi) T`."""
    if not use_numba(T, xi):
        return lie.se3_exp(xi) @ T
    return torch.from_numpy(kernel("poses").move_poses(T.contiguous().numpy(), xi.contiguous().numpy()))


def steps_between(T: Float64[Tensor, "K 4 4"], T_first: Float64[Tensor, "K 4 4"]) -> Float64[Tensor, "K 6"]:
    """Return the steps from some poses to others: `log(T T_first^-1)`."""
    if not use_numba(T, T_first):
        return lie.se3_log(T @ lie.se3_inverse(T_first))
    return torch.from_numpy(kernel("poses").steps_between(T.contiguous().numpy(), T_first.contiguous().numpy()))
