"""Where the window's unknowns stand in its vectors and matrices.

    (v, w, a, b) of each keyframe | fx, fy, cx, cy | velocity, gyro bias, accel bias of each keyframe | scale, gravity

What images speak of comes first, so that their normal equations are the leading block of the whole.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from torchvo360.window.calibration import INTRINSICS
from torchvo360.window.state import METRIC, MOTION, PER_FRAME


@dataclass(frozen=True)
class Layout:
    """The order of the unknowns."""

    keyframes: int
    calibrate: bool = False
    """Whether intrinsics are among them."""
    inertial: bool = False
    """Whether motions, scale and gravity are."""

    @property
    def visual(self) -> int:
        """The number of those that images speak of."""
        return PER_FRAME * self.keyframes + INTRINSICS * self.calibrate

    @property
    def size(self) -> int:
        """The number of all."""
        return self.visual + (MOTION * self.keyframes + METRIC) * self.inertial

    def pose(self, place: int) -> slice:
        """Return the pose and brightness of a keyframe."""
        return slice(place * PER_FRAME, (place + 1) * PER_FRAME)

    def motion(self, place: int) -> slice:
        """Return the velocity and biases of a keyframe."""
        first = self.visual + place * MOTION
        return slice(first, first + MOTION)

    @property
    def metric(self) -> slice:
        """Return the scale and the direction of gravity."""
        return slice(self.size - METRIC, self.size)

    def of(self, place: int) -> Int64[Tensor, "U"]:
        """Return all unknowns of a keyframe."""
        own = [torch.arange(self.size)[self.pose(place)]]
        return torch.cat(own + [torch.arange(self.size)[self.motion(place)]] * self.inertial)

    def within(self, larger: "Layout") -> Int64[Tensor, "D"]:
        """Return where each of these unknowns stands in a layout with more keyframes behind these, or more kinds."""
        at = torch.arange(larger.size)
        parts = [at[: PER_FRAME * self.keyframes]]
        if self.calibrate:
            parts.append(at[larger.visual - INTRINSICS : larger.visual])
        if self.inertial:
            parts += [at[larger.visual : larger.visual + MOTION * self.keyframes], at[larger.metric]]
        return torch.cat(parts)
