"""Draw docs/walk.png: a frame of a walk with a 360-degree camera, and beneath it the map and the path, from above.

Run from the root of the repository, with the extra `viz` installed:

    python docs/make_picture.py richoh1_0_3.mp4 docs/walk.png

The video is examples/adaptive/dash/richoh1_0_3.mp4 of googlevr/vrview (Apache-2.0). Its first 10 s are the embedded
clip, torchvo360/data/clips/theta_walk.mp4, which will do for a try.
"""

import argparse
import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from PIL import Image

from torchvo360 import VisualOdometry
from torchvo360.data.images import open_images
from torchvo360.data.masks import parse_mask
from torchvo360.viz.plan import level_with_path
from torchvo360.viz.plots import INK, STATE_COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from torchvo360.vo import OdometryResult

LOWEST_DEG = -18
"""Below this latitude there is little but the hand that holds the camera."""

FRAME_SHOWN = 0.35
"""The panorama above the map, as a share of the walk."""

LATITUDES_DEG = (-38, 82)
"""Rows of it that are shown."""

WIDTH_IN, DPI, EDGE = 9.0, 135, 0.012
"""Edge: the margin, as a share of the width."""

BEYOND, ASIDE = 0.09, 0.15
"""Of the map: what is seen beyond the ends of the path and to its sides, as shares of its length."""


def main() -> None:
    """Run the odometry on the video and draw what it found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("video", help="the walk")
    parser.add_argument("output", type=Path, help="the picture, a PNG file")
    arguments = parser.parse_args()

    sequence = open_images(arguments.video, camera_fit="stretch")
    odometry = VisualOdometry(sequence.camera, mask=parse_mask(f"below:{LOWEST_DEG}", sequence.camera))
    with torch.inference_mode():
        for frame in sequence:
            odometry.step(frame)
        result = odometry.finish()
    shown = int(FRAME_SHOWN * len(result.frames))
    frame = next(iter(open_images(arguments.video, camera_fit="stretch", start=shown)))
    if frame.image is None:
        raise SystemExit(f"frame {shown} of {arguments.video} cannot be read")
    draw(arguments.output, frame.image, shown, result)


def draw(output: Path, image: np.ndarray, shown: int, result: "OdometryResult") -> None:
    """Lay out the two pictures and their captions, and write them with a palette, as a small file."""
    inner = 1 - 2 * EDGE
    panorama_in = inner * WIDTH_IN * (LATITUDES_DEG[1] - LATITUDES_DEG[0]) / 360
    map_in = inner * WIDTH_IN * 2 * ASIDE / (1 + 2 * BEYOND)
    edge_in, caption_in = EDGE * WIDTH_IN, 0.3
    height_in = panorama_in + map_in + 2 * caption_in + 2 * edge_in
    figure = Figure(figsize=(WIDTH_IN, height_in), facecolor="white")

    bottom = 1 - (edge_in + panorama_in) / height_in
    panorama = figure.add_axes((EDGE, bottom, inner, panorama_in / height_in))
    draw_panorama(panorama, image)
    credit = "video: googlevr/vrview, Apache-2.0"
    caption(figure, bottom - caption_in / 2 / height_in, f"frame {shown} of {len(result.frames)}", credit)

    bottom = edge_in / height_in
    above = figure.add_axes((EDGE, bottom + caption_in / height_in, inner, map_in / height_in))
    draw_map(above, result, shown)
    made = f"{len(result.points.xyz):,} points from {result.keyframes} keyframes; those at eye level are drawn"
    caption(figure, bottom + caption_in / 2 / height_in, "path and map, seen from above", made)

    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    with Image.open(drawn) as picture:
        rgb = picture.convert("RGB")
        palette = rgb.quantize(method=Image.Quantize.MAXCOVERAGE)  # the other methods miss pure white
        rgb.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(output, optimize=True)


def caption(figure: Figure, y: float, left: str, right: str) -> None:
    """Write a line beneath a picture: what it is, and a remark."""
    figure.text(EDGE, y, left, fontsize=10.5, color=INK, va="center", fontweight="bold")
    figure.text(1 - EDGE, y, right, fontsize=9, color="#666666", va="center", ha="right")


def draw_panorama(axes: "Axes", image: np.ndarray) -> None:
    """Show the frame, under a veil where it is not used."""
    axes.imshow(image, extent=(-180, 180, -90, 90), aspect="auto", interpolation="bicubic")
    axes.axhspan(-90, LOWEST_DEG, color="white", alpha=0.6, linewidth=0)
    axes.text(-178, LOWEST_DEG - 1.5, "masked: not used", fontsize=8.5, color=INK, va="top")
    axes.set_ylim(*LATITUDES_DEG)
    axes.set_axis_off()


def draw_map(axes: "Axes", result: "OdometryResult", shown: int) -> None:
    """Draw points and path, the way from the first to the last position to the right."""
    right = result.trajectory.positions[-1] - result.trajectory.positions[0]
    right[1] = 0  # y, downwards
    length = float(right.norm())
    right = right / length
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    R_page_world = torch.stack([right, torch.linalg.cross(up, right), up])
    path = (result.trajectory.positions @ R_page_world.mT).numpy()
    plan = level_with_path((result.points.xyz.double() @ R_page_world.mT).numpy(), result.points.rgb.numpy(), path)
    if plan is not None:
        axes.scatter(*plan.xy.T, s=1.5, c=plan.rgb, linewidths=0)
    halo = [withStroke(linewidth=5, foreground="white")]
    axes.plot(*path[:, :2].T, color=STATE_COLOURS["tracking"], linewidth=2.4, path_effects=halo)
    outline = {"color": "white", "markeredgecolor": INK, "markeredgewidth": 1.6}
    for marker, size, row, name in (("o", 9, 0, "start"), ("D", 6, shown, f"frame {shown}"), ("s", 7, -1, "end")):
        axes.plot(*path[row, :2], marker, markersize=size, **outline)
        style = {"fontsize": 9.5, "color": INK, "ha": "center", "va": "top", "path_effects": halo}
        axes.annotate(name, (path[row, 0], path[row, 1]), (0, -8), textcoords="offset points", **style)
    start, middle = path[0, 0], (path[:, 1].min() + path[:, 1].max()) / 2
    axes.set_xlim(start - BEYOND * length, start + (1 + BEYOND) * length)
    axes.set_ylim(middle - ASIDE * length, middle + ASIDE * length)
    axes.set_axis_off()


if __name__ == "__main__":
    main()
