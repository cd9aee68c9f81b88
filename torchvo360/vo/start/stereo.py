"""Ranges from a rig's further cameras: a map in metres from a single moment, for any known rig."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.cameras import Camera, Rig
from torchvo360.checks import InputError
from torchvo360.data.frame import Frame
from torchvo360.depth import InverseRange
from torchvo360.depth.epipolar import great_circles
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.keyframe import Keyframe, MapConfig, make_keyframe
from torchvo360.window import TraceConfig, View, WindowConfig, make_points, trace

MATCH_ERROR_PX = 0.3
"""Standard deviation of a traced match, pixels of arc."""


@dataclass(frozen=True)
class StereoRanges:
    """Points of a frame traced into what a rig's further cameras saw at the same time."""

    builder: FrameBuilder
    map: MapConfig
    trace: TraceConfig
    window: WindowConfig
    min_points: int
    """Fewer points with a range make no map."""

    def keyframe(self, frame: PyramidFrame, T_world_key: Float64[Tensor, "4 4"]) -> Keyframe | None:
        """Make a frame a keyframe with stereo's ranges; None where too few are sure, as without a second image.

        A point whose disparity cannot be told from none, or that is not found, has a variance as large as its range.
        """
        views = stereo_views(frame, self.builder)
        if not views:
            return None
        key = make_keyframe(frame, T_world_key, self.builder, self.map)
        points = make_points(frame.targets[0], key.pixel, key.ray, key.points.rho, self.window)
        unknown = torch.full_like(key.points.rho, torch.inf)
        rho, variance = torch.ones_like(unknown), unknown
        # Each camera's own curves in turn: where one sees a point along its baseline another may not.
        for first in range(len(views)):
            ordered = [views[first], *views[:first], *views[first + 1 :]]
            traced = trace(points, frame.targets[0], ordered, self.trace)
            circles = great_circles(key.ray, views[first].T_tgt_host.to(key.ray))
            step = MATCH_ERROR_PX * views[first].target.camera.pixel_angle
            error = (circles.rho_by_angle(circles.angle(traced.rho)) * step).square()
            better = traced.found & (error < variance)
            rho, variance = torch.where(better, traced.rho, rho), torch.where(better, error, variance)
        found = torch.isfinite(variance)
        # What was not found is as well unknown as anything: a guess of the others' size.
        guess = rho[found].median() if bool(found.any()) else rho.new_ones(())
        rho, variance = torch.where(found, rho, guess), torch.where(found, variance, guess.square())
        key.points = InverseRange(rho, variance, found.to(rho.dtype))
        return key if int(key.trusted(self.map.max_relative_variance).sum()) >= self.min_points else None


def stereo_views(frame: PyramidFrame, builder: FrameBuilder) -> list[View]:
    """Return a frame's further images, under one exposure, as they are seen from its first camera."""
    none = torch.zeros(2, dtype=torch.float64)
    pairs = zip(frame.others, builder.T_other_first, strict=False)
    return [View(target, T, none) for target, T in pairs if target is not None]


def check_rig(rig: Rig, camera: Camera) -> None:
    """Refuse a rig that is not one of this camera, first, and others apart from it.

    Raises:
        InputError: Its first camera is another one, or a further one has its centre.
    """
    if rig.cameras[0] != camera:
        raise InputError(f"rig: expected {camera} as its first camera, got {rig.cameras[0]}.")
    for other in range(1, len(rig)):
        rig.baseline(other)


def check_others(frame: Frame, builder: FrameBuilder) -> None:
    """Refuse a frame whose further images are not those of the rig; one that is None is missing, and allowed.

    Raises:
        InputError: There are too few or too many of them, or one is of another size.
    """
    rig = builder.rig
    if rig is None:
        return
    expected = len(rig) - 1
    if len(frame.others) != expected:
        raise InputError(
            f"others: expected the images of the rig's {expected} further cameras, got {len(frame.others)}."
        )
    for camera, image in zip(rig.cameras[1:], frame.others, strict=True):
        if image is None:
            continue
        shape = (camera.height, camera.width, 3)
        if getattr(image, "dtype", None) != "uint8" or image.shape != shape:
            got = f"{list(getattr(image, 'shape', []))} of {getattr(image, 'dtype', type(image).__name__)}"
            raise InputError(f"others: expected images of shape {list(shape)} of uint8, got {got}.")
