"""What is tried when tracking is weak: the rotation since the last frame, then every rotation there is."""

from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.image import blur, pad_image
from torchvo360.motion.rotation import align_rotation, rotation_grid, search_rotation
from torchvo360.residuals.direct import Reference, Target
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.map import Keyframe
from torchvo360.vo.track import Track, TrackConfig, track

GRID_STEP_RAD = 0.43
"""Spacing of the global search, about a thousand rotations: none is farther than 16 deg from one of them."""
BLUR_PX = 1.0
"""Smoothing of the small images: it widens the basin of the refinement."""
KEPT = 3
"""Rotations of a global search that are tracked."""


class Recovery:
    """Finds frames again without a usable prediction, by rotation search on the coarsest level."""

    def __init__(self, builder: FrameBuilder, config: TrackConfig, max_relative_variance: float) -> None:
        self._config, self._limit = config, max_relative_variance
        camera = builder.cameras[-1]
        self._ray = camera.ray_grid(device=builder.device).permute(2, 0, 1).reshape(1, 3, -1).contiguous()
        area = camera.solid_angle(camera.pixel_grid(device=builder.device))
        self._weight = (area / area.mean()).reshape(1, -1)
        self._grid = rotation_grid(GRID_STEP_RAD).to(builder.device)

    def _small(self, frame: PyramidFrame) -> Target:
        """Return the coarsest level, smoothed further."""
        target = frame.targets[-1]
        image = blur(target.padded[..., 1:-1, 1:-1], target.camera, BLUR_PX)
        return replace(target, padded=pad_image(image, target.camera, 1).contiguous())

    def _points(self, target: Target) -> Reference:
        value = target.padded[..., 1:-1, 1:-1].reshape(1, 1, -1)
        weight = self._weight
        if target.confidence is not None:
            weight = weight * target.confidence[..., 1:-1, 1:-1].reshape(1, -1)
        return Reference(self._ray, torch.zeros_like(weight), value, weight)

    def search(
        self,
        key: Keyframe,
        frame: PyramidFrame,
        last: PyramidFrame | None,
        T_last_key: Float64[Tensor, "4 4"],
        affine: Float64[Tensor, "2"],
        found: Track | None,
    ) -> Track | None:
        """Return the best of the weak track, tracks from the rotation since the last frame, and from all rotations.

        Args:
            key: The keyframe.
            frame: The frame to be placed.
            last: The frame before it.
            T_last_key: Where that stood.
            affine: Brightness to start from.
            found: What was found so far.
        """
        tries = []
        if last is not None:
            small, before = self._small(frame), self._points(self._small(last))
            eye = torch.eye(3, dtype=torch.float64, device=self._grid.device)[None]
            tries.append(align_rotation(before, small, eye))
            tries.append(search_rotation(before, small, self._grid))
        for attempt in tries:
            R = attempt.R_tgt_ref[:KEPT]
            turn = lie.se3(R, R.new_zeros(R.shape[0], 3))
            tracked = track(key, frame, turn @ T_last_key, affine, self._config, self._limit)
            if tracked is not None and (found is None or tracked.inliers > found.inliers):
                found = tracked
        return found

    def relocalise(self, key: Keyframe, frame: PyramidFrame) -> Track | None:
        """Return where a frame stands against an earlier keyframe, from any orientation at about its place."""
        R = search_rotation(self._points(self._small(key.frame)), self._small(frame), self._grid).R_tgt_ref[:KEPT]
        start = lie.se3(R, R.new_zeros(R.shape[0], 3))
        return track(key, frame, start, torch.zeros(2, dtype=torch.float64), self._config, self._limit)
