"""What the window estimates: keyframe poses, brightness and inverse ranges, and where each of them stands."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.residuals.direct import Target

POSE, PER_FRAME = 6, 8
"""A keyframe has a pose (v, w) and a brightness (a, b)."""


class Estimate(NamedTuple):
    """The unknowns of K keyframes and N points."""

    T_cam_world: Float64[Tensor, "K 4 4"]
    affine: Float64[Tensor, "K 2"]
    """(a, b): a scene's intensity I appears as e^a I + b."""
    rho: Float[Tensor, "N"]
    """Inverse distances in the points' hosts."""
    intrinsics: Float64[Tensor, "4"] | None = None
    """(fx, fy, cx, cy) of all keyframes; None where the camera's own hold."""

    def moved(self, step: Float64[Tensor, "D"], rho_step: Float64[Tensor, "N"]) -> "Estimate":
        """Return the estimate after a step; no inverse distance changes by more than half, or becomes negative."""
        K = self.T_cam_world.shape[0]
        each = step[: PER_FRAME * K].view(K, PER_FRAME)
        limit = 0.5 * self.rho.double().clamp_min(0.02 * float(self.rho.median()) if len(self.rho) else 0.0)
        rho = (self.rho.double() + torch.clamp(rho_step, -limit, limit)).clamp_min(0.0)
        k = self.intrinsics if self.intrinsics is None else self.intrinsics + step[PER_FRAME * K :]
        T = lie.se3_exp(each[:, :POSE]) @ self.T_cam_world
        return Estimate(T, self.affine + each[:, POSE:], rho.to(self.rho), k)


@dataclass(frozen=True)
class WindowFrame:
    """One keyframe of the window."""

    key: int
    """Which keyframe it is, for the owner of the window."""
    target: Target
    """Its finest level, batch 1, one channel."""
    T_cam_world: Float64[Tensor, "4 4"]
    affine: Float64[Tensor, "2"]
    others: tuple[Target | None, ...] = ()
    """The finest levels of a rig's further cameras; None where one gave no image."""
    T_first: Float64[Tensor, "4 4"] | None = None
    """Where the prior was linearised; None while it does not hold this keyframe."""
    affine_first: Float64[Tensor, "2"] | None = None
    thresholds: Float[Tensor, "S"] | None = None
    """Outlier thresholds of its image and of the others that there are, by the last optimisation."""

    def linearised(self) -> "WindowFrame":
        """Return the keyframe as the prior sees it from now on: its first estimate is the present, if it has none."""
        if self.T_first is not None:
            return self
        return replace(self, T_first=self.T_cam_world, affine_first=self.affine)


def estimate_of(frames: list[WindowFrame], rho: Float[Tensor, "N"], k: Float64[Tensor, "4"] | None) -> Estimate:
    """Return the present estimate of keyframes and points."""
    T, affine = (torch.stack([getattr(f, name) for f in frames]) for name in ("T_cam_world", "affine"))
    return Estimate(T, affine, rho, k)


def first_poses(frames: list[WindowFrame], T_cam_world: Float64[Tensor, "K 4 4"]) -> Float64[Tensor, "K 4 4"]:
    """Return the poses at which Jacobians are taken: first estimates where the prior holds a keyframe, else T."""
    return torch.stack([T if f.T_first is None else f.T_first for f, T in zip(frames, T_cam_world, strict=True)])
