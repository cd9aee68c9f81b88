"""What the window estimates: keyframe poses, brightness and inverse ranges, and where each of them stands."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.residuals.direct import Target
from torchvo360.residuals.inertial import turn_gravity
from torchvo360.window.poses import move_poses

POSE, PER_FRAME = 6, 8
"""A keyframe has a pose (v, w) and a brightness (a, b)."""
MOTION, METRIC = 9, 3
"""With an IMU it has a velocity and the biases of gyroscope and accelerometer, too, and the map a scale and a direction
of gravity."""


class Metric(NamedTuple):
    """What links a map to metres and to the vertical: three unknowns, log-scale and two angles of gravity."""

    log_scale: Float64[Tensor, ""]
    """A unit of the map has e^log_scale metres."""
    tilt: Float64[Tensor, "2"]
    """How far gravity has turned from where it was first taken to point, radians."""
    first_gravity: Float64[Tensor, "3"]
    """m/s^2, in the map's axes."""

    @property
    def gravity(self) -> Float64[Tensor, "3"]:
        """Gravity as it is now, m/s^2, in the map's axes."""
        return turn_gravity(self.first_gravity, self.tilt)

    def moved(self, step: Float64[Tensor, "3"]) -> "Metric":
        """Return scale and gravity after a step."""
        return self._replace(log_scale=self.log_scale + step[0], tilt=self.tilt + step[1:])

    def since(self, first: "Metric") -> Float64[Tensor, "3"]:
        """Return the step from another estimate with the same first gravity."""
        return torch.cat([(self.log_scale - first.log_scale)[None], self.tilt - first.tilt])


class Estimate(NamedTuple):
    """The unknowns of K keyframes and N points."""

    T_cam_world: Float64[Tensor, "K 4 4"]
    affine: Float64[Tensor, "K 2"]
    """(a, b): a scene's intensity I appears as e^a I + b."""
    rho: Float[Tensor, "N"]
    """Inverse distances in the points' hosts."""
    intrinsics: Float64[Tensor, "4"] | None = None
    """(fx, fy, cx, cy) of all keyframes; None where the camera's own hold."""
    motion: Float64[Tensor, "K 9"] | None = None
    """Velocity in the world's axes, m/s, gyro bias, rad/s, and accelerometer bias, m/s^2; None without an IMU."""
    metric: Metric | None = None

    def moved(self, step: Float64[Tensor, "D"], rho_step: Float64[Tensor, "N"]) -> "Estimate":
        """Return the estimate after a step; no inverse distance changes by more than half, or becomes negative."""
        K = self.T_cam_world.shape[0]
        each = step[: PER_FRAME * K].view(K, PER_FRAME)
        limit = 0.5 * self.rho.double().clamp_min(0.02 * float(self.rho.median()) if len(self.rho) else 0.0)
        rho = (self.rho.double() + torch.clamp(rho_step, -limit, limit)).clamp_min(0.0)
        T = move_poses(self.T_cam_world, each[:, :POSE])
        k, motion, metric, rest = self.intrinsics, self.motion, self.metric, step[PER_FRAME * K :]
        if k is not None:
            k, rest = k + rest[: len(k)], rest[len(k) :]
        if motion is not None and metric is not None:
            motion, metric = motion + rest[:-METRIC].view(K, MOTION), metric.moved(rest[-METRIC:])
        return Estimate(T, self.affine + each[:, POSE:], rho.to(self.rho), k, motion, metric)


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
    motion: Float64[Tensor, "9"] | None = None
    """Velocity and biases (`Estimate.motion`); None without an IMU."""
    motion_first: Float64[Tensor, "9"] | None = None
    thresholds: Float[Tensor, "S"] | None = None
    """Outlier thresholds of its image and of the others that there are, by the last optimisation."""

    def linearised(self) -> "WindowFrame":
        """Return the keyframe as the prior sees it from now on: its first estimate is the present, if it has none."""
        out = self
        if out.T_first is None:
            out = replace(out, T_first=out.T_cam_world, affine_first=out.affine)
        return out if out.motion_first is not None else replace(out, motion_first=out.motion)


def estimate_of(
    frames: list[WindowFrame],
    rho: Float[Tensor, "N"],
    k: Float64[Tensor, "4"] | None = None,
    metric: Metric | None = None,
) -> Estimate:
    """Return the present estimate of keyframes and points."""
    T, affine = (torch.stack([getattr(f, name) for f in frames]) for name in ("T_cam_world", "affine"))
    motions = [f.motion for f in frames if f.motion is not None]
    return Estimate(T, affine, rho, k, torch.stack(motions) if metric is not None else None, metric)


def first_poses(frames: list[WindowFrame], T_cam_world: Float64[Tensor, "K 4 4"]) -> Float64[Tensor, "K 4 4"]:
    """Return the poses at which Jacobians are taken: first estimates where the prior holds a keyframe, else T."""
    return torch.stack([T if f.T_first is None else f.T_first for f, T in zip(frames, T_cam_world, strict=True)])
