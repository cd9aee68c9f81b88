"""What a run saw of its surroundings, as rays in its world: the points of its map, or dense ranges of its keyframes."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.checks import InputError
from torchvo360.cli.run_folder import read_settings
from torchvo360.data import Frame
from torchvo360.export.recorded import NOT_TRUSTED, Recorded, read_recorded
from torchvo360.learn.plugin import checked_ranges
from torchvo360.mapping import Rays, rays_of_depth
from torchvo360.mapping.rays import join_rays
from torchvo360.opening import open_input
from torchvo360.runner import open_depth
from torchvo360.settings import SHIPPED, DepthConfig

MOST_LOOKS, ROWS = 100, 100
"""Keyframes whose dense ranges are used, and about how many rows of each unless the user says: 2 million rays, of which
a map takes some 15 s and 400 MB."""

MOST_SIGMA = 0.15
"""Relative standard deviation beyond which a network's range is not used."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A run as a map's source."""

    rays: Rays
    T_world_cam: Float64[Tensor, "P 4 4"]
    """Poses of the frames that were tracked, in order."""
    up: Float64[Tensor, "3"] | None
    """Against gravity, where it is known."""
    metric: bool
    """Whether the unit is the metre."""


def read_surroundings(folder: str | Path, source: str, stride: int | None, metric: bool | None) -> Surroundings:
    """Read the folder of a finished run.

    Args:
        folder: The run's.
        source: points, sensor or learned.
        stride: Use every n-th row and column of dense ranges; None leaves about a hundred rows.
        metric: Whether the run's unit is the metre, if the caller knows better.

    Raises:
        InputError: It is not one, it has no map, or the source does not go with it.
    """
    known = read_recorded(folder)
    if not len(known.xyz):
        raise InputError("run: expected a run with a map, got one without points.")
    posed = known.pose_of()
    sure = [
        posed[index]
        for index, state in zip(known.index.tolist(), known.state, strict=True)
        if index in posed and state not in NOT_TRUSTED
    ]
    hosts = set(known.host.tolist())
    if not sure or not hosts <= posed.keys():
        raise InputError(f"run: expected poses of all keyframes, got none for some in {folder}.")
    metric = _is_metric(folder) if metric is None else metric
    if source == "points":
        rows = {index: row for row, index in enumerate(sorted(hosts))}
        centres = torch.stack([posed[index][:3, 3] for index in sorted(hosts)])
        scan = torch.tensor([rows[index] for index in known.host.tolist()])
        rays = Rays.of(centres[scan], known.xyz.double(), scan)
    elif not metric:
        raise InputError(f"depth: expected points for a run in a unit of its own, got {source}, which is in metres.")
    else:
        rays = _dense(folder, known, source, stride)
    up = None if known.gravity is None else -torch.tensor(known.gravity, dtype=torch.float64)
    return Surroundings(rays, torch.stack(sure), up, metric)


def _is_metric(folder: str | Path) -> bool:
    """Return whether a run's unit is the metre, as its summary says."""
    summary: dict[str, Any] = json.loads((Path(folder).expanduser() / "summary.json").read_text(encoding="utf-8"))
    return bool(summary.get("metric"))


def _dense(folder: str | Path, known: Recorded, source: str, stride: int | None) -> Rays:
    """Return the ranges of the keyframes, from the run's input."""
    config = read_settings(folder)
    try:
        opened = open_input(config)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None
    posed, hosts = known.pose_of(), sorted(set(known.host.tolist()))
    wanted = set(hosts[:: -(-len(hosts) // MOST_LOOKS)])
    camera, parts = known.camera_of(opened.sequence.camera), []
    stride = max(1, camera.height // ROWS) if stride is None else stride
    network = None
    if source == "learned":
        named = config.depth.checkpoint is not None or config.depth._target_ is not None
        network = open_depth(config.depth if named else DepthConfig(checkpoint=SHIPPED))
    for frame in opened.sequence:
        if frame.index in wanted and frame.image is not None:
            depth = _sensed(frame) if network is None else _learned(network, frame)
            rays = rays_of_depth(camera, depth, posed[frame.index], mask=opened.mask, stride=stride)
            parts.append(rays)
        if frame.index >= max(wanted):
            break
    if not parts:
        raise InputError(f"{folder}: expected keyframes that can be read again, got none.")
    return join_rays(parts)


def _sensed(frame: Frame) -> Tensor:
    if frame.depth is None:
        raise InputError("depth: expected points or learned for an input without a depth sensor, got sensor.")
    return torch.from_numpy(frame.depth)


def _learned(network: torch.nn.Module, frame: Frame) -> Tensor:
    """Return a network's ranges, 0 where it is not sure."""
    image = torch.from_numpy(frame.image).permute(2, 0, 1)[None].float() / 255
    with torch.inference_mode():
        rho, variance = checked_ranges(network, image)
    return torch.where(variance.sqrt() < MOST_SIGMA * rho, 1 / rho, 0.0)[0].clone()
