"""Ranges from a network: a map in metres from a single frame, and the metre for a start that knows no unit."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor, nn

from torchvo360.depth import InverseRange
from torchvo360.learn.plugin import checked_ranges
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe, MapConfig, make_keyframe


@dataclass(frozen=True)
class LearnedRanges:
    """A depth network, asked about the points of keyframes."""

    network: nn.Module
    """It fulfils `DepthEstimator` and lies on the builder's device."""
    builder: FrameBuilder
    map: MapConfig
    min_points: int
    """Fewer points that the network is sure of say nothing."""

    def keyframe(self, frame: PyramidFrame, T_world_key: Float64[Tensor, "4 4"]) -> Keyframe | None:
        """Make a frame a keyframe with the network's ranges; None where too few of them are sure.

        Raises:
            InputError: The network does not give ranges.
        """
        key = make_keyframe(frame, T_world_key, self.builder, self.map)
        key.points = self._ranges(frame, key.pixel)
        return key if int(key.trusted(self.map.max_relative_variance).sum()) >= self.min_points else None

    def unit(self, key: Keyframe) -> float | None:
        """Return the inverse range in metres that the keyframe calls 1; None where too few points tell.

        Raises:
            InputError: The network does not give ranges.
        """
        learned = replace(key, points=self._ranges(key.frame, key.pixel))
        limit = self.map.max_relative_variance
        known = key.trusted(limit) & learned.trusted(limit)
        if int(known.sum()) < self.min_points:
            return None
        # The median: a network blurs the edges of things, where many points lie.
        return float((learned.points.rho / key.points.rho)[known].median())

    @torch.no_grad()
    def _ranges(self, frame: PyramidFrame, pixel: Int64[Tensor, "N"]) -> InverseRange:
        """Return the network's ranges at flat pixels, with the score of a point that was matched once."""
        colour = torch.from_numpy(frame.colour).to(self.builder.device, torch.float32) / 255
        estimate = checked_ranges(self.network, colour.permute(2, 0, 1)[None])
        rho, variance = (part.flatten()[pixel].float() for part in estimate)
        return InverseRange(rho, variance, torch.ones_like(rho))
