"""Fresh points of a keyframe: pixels spread evenly over the sphere, with a sensor's ranges or traced into others."""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.backends.numba.pictures import select_pixels
from torchvo360.depth import guess_around
from torchvo360.image import select_about
from torchvo360.vo.config import OdometryConfig
from torchvo360.vo.frame import FrameBuilder, PyramidFrame
from torchvo360.vo.keyframes.candidates import Candidates
from torchvo360.vo.start.stereo import stereo_views
from torchvo360.window import View, Window, WindowPoints, make_points, trace


class Fresh(NamedTuple):
    """What became of the pixels chosen."""

    points: WindowPoints
    """Those whose range was found: points from now on."""
    candidates: Candidates | None
    """The others, which the next frames search for; None where there is nothing to guess their ranges by."""


def fresh_points(
    window: Window,
    place: int,
    others: list[int],
    frame: PyramidFrame,
    builder: FrameBuilder,
    config: OdometryConfig,
    *,
    metric: bool = False,
) -> Fresh:
    """Choose pixels of a keyframe, and find their ranges.

    Where a depth sensor knows them they are taken from it, as a prior that the window weighs with the images. The
    others are traced into other keyframes, and into a rig's images of the same moment.

    Args:
        window: The window.
        place: The keyframe's place in it.
        others: Places of those that are searched; the first one's great circles are walked along.
        frame: The keyframe's frame.
        builder: Of the frames.
        config: Settings.
        metric: Whether the window's unit is the metre, which a sensor's ranges need.
    """
    camera, strength = builder.cameras[0], builder.strength(frame)
    pixel = select_about(
        strength,
        builder.usable(frame),
        camera,
        config.map.points,
        minimum=config.map.min_gradient,
        select=select_pixels,
    )
    start = strength.new_ones(len(pixel))
    points = make_points(frame.targets[0], pixel, builder.rays(pixel), start, config.window, place)
    points = points.take((points.weight.sum(1) > 0).nonzero()[:, 0])
    points, measured = _split(points, frame, builder, config) if metric else (points, points.take(points.host[:0]))
    views, same_time = [view_of(window, place, other) for other in others], stereo_views(frame, builder)
    traced = trace(points, frame.targets[0], [*views, *same_time], config.trace)
    if same_time:
        # Along a rig's baseline some are found that the motion's own curves cannot tell apart.
        again = trace(points, frame.targets[0], [*same_time, *views], config.trace)
        rho = torch.where(traced.found, traced.rho, again.rho)
        traced = traced._replace(rho=rho, found=traced.found | again.found)
    known = window.refine_points(replace(points, rho=traced.rho).take(traced.found.nonzero()[:, 0]))
    known = known.take((known.inliers >= 1).nonzero()[:, 0])
    waiting = points.take(torch.isin(points.pixel, known.pixel, invert=True).nonzero()[:, 0])
    known = known.joined(window.refine_points(measured))
    return Fresh(known, _candidates(waiting, known, strength, frame, builder))


def _split(
    points: WindowPoints, frame: PyramidFrame, builder: FrameBuilder, config: OdometryConfig
) -> tuple[WindowPoints, WindowPoints]:
    """Return the points whose ranges a sensor does not know, and those that it knows, at these ranges."""
    rho, variance = builder.sensed(frame, points.pixel)
    known = variance < config.map.max_relative_variance * rho.square()
    information = config.track.noise**2 / variance
    sensed = replace(points, rho=rho, rho_prior=rho.clone(), information=information)
    return points.take((~known).nonzero()[:, 0]), sensed.take(known.nonzero()[:, 0])


def _candidates(
    waiting: WindowPoints, known: WindowPoints, strength: Tensor, frame: PyramidFrame, builder: FrameBuilder
) -> Candidates | None:
    if len(waiting) == 0 or len(known) == 0:
        return None
    ray = builder.rays(waiting.pixel)
    # As far as the points known lie from one another.
    spread = math.sqrt(4 * math.pi / (len(waiting) + len(known)))
    guess = guess_around(ray, builder.rays(known.pixel), known.rho, spread)
    return Candidates(frame, waiting.pixel, ray, strength.flatten()[waiting.pixel], guess)


def view_of(window: Window, host: int, other: int) -> View:
    """Return what one keyframe of a window sees, as another's points are searched in it."""
    frames = window.frames
    T = frames[other].T_cam_world @ lie.se3_inverse(frames[host].T_cam_world)
    a = frames[other].affine[0] - frames[host].affine[0]
    b = frames[other].affine[1] - a.exp() * frames[host].affine[1]
    return View(frames[other].target, T, torch.stack([a, b]))
