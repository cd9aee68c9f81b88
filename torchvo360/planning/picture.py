"""A plan as a picture: obstacles, what is free and what was not seen, clearance, the way and its ends."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from torchvo360.mapping import FREE, OCCUPIED, OccupancyMap
from torchvo360.planning.costs import Clearance
from torchvo360.planning.plan import Plan

OBSTACLE, UNSEEN, CLEAR, NEAR, TIGHT = "#222222", "#D4D4D4", "#FFFFFF", "#F3D9A4", "#E8A33D"
WAY, CAMERA, INK = "#0072B2", "#8C7B6B", "#333333"
"""Told apart in every common form of colour blindness. Source: Okabe and Ito, Color Universal Design."""

BEYOND = "#F2F2F2"
"""What lies outside the map."""

BORDER_SHARE = 0.12
"""Of the map's size that is shown around it where start or goal lies outside; a far one is drawn at its edge."""

BAR_SHARE = 0.25
"""Greatest share of the width that the scale bar takes."""


def draw_plan(
    path: str | Path,
    occupancy: OccupancyMap,
    clearance: Clearance,
    plan: Plan,
    *,
    ends: tuple[tuple[float, float], tuple[float, float]],
    camera_path: Float64[Tensor, "P 2"] | None = None,
    unit: str = "m",
) -> None:
    """Draw a plan on its map, as PNG or in the format of the suffix.

    Args:
        path: The file to write.
        occupancy: The map.
        clearance: How the robot sees it.
        plan: The way, or why there is none, which becomes the title.
        ends: Start and goal.
        camera_path: Where the camera went, in the map's frame.
        unit: Of lengths.

    Raises:
        ModuleNotFoundError: matplotlib is missing; the extra `viz` brings it.
    """
    try:
        from matplotlib.colors import to_rgb
        from matplotlib.figure import Figure  # not pyplot: no global state, no display needed
        from matplotlib.patches import Patch
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("plots: expected matplotlib, which `pip install torchvo360[viz]` brings.") from error
    x0, x1, y0, y1 = occupancy.extent
    aspect = np.clip((y1 - y0) / (x1 - x0), 0.35, 1.8)
    figure = Figure(figsize=(8.5, 1.6 + 6.5 * aspect), layout="constrained")
    axes = figure.add_subplot()
    image = _coloured(occupancy, clearance, {name: to_rgb(name) for name in (OBSTACLE, UNSEEN, CLEAR, NEAR, TIGHT)})
    axes.imshow(image, origin="lower", extent=(x0, x1, y0, y1), interpolation="nearest")
    if camera_path is not None:
        axes.plot(*camera_path.numpy().T, color=CAMERA, linewidth=1.4, linestyle=(0, (2, 2)), label="camera")
    if plan.found:
        axes.plot(*plan.xy.numpy().T, color=WAY, linewidth=2.4, solid_capstyle="round", label="way")
    elif plan.nearest is not None:
        axes.plot(*plan.nearest, "x", color=WAY, markersize=11, markeredgewidth=2.4, label="reached")
    border = BORDER_SHARE * max(x1 - x0, y1 - y0) * any(occupancy.cell_of(place) is None for place in ends)
    low, high = (x0 - border, y0 - border), (x1 + border, y1 + border)
    for name, marker, size, place in (("start", "o", 10, ends[0]), ("goal", "s", 9, ends[1])):
        style = {"color": "white", "markeredgecolor": INK, "markeredgewidth": 1.8, "markersize": size, "zorder": 5}
        axes.plot(*np.clip(place, low, high), marker, label=name, linestyle="none", clip_on=False, **style)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_facecolor(BEYOND)
    axes.set(xlabel=f"x, right ({unit})", ylabel=f"y, forward ({unit})", aspect="equal")
    axes.tick_params(colors=INK, labelsize=9)
    axes.spines[:].set_color(UNSEEN)
    _draw_scale_bar(axes, unit)
    areas = (("obstacle", OBSTACLE), ("too near", TIGHT), ("near", NEAR), ("free", CLEAR), ("not seen", UNSEEN))
    handles = [Patch(facecolor=colour, edgecolor=INK, linewidth=0.5, label=name) for name, colour in areas]
    handles += axes.get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9, labelcolor=INK)
    clear = f"{plan.clearance:.2g} {unit} clear" if np.isfinite(plan.clearance) else "no obstacle"
    title = f"{plan.length:.3g} {unit}, {clear}" if plan.found else plan.message
    axes.set_title(title, fontsize=11 if plan.found else 9, color=INK, wrap=True)
    figure.savefig(path, dpi=140, facecolor="white")


def _coloured(
    occupancy: OccupancyMap, clearance: Clearance, colours: dict[str, tuple[float, float, float]]
) -> Float64[np.ndarray, "H W 3"]:
    """Return the map's colours; where the way is dearer for being near, in between near's and the cell's own."""
    states = occupancy.states.numpy()
    image = np.empty((*states.shape, 3))
    image[:] = colours[UNSEEN]
    image[states == FREE] = colours[CLEAR]
    fits = np.isfinite(clearance.weight)
    dearest = clearance.weight[fits].max(initial=1.0)
    share = np.where(fits, (clearance.weight - 1) / max(dearest - 1, 1e-9), 0.0) * (states == FREE)
    image += share[..., None] * (np.array(colours[NEAR]) - image)
    image[~fits & (states == FREE)] = colours[TIGHT]
    image[states == OCCUPIED] = colours[OBSTACLE]
    return image


def _draw_scale_bar(axes, unit: str) -> None:
    """Draw a bar of a round length, 1, 2 or 5 times a power of ten, at the lower left."""
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    longest = BAR_SHARE * (right - left)
    power = 10 ** np.floor(np.log10(longest))
    length = next(step * power for step in (5, 2, 1) if step * power <= longest)
    told = "unit" if (length, unit) == (1, "units") else unit
    x, y = left + 0.04 * (right - left), bottom + 0.05 * (top - bottom)
    axes.plot([x, x + length], [y, y], color="white", linewidth=6, solid_capstyle="butt")
    axes.plot([x, x + length], [y, y], color=INK, linewidth=3, solid_capstyle="butt")
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}
    axes.text(x + length / 2, y + 0.015 * (top - bottom), f"{length:g} {told}", ha="center", va="bottom", fontsize=9,
              color=INK, bbox=box)  # fmt: skip
