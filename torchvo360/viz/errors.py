"""The errors against the truth as a picture: of position and of rotation over time, with the states behind them."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchvo360.checks import InputError
from torchvo360.data.trajectory import Trajectory
from torchvo360.viz.deviation import deviation
from torchvo360.viz.plots import GRID, INK, OTHER_COLOUR, STATE_COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

USUAL = "tracking"
"""The state that is not marked: nearly every frame has it."""


def plot_errors(
    path: str | Path,
    estimate: Trajectory,
    truth: Trajectory,
    *,
    states: Sequence[str] | None = None,
    title: str = "",
) -> None:
    """Draw the errors of position and rotation over time, as PNG or in the format of the suffix.

    Args:
        path: The file to write.
        estimate: Poses T_world_cam.
        truth: True poses, metres.
        states: One word a pose: stretches of the states other than tracking are tinted in their colours.
        title: Written above.

    Raises:
        ModuleNotFoundError: matplotlib is missing; the extra `viz` brings it.
        InputError: The number of states is another, or fewer than three poses have a true one.
    """
    if states is not None and len(states) != len(estimate):
        raise InputError(f"states: expected one for each of the {len(estimate)} poses, got {len(states)}.")
    try:
        from matplotlib.figure import Figure  # not pyplot: no global state, no display needed
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("plots: expected matplotlib, which `pip install torchvo360[viz]` brings.") from error
    found = deviation(estimate, truth)
    seconds = (estimate.t_ns - estimate.t_ns[0]).numpy() / 1e9
    figure = Figure(figsize=(9, 5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for axes, values, what in (
        (above, found.position_m.numpy(), "position error (m)"),
        (below, found.rotation_deg.numpy(), "rotation error (deg)"),
    ):
        _tint(axes, seconds, states)
        at = seconds[found.row.numpy()]
        axes.plot(at, values, color=INK, linewidth=1.2, marker="." if len(at) < 100 else "", markersize=3)
        median = float(np.median(values))
        axes.axhline(median, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
        axes.set_ylabel(what)
        axes.set_title(f"median {median:.3g}, greatest {values.max():.3g}", loc="right", fontsize=9, color=INK)
        axes.set_ylim(bottom=0)
        axes.grid(color=GRID, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(GRID)
        axes.tick_params(colors=INK, length=0, labelsize=9)
    below.set_xlabel("time (s)")
    handles, labels = above.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, labelcolor=INK)
    if title:
        figure.suptitle(title, fontsize=13, fontweight="bold", color=INK)
    figure.savefig(path, dpi=150, facecolor="white")


def _tint(axes: "Axes", seconds: np.ndarray, states: Sequence[str] | None) -> None:
    """Tint the stretches of every unusual state, from half a frame before them to half a frame after."""
    if states is None or len(seconds) < 2:
        return
    half = float(np.median(np.diff(seconds))) / 2
    counts = {word: sum(state == word for state in states) for word in dict.fromkeys(map(str, states))}
    named: set[str] = set()
    for word, group in groupby(enumerate(map(str, states)), key=lambda item: item[1]):
        rows = [row for row, _ in group]
        if word == USUAL:
            continue
        label = None if word in named else f"{word} ({counts[word]})"
        named.add(word)
        colour = STATE_COLOURS.get(word, OTHER_COLOUR)
        axes.axvspan(seconds[rows[0]] - half, seconds[rows[-1]] + half, color=colour, alpha=0.3, lw=0, label=label)
