"""Immature points: pixels of the newest keyframe whose range is not known yet, followed along their great circles."""

from dataclasses import dataclass

from jaxtyping import Float, Float64, Int64
from torch import Tensor

from torchvo360.depth import EpipolarConfig, FilterConfig, InverseRange, fuse, search_great_circles
from torchvo360.vo.frame import PyramidFrame

RIPE_SCORE = 2.0
"""Matches, less failures, that a candidate needs before it may become a point."""


@dataclass
class Candidates:
    """Pixels of one keyframe with guesses of their inverse distances, which every frame improves."""

    frame: PyramidFrame
    pixel: Int64[Tensor, "N"]
    ray: Float[Tensor, "3 N"]
    slope: Float[Tensor, "N"]
    """Gradient magnitude, intensity per pixel."""
    points: InverseRange

    def observe(
        self,
        frame: PyramidFrame,
        T_cam_key: Float64[Tensor, "4 4"],
        affine: Float64[Tensor, "2"],
        epipolar: EpipolarConfig,
        filter: FilterConfig,
    ) -> None:
        """Search all candidates in a frame and fuse what is found.

        Args:
            frame: The frame.
            T_cam_key: Where it stands against the candidates' keyframe.
            affine: Its brightness against that keyframe.
            epipolar: Settings of the search.
            filter: Settings of the fusion.
        """
        if len(self.pixel) == 0:
            return
        rho, variance, _ = self.points
        match = search_great_circles(
            self.frame.targets[0], frame.targets[0], self.ray, rho, variance, self.slope, T_cam_key, affine, epipolar
        )
        self.points = fuse(self.points, match, filter)

    def ripe(self, max_relative_variance: float) -> Int64[Tensor, "M"]:
        """Return the candidates whose range is known well enough, by index."""
        rho, variance, score = self.points
        return ((score >= RIPE_SCORE) & (variance < max_relative_variance * rho * rho)).nonzero()[:, 0]
