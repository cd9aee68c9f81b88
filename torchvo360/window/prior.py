"""What the window keeps of keyframes and points that have left it: a quadratic prior on those that stay."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.window.layout import Layout
from torchvo360.window.poses import steps_between
from torchvo360.window.state import METRIC, PER_FRAME, POSE, Estimate, Metric, WindowFrame
from torchvo360.window.system import LEAST_CURVATURE


@dataclass(frozen=True)
class Prior:
    """The energy `d^T H d / 2 + g^T d` of all unknowns' differences d from where it was linearised."""

    H: Float64[Tensor, "D D"]
    g: Float64[Tensor, "D"]

    def widened(self, present: Layout, larger: Layout) -> "Prior":
        """Return the prior with further unknowns, of which it knows nothing."""
        place = present.within(larger)
        H, g = self.H.new_zeros(larger.size, larger.size), self.g.new_zeros(larger.size)
        H[place[:, None], place], g[place] = self.H, self.g
        return Prior(H, g)


@dataclass(frozen=True)
class First:
    """Where the prior was linearised, of what all keyframes share; None while it says nothing of it."""

    intrinsics: Float64[Tensor, "4"] | None = None
    metric: Metric | None = None


def difference(frames: list[WindowFrame], estimate: Estimate, first: First) -> Float64[Tensor, "D"]:
    """Return how far an estimate is from the prior's point; 0 for what the prior does not hold."""
    held = [f.T_first is not None for f in frames]
    out = estimate.affine.new_zeros(len(frames), PER_FRAME)
    if any(held):
        at = torch.tensor([place for place, ok in enumerate(held) if ok])
        T_first = torch.stack([f.T_first for f in frames if f.T_first is not None])
        affine_first = torch.stack([f.affine_first for f in frames if f.affine_first is not None])
        out[at, :POSE] = steps_between(estimate.T_cam_world[at], T_first)
        out[at, POSE:] = estimate.affine[at] - affine_first
    parts, k = [out.flatten()], estimate.intrinsics
    if k is not None:
        parts.append(torch.zeros_like(k) if first.intrinsics is None else k - first.intrinsics)
    if estimate.motion is not None and estimate.metric is not None:
        for frame, motion in zip(frames, estimate.motion, strict=True):
            parts.append(torch.zeros_like(motion) if frame.motion_first is None else motion - frame.motion_first)
        parts.append(out.new_zeros(METRIC) if first.metric is None else estimate.metric.since(first.metric))
    return torch.cat(parts)


def eliminate(
    H: Float64[Tensor, "D D"], g: Float64[Tensor, "D"], unknowns: Int64[Tensor, "U"]
) -> tuple[Float64[Tensor, "E E"], Float64[Tensor, "E"]]:
    """Marginalise a keyframe: the Schur complement of its unknowns, by a pseudo-inverse.

    A combination of them that nothing is known of (a keyframe that sees no point) carries nothing over.
    """
    gone = torch.zeros(len(g), dtype=torch.bool, device=g.device)
    gone[unknowns] = True
    block = H[gone][:, gone]
    # Rounding leaves a curvature of nothing a little below zero: scaled up, it would drown all that is known.
    diagonal = block.diagonal()
    scale = torch.where(diagonal > LEAST_CURVATURE, diagonal.clamp_min(LEAST_CURVATURE).rsqrt(), 0.0)
    inverse = torch.linalg.pinv(scale[:, None] * block * scale, hermitian=True, rtol=1e-9)
    inverse = scale[:, None] * inverse * scale
    carried = H[~gone][:, gone] @ inverse
    rest = H[~gone][:, ~gone] - carried @ H[gone][:, ~gone]
    return (rest + rest.mT) / 2, g[~gone] - carried @ g[gone]
