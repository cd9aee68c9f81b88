"""What the window keeps of keyframes and points that have left it: a quadratic prior on those that stay."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.window.state import PER_FRAME, POSE, Estimate, WindowFrame
from torchvo360.window.system import LEAST_CURVATURE


@dataclass(frozen=True)
class Prior:
    """The energy `d^T H d / 2 + g^T d` of all unknowns' differences d from where it was linearised."""

    H: Float64[Tensor, "D D"]
    g: Float64[Tensor, "D"]

    def widened(self, size: int, shared: int = 0) -> "Prior":
        """Return the prior with further unknowns, of which it knows nothing, before the last `shared` ones."""
        at = len(self.g) - shared
        place = torch.cat([torch.arange(at), torch.arange(size - shared, size)])
        H, g = self.H.new_zeros(size, size), self.g.new_zeros(size)
        H[place[:, None], place], g[place] = self.H, self.g
        return Prior(H, g)


def difference(
    frames: list[WindowFrame], estimate: Estimate, k_first: Float64[Tensor, "4"] | None = None
) -> Float64[Tensor, "D"]:
    """Return how far an estimate is from the prior's point; 0 for what the prior does not hold.

    Args:
        frames: The keyframes.
        estimate: Where they stand.
        k_first: Intrinsics at which the prior was linearised.
    """
    held = [f.T_first is not None for f in frames]
    out = estimate.affine.new_zeros(len(frames), PER_FRAME)
    if any(held):
        at = torch.tensor([place for place, ok in enumerate(held) if ok])
        T_first = torch.stack([f.T_first for f in frames if f.T_first is not None])
        affine_first = torch.stack([f.affine_first for f in frames if f.affine_first is not None])
        out[at, :POSE] = lie.se3_log(estimate.T_cam_world[at] @ lie.se3_inverse(T_first))
        out[at, POSE:] = estimate.affine[at] - affine_first
    if estimate.intrinsics is None:
        return out.flatten()
    k = estimate.intrinsics
    return torch.cat([out.flatten(), torch.zeros_like(k) if k_first is None else k - k_first])


def eliminate_frame(
    H: Float64[Tensor, "D D"], g: Float64[Tensor, "D"], place: int
) -> tuple[Float64[Tensor, "E E"], Float64[Tensor, "E"]]:
    """Marginalise one keyframe: the Schur complement of its eight unknowns, by a pseudo-inverse.

    A combination of them that nothing is known of (a keyframe that sees no point) carries nothing over.
    """
    gone = torch.zeros(len(g), dtype=torch.bool, device=g.device)
    gone[place * PER_FRAME : (place + 1) * PER_FRAME] = True
    block = H[gone][:, gone]
    # Rounding leaves a curvature of nothing a little below zero: scaled up, it would drown all that is known.
    diagonal = block.diagonal()
    scale = torch.where(diagonal > LEAST_CURVATURE, diagonal.clamp_min(LEAST_CURVATURE).rsqrt(), 0.0)
    inverse = torch.linalg.pinv(scale[:, None] * block * scale, hermitian=True, rtol=1e-9)
    inverse = scale[:, None] * inverse * scale
    carried = H[~gone][:, gone] @ inverse
    rest = H[~gone][:, ~gone] - carried @ H[gone][:, ~gone]
    return (rest + rest.mT) / 2, g[~gone] - carried @ g[gone]
