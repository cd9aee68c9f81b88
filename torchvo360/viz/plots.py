"""The trajectory as a picture: from above, over the map, and its height over time."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import InputError, check_shape
from torchvo360.data.registration import associate, similarity_between
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import se3_inverse
from torchvo360.viz.plan import Plan, level_with_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from torchvo360.vo import PointCloud

STATE_COLOURS = {
    "tracking": "#0072B2",
    "weak": "#E69F00",
    "lost": "#D55E00",
    "relocalised": "#009E73",
    "initialising": "#CC79A7",
}
"""Told apart in every common form of colour blindness. Source: Okabe and Ito, Color Universal Design."""

OTHER_COLOUR, TRUTH_COLOUR, MAP_COLOUR, INK, GRID = "#000000", "#B3B3B3", "#8C7B6B", "#333333", "#E6E6E6"

LEAST_HEIGHT_SHARE = 0.1
"""The height panel spans at least this share of the extent seen from above, so that noise does not fill it."""


@dataclass(frozen=True)
class View:
    """Axes of the picture, in the world that is drawn."""

    R_view_world: Float64[Tensor, "3 3"]
    """Rows: right on the page, up on the page (seen from above), height."""
    labels: tuple[str, str, str]

    def __call__(self, positions: Float64[Tensor, "N 3"]) -> np.ndarray:
        return (positions @ self.R_view_world.mT).numpy()


def plot_trajectory(
    path: str | Path,
    estimate: Trajectory,
    *,
    truth: Trajectory | None = None,
    points: "PointCloud | None" = None,
    states: Sequence[str] | None = None,
    title: str = "",
) -> None:
    """Draw a trajectory from above, over the map, and its height over time, as PNG or in the format of the suffix.

    Without truth the axes are those of the first camera, in the units of the estimate. With truth the estimate is drawn
    in the true world, after the similarity that fits it best, and the world's axis nearest to the cameras' mean upward
    direction is taken for height.

    Args:
        path: The file to write.
        estimate: Poses T_world_cam.
        truth: True poses, metres.
        points: The map in the world of the estimate; those at about the height of the path are drawn.
        states: One word a pose, which chooses its colour.
        title: Written above.

    Raises:
        ModuleNotFoundError: matplotlib is missing; the extra `viz` brings it.
        InputError: There are no poses, the number of states is another, or fewer than three poses have a true one.
        ShapeError: The points are not [N, 3], or have another number of colours.
    """
    if not len(estimate):
        raise InputError("estimate: expected at least one pose, got none.")
    if states is not None and len(states) != len(estimate):
        raise InputError(f"states: expected one for each of the {len(estimate)} poses, got {len(states)}.")
    if truth is None:
        T_drawn_world, view = se3_inverse(estimate.T_world_cam[0]), _first_camera_view()
    else:
        i_estimate, i_truth = associate(estimate, truth)
        T_drawn_world = similarity_between(estimate.T_world_cam[i_estimate], truth.T_world_cam[i_truth])
        view = _upright_view(truth)
    xyz = view((T_drawn_world @ estimate.T_world_cam)[:, :3, 3])
    plan = None
    if points is not None:
        check_shape("points.xyz", points.xyz, "N 3")
        check_shape("points.rgb", points.rgb, f"{len(points.xyz)} 3")
        p_drawn = points.xyz.double() @ T_drawn_world[:3, :3].mT + T_drawn_world[:3, 3]
        plan = level_with_path(view(p_drawn), points.rgb.numpy(), xyz)
    first_ns = estimate.t_ns[0]
    seconds = (estimate.t_ns - first_ns).numpy() / 1e9
    true_xyz = None if truth is None else view(truth.positions)

    seen = xyz if true_xyz is None else np.concatenate([xyz, true_xyz])
    page = _page(seen, plan, view, title)
    if plan is not None:
        halo = xyz if true_xyz is None else true_xyz
        page.above.plot(halo[:, 0], halo[:, 1], color="white", linewidth=4 if truth is None else 7, zorder=0.8)
    if truth is not None and true_xyz is not None:
        style = {"color": TRUTH_COLOUR, "linewidth": 4.5, "solid_capstyle": "round", "zorder": 1}
        page.above.plot(true_xyz[:, 0], true_xyz[:, 1], label="truth", **style)
        page.height.plot((truth.t_ns - first_ns).numpy() / 1e9, true_xyz[:, 2], **style)
    _draw_by_state(page.above, xyz[:, :2], states)
    _draw_by_state(page.height, np.stack([seconds, xyz[:, 2]], -1), states)
    for marker, size, row, name in (("o", 9, 0, "start"), ("s", 7, -1, "end")):
        style = {"color": "white", "markeredgecolor": INK, "markeredgewidth": 1.6, "markersize": size, "zorder": 9}
        page.above.plot(xyz[row, 0], xyz[row, 1], marker, label=name, **style)
    if plan is not None:
        page.above.plot([], [], "o", color=MAP_COLOUR, markersize=3, label="map at eye level")
    handles, labels = page.above.get_legend_handles_labels()
    page.legend.legend(handles, labels, loc="upper left", frameon=False, fontsize=10, labelcolor=INK, labelspacing=0.7)
    page.figure.savefig(path, dpi=150, facecolor="white")


def _first_camera_view() -> View:
    unit = "units of the first keyframe"
    R_view_world = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]], dtype=torch.float64)
    return View(R_view_world, (f"right ({unit})", f"forward ({unit})", "up (same units)"))


def _upright_view(truth: Trajectory) -> View:
    up = -truth.T_world_cam[:, :3, 1].mean(0)
    axis = int(up.abs().argmax())
    positive = bool(up[axis] > 0)
    # right x upwards on the page = height: seen from above and not mirrored
    order = [(axis + 1) % 3, (axis + 2) % 3, axis] if positive else [(axis + 2) % 3, (axis + 1) % 3, axis]
    R_view_world = torch.eye(3, dtype=torch.float64)[order]
    R_view_world[2] *= 1 if positive else -1
    names = ["xyz"[i] for i in order]
    return View(R_view_world, (f"{names[0]} (m)", f"{names[1]} (m)", f"{'' if positive else '−'}{names[2]} (m)"))


@dataclass(frozen=True)
class Page:
    """The empty picture."""

    figure: "Figure"
    above: "Axes"
    height: "Axes"
    legend: "Axes"


def _page(xyz: np.ndarray, plan: Plan | None, view: View, title: str) -> Page:
    """Lay out the panels: the height is beside the view from above where that is long upwards, else below it."""
    try:
        from matplotlib.figure import Figure  # not pyplot: no global state, no display needed
        from matplotlib.layout_engine import ConstrainedLayoutEngine
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("plots: expected matplotlib, which `pip install torchvo360[viz]` brings.") from error
    extent = np.ptp(xyz, axis=0)
    if plan is not None:
        extent[:2] = np.ptp(np.concatenate([xyz[:, :2], plan.box]), axis=0)
    figure = Figure(figsize=(9, 7), layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12))
    if extent[1] > 1.3 * extent[0]:
        grid = figure.add_gridspec(2, 2, width_ratios=[1, 1], height_ratios=[1, 1])
        panels = grid[:, 0], grid[0, 1], grid[1, 1]
    else:
        grid = figure.add_gridspec(2, 2, width_ratios=[4, 1], height_ratios=[2.8, 1])
        panels = grid[0, :], grid[1, 0], grid[1, 1]
    above, height, legend = (figure.add_subplot(panel) for panel in panels)
    legend.set_axis_off()
    for axes in (above, height):
        axes.grid(color=GRID, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(GRID)
        axes.tick_params(colors=INK, length=0, labelsize=9)
        axes.xaxis.label.set_color(INK)
        axes.yaxis.label.set_color(INK)
        axes.margins(0.06)
    above.set_aspect("equal", adjustable="datalim")
    if plan is not None:
        above.scatter(*plan.xy.T, s=plan.dot_area, c=plan.rgb, linewidths=0, zorder=0.6, rasterized=True)
        above.dataLim.set_points(plan.box)  # what is drawn later widens it, far points do not
    above.set(xlabel=view.labels[0], ylabel=view.labels[1])
    height.set(xlabel="time (s)", ylabel=view.labels[2])
    span = max(extent[2] * 1.12, LEAST_HEIGHT_SHARE * extent[:2].max(), 1e-9)
    middle = xyz[:, 2].min() + extent[2] / 2
    height.set_ylim(middle - span / 2, middle + span / 2)
    if title:
        figure.suptitle(title, fontsize=13, fontweight="bold", color=INK)
    return Page(figure, above, height, legend)


def _draw_by_state(axes: "Axes", points: np.ndarray, states: Sequence[str] | None) -> None:
    """Draw each segment in the colour of the state in which it ends, the rarer states on top."""
    from matplotlib.collections import LineCollection

    segments = np.stack([points[:-1], points[1:]], 1)
    words = np.full(len(points), "estimate", object) if states is None else np.array([str(s) for s in states], object)
    counts = {word: int((words == word).sum()) for word in dict.fromkeys(words)}
    for layer, word in enumerate(sorted(counts, key=lambda word: -counts[word])):
        colour = STATE_COLOURS["tracking"] if states is None else STATE_COLOURS.get(word, OTHER_COLOUR)
        label = word if states is None else f"{word} ({counts[word]})"
        lines = LineCollection(
            list(segments[words[1:] == word]),
            colors=colour,
            linewidths=1.8,
            capstyle="round",
            label=label,
            zorder=2 + layer,
        )
        axes.add_collection(lines)
    axes.autoscale_view(scaley=axes.get_autoscaley_on())
