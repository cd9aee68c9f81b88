"""Ranges from a depth sensor: a map in metres from a single frame, for any camera."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.depth import InverseRange
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe, MapConfig, make_keyframe


@dataclass(frozen=True)
class SensorRanges:
    """The points of a frame where its depth image knows them."""

    builder: FrameBuilder
    map: MapConfig
    min_points: int
    """Fewer points with a range make no map."""

    def keyframe(self, frame: PyramidFrame, T_world_key: Float64[Tensor, "4 4"]) -> Keyframe | None:
        """Make a frame a keyframe with the sensor's ranges; None where too few are known, as without a depth image.

        A point that the sensor does not know has the median range, and a variance as large.
        """
        if frame.sensed is None:
            return None
        key = make_keyframe(frame, T_world_key, self.builder, self.map)
        rho, variance = self.builder.sensed(frame, key.pixel)
        known = torch.isfinite(variance)
        if int(known.sum()) < self.min_points:
            return None
        guess = rho[known].median()
        rho, variance = torch.where(known, rho, guess), torch.where(known, variance, guess.square())
        key.points = InverseRange(rho, variance, known.to(rho.dtype))
        return key if int(key.trusted(self.map.max_relative_variance).sum()) >= self.min_points else None
