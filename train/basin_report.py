"""What a measurement of basins says: figures, a table as CSV and Markdown, and a plot."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from torchvo360.files import atomic_path, write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SAME, OTHER = "same", "other"
"""The light of the two views."""
ROTATION, TRANSLATION, BOTH = "rotation", "translation", "both"
"""What the starts are displaced by."""
INTENSITY, SPREAD_COLOUR, FEATURES = "intensity", "spread colour", "features"
"""The methods; intensity's settings are written after its name."""
ALL = "all"
"""Worlds of every kind."""

TITLES = {
    ROTATION: "rotation, deg (2 cm besides)",
    TRANSLATION: "translation, m (2 deg besides)",
    BOTH: "rotation, deg (2 cm for each degree besides)",
}
COLOURS = {INTENSITY: "#D55E00", SPREAD_COLOUR: "#E69F00", FEATURES: "#0072B2"}
"""Told apart in every common form of colour blindness. Source: Okabe and Ito, Color Universal Design."""

MOST = 0.8
"""The share of pairs up to which a start is within the basin."""


@dataclass(frozen=True)
class Row:
    """One point of a curve."""

    method: str
    light: str
    scan: str
    size: float
    """Error of the start: degrees, or metres where translation alone is scanned."""
    kind: str
    """Of the worlds, or all."""
    converged: float
    """Share of the pairs."""
    rotation_deg: float
    """Median error of the converged ones."""
    range_share: float
    """Their median error of translation over the scene's median range."""


@dataclass(frozen=True)
class Comparison:
    """Features against intensity at its best, on one scan of one kind of worlds."""

    scan: str
    kind: str
    reach: float
    """Error of the start up to which 80 % of the pairs converge by intensity."""
    reach_is_end: bool
    """Whether that is the end of the scan, so that the reach may be larger."""
    features_twice: float
    """Share that converge by features from twice that error, or from the end of the scan."""
    features_twice_other: float
    """The same under another light."""
    lost_intensity: float
    """Mean share of pairs that another light costs, over the starts from which 80 % converge under the same."""
    lost_features: float
    """The same of features, from the same starts."""


def curve(rows: Iterable[Row], method: str, light: str, scan: str, kind: str = ALL) -> dict[float, float]:
    """Return the share of converged pairs by the error of the start."""
    return {
        row.size: row.converged
        for row in rows
        if (row.method, row.light, row.scan, row.kind) == (method, light, scan, kind)
    }


def at(points: dict[float, float], size: float) -> float:
    """Return a curve's share, linear between its points; before the first and beyond the last it is theirs."""
    sizes = sorted(points)
    if size >= sizes[-1]:
        return points[sizes[-1]]
    upper = next(each for each in sizes if each >= size)
    if upper == sizes[0]:
        return points[upper]
    lower = sizes[sizes.index(upper) - 1]
    share = (size - lower) / (upper - lower)
    return points[lower] + share * (points[upper] - points[lower])


def reach(points: dict[float, float], most: float = MOST) -> float:
    """Return the error of the start at which the share first falls to `most`; 0 where it never is above."""
    before = 0.0
    for size in sorted(points):
        if points[size] < most:
            if before == 0.0:
                return 0.0
            return before + (size - before) * (points[before] - most) / (points[before] - points[size])
        before = size
    return before


def intensity_curve(rows: Sequence[Row], light: str, scan: str, kind: str = ALL) -> dict[float, float]:
    """Return, for every error of the start, the share by the setting of intensity that is best there."""
    names = sorted({row.method for row in rows if row.method.startswith(INTENSITY)})
    curves = [curve(rows, name, light, scan, kind) for name in names]
    sizes = sorted(size for size in set().union(*curves))
    return {size: max(points.get(size, 0.0) for points in curves) for size in sizes}


def compare(rows: Sequence[Row], scan: str, kind: str = ALL) -> Comparison:
    """Compare features with intensity, which takes at every point the setting that is best there."""
    intensity = {light: intensity_curve(rows, light, scan, kind) for light in (SAME, OTHER)}
    features = {light: curve(rows, FEATURES, light, scan, kind) for light in (SAME, OTHER)}
    limit = reach(intensity[SAME])
    starts = [size for size in intensity[SAME] if size <= limit]

    def lost(curves: dict[str, dict[float, float]]) -> float:
        return sum(curves[SAME].get(size, 0.0) - curves[OTHER].get(size, 0.0) for size in starts) / max(len(starts), 1)

    return Comparison(
        scan=scan,
        kind=kind,
        reach=limit,
        reach_is_end=limit == max(intensity[SAME]),
        features_twice=at(features[SAME], 2 * limit),
        features_twice_other=at(features[OTHER], 2 * limit),
        lost_intensity=lost(intensity),
        lost_features=lost(features),
    )


