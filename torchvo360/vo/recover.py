"""What is tried when tracking is weak: the rotation since the last frame, every rotation, earlier keyframes."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.image import blur, pad_image
from torchvo360.loop import describe_place, place_similarity
from torchvo360.motion.rotation import align_rotation, rotation_grid, search_rotation
from torchvo360.residuals.direct import Reference, Target
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe, KeyPoints
from torchvo360.vo.track import Track, TrackConfig, track

GRID_STEP_RAD = 0.43
"""Spacing of the global search, about a thousand rotations: none is farther than 20 deg from one of them."""
BLUR_PX = 1.0
"""Smoothing of the small images: it widens the basin of the refinement."""
KEPT = 3
"""Rotations of a global search that are tracked."""
TRIED_PER_FRAME = 3
"""Earlier keyframes that one lost frame is compared with; the next lost frame goes on where it ended."""
MIN_AGREEMENT = 0.15
"""Rotations that match less of the small images' gradient than this are not tracked: unrelated images reach 0.12, and a
keyframe whose median parallax is tens of degrees by now only 0.2, though its points are found."""


@dataclass(frozen=True)
class Remembered:
    """What is kept of a keyframe: its points and one small image, a quarter of a megabyte."""

    key: KeyPoints
    small: Target
    descriptor: Float[Tensor, "D"]
    """Of the place (`describe_place`)."""


class Recovery:
    """Finds frames again without a usable prediction, by rotation search on the coarsest level."""

    def __init__(self, builder: FrameBuilder, config: TrackConfig, max_relative_variance: float) -> None:
        self._config, self._limit = config, max_relative_variance
        camera = builder.cameras[-1]
        self._ray = camera.ray_grid(device=builder.device).permute(2, 0, 1).reshape(1, 3, -1).contiguous()
        area = camera.solid_angle(camera.pixel_grid(device=builder.device))
        self._weight = (area / area.mean()).reshape(1, -1)
        self._grid = rotation_grid(GRID_STEP_RAD).to(builder.device)
        self._remembered: list[Remembered] = []
        self._turn = 0

    def remember(self, key: Keyframe) -> None:
        """Keep a keyframe for relocalisation."""
        points = KeyPoints(key.index, key.T_world_key, key.pixel, key.ray, key.slope, key.values, key.points)
        self._remembered.append(Remembered(points, self._small(key.frame), self._described(key.frame)))
        self._turn = 0

    def __len__(self) -> int:
        return len(self._remembered)

    def forget(self, first: int) -> None:
        """Forget all but the first keyframes, when the later ones' map turned out wrong."""
        del self._remembered[first:]
        self._turn = 0

    def _small(self, frame: PyramidFrame) -> Target:
        """Return the coarsest level, smoothed further."""
        target = frame.targets[-1]
        image = blur(target.padded[..., 1:-1, 1:-1], target.camera, BLUR_PX)
        return replace(target, padded=pad_image(image, target.camera, 1).contiguous())

    def _described(self, frame: PyramidFrame) -> Float[Tensor, "D"]:
        target = frame.targets[-1]
        known = None if target.confidence is None else target.confidence[0, 0, 1:-1, 1:-1] > 0.5
        return describe_place(target.padded[0, 0, 1:-1, 1:-1], target.camera, known)

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
        """Return the best of a weak track, tracks from the rotation since the last frame, and from all rotations.

        Args:
            key: The keyframe.
            frame: The frame to be placed.
            last: The last frame that was found.
            T_last_key: Where that stood.
            affine: Brightness to start from.
            found: What was found so far.
        """
        if last is None:
            return found
        small, before = self._small(frame), self._points(self._small(last))
        eye = torch.eye(3, dtype=torch.float64, device=self._grid.device)[None]
        for attempt in (align_rotation(before, small, eye), search_rotation(before, small, self._grid)):
            R = attempt.R_tgt_ref[:KEPT][attempt.agreement[:KEPT] >= MIN_AGREEMENT]
            if R.shape[0] == 0:
                continue
            tracked = track(key, frame, _turns(R) @ T_last_key, affine, self._config, self._limit)
            if tracked is not None and (found is None or tracked.inliers > found.inliers):
                found = tracked
        return found

    def relocalise(
        self, frame: PyramidFrame, min_inliers: float, *, afresh: bool = False
    ) -> tuple[KeyPoints, Track] | None:
        """Return an earlier keyframe in which a frame is found, from any orientation at about its place.

        A few are tried, the most like ones first; the next call goes on with the less like, and then begins again.

        Args:
            frame: The lost frame.
            min_inliers: Share of agreeing gradient from which it counts as found.
            afresh: Begin with the most like ones.
        """
        self._turn = 0 if afresh else self._turn
        count = len(self._remembered)
        if count == 0:
            return None
        small = self._small(frame)
        places = torch.stack([place.descriptor for place in self._remembered])
        like, _ = place_similarity(self._described(frame), places, yaw_invariant=small.camera.wraps)
        order = like.argsort(descending=True, stable=True).tolist()
        for _ in range(min(TRIED_PER_FRAME, count)):
            place = self._remembered[order[self._turn % count]]
            self._turn += 1
            rotations = search_rotation(self._points(place.small), small, self._grid)
            R = rotations.R_tgt_ref[:KEPT][rotations.agreement[:KEPT] >= MIN_AGREEMENT]
            if R.shape[0] == 0:
                continue
            brightness = rotations.affine[0].cpu()
            found = track(place.key, frame, _turns(R), brightness, self._config, self._limit)
            if found is not None and found.inliers >= min_inliers:
                self._turn = 0
                return place.key, found
        return None


def _turns(R: Float64[Tensor, "K 3 3"]) -> Float64[Tensor, "K 4 4"]:
    """Return motions without translation, where poses are kept: on the CPU."""
    return lie.se3(R, R.new_zeros(R.shape[0], 3)).cpu()