def figures_of(rows: Sequence[Row]) -> dict[str, float]:
    """Return the comparisons over all worlds as named figures, for a checkpoint."""
    figures: dict[str, float] = {}
    for scan in _scans(rows):
        each = compare(rows, scan)
        figures[f"{scan}_reach_of_intensity_{'m' if scan == TRANSLATION else 'deg'}"] = each.reach
        figures[f"{scan}_features_at_twice"] = each.features_twice
        figures[f"{scan}_features_at_twice_in_another_light"] = each.features_twice_other
        figures[f"{scan}_lost_by_intensity"] = each.lost_intensity
        figures[f"{scan}_lost_by_features"] = each.lost_features
    return figures


def report_basin(folder: Path, rows: Sequence[Row]) -> list[str]:
    """Write basin.csv, basin.md and basin.png into a folder, and return the comparison as lines."""
    scans = _scans(rows)
    kinds = list(dict.fromkeys(row.kind for row in rows))
    comparisons = [compare(rows, scan, kind) for scan in scans for kind in kinds]
    text = io.StringIO()
    writer = csv.DictWriter(text, [each.name for each in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _short(value) for name, value in asdict(row).items()} for row in rows)
    write_atomically(folder / "basin.csv", text.getvalue())
    table = [*_comparison_table(comparisons), "", *(line for scan in scans for line in (*_table(rows, scan), ""))]
    write_atomically(folder / "basin.md", "\n".join(table))
    with atomic_path(folder / "basin.png") as path:
        plot_basin(path, rows)
    return _comparison_table(comparisons)


def plot_basin(path: Path, rows: Sequence[Row]) -> None:
    """Draw the share of converged pairs against the error of the start: one panel for each scan, dashed in other light.

    Raises:
        InputError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    scans = _scans(rows)
    figure = Figure(figsize=(4.6 * len(scans), 4.2), layout="constrained")
    for axes, scan in zip(figure.subplots(1, len(scans), squeeze=False, sharey=True)[0], scans, strict=True):
        _draw(axes, rows, scan)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=130)


def _scans(rows: Sequence[Row]) -> list[str]:
    """Return what was scanned, in the order of the titles."""
    return [scan for scan in TITLES if any(row.scan == scan for row in rows)]


def _draw(axes: "Axes", rows: Sequence[Row], scan: str) -> None:
    for light, style in ((SAME, "-"), (OTHER, "--")):
        for name in COLOURS:
            points = intensity_curve(rows, light, scan) if name == INTENSITY else curve(rows, name, light, scan)
            label = f"{name}, {'same light' if light == SAME else 'another light'}"
            axes.plot(list(points), list(points.values()), style, color=COLOURS[name], marker=".", label=label)
    axes.axhline(MOST, color="#B3B3B3", linewidth=0.8)
    axes.set(xlabel=f"error of the start:\n{TITLES[scan]}", ylim=(-0.02, 1.02), xlim=(0, None))
    if axes.get_subplotspec().is_first_col():  # pyright: ignore[reportOptionalMemberAccess]
        axes.set_ylabel("share of pairs that converge")
    axes.spines[["top", "right"]].set_visible(False)


def _comparison_table(comparisons: Sequence[Comparison]) -> list[str]:
    lines = [
        "| start | worlds | intensity: 80 % up to | features at twice that | in another light | "
        "lost by another light: intensity | features |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for each in comparisons:
        unit = "m" if each.scan == TRANSLATION else "deg"
        limit = f"{'at least ' if each.reach_is_end else ''}{each.reach:.3g} {unit}"
        shares = (each.features_twice, each.features_twice_other, each.lost_intensity, each.lost_features)
        cells = [each.scan, each.kind, limit, *(f"{share:.0%}" for share in shares)]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _table(rows: Sequence[Row], scan: str) -> list[str]:
    """Return the shares over all worlds, a line for each method and light."""
    sizes = sorted({row.size for row in rows if row.scan == scan})
    lines = [f"| {TITLES[scan]} | light | " + " | ".join(f"{size:g}" for size in sizes) + " |"]
    lines.append("| --- | --- | " + " | ".join("---:" for _ in sizes) + " |")
    for method in dict.fromkeys(row.method for row in rows):
        for light in (SAME, OTHER):
            points = curve(rows, method, light, scan)
            cells = (f"{points[size]:.2f}" if size in points else "" for size in sizes)
            lines.append(f"| {method} | {light} | " + " | ".join(cells) + " |")
    return lines


def _short(value: object) -> object:
    return f"{value:.4g}" if isinstance(value, float) else value
