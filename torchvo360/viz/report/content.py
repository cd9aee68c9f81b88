"""What a page shows, as one JSON document: numbers as typed arrays in base64, everything else as words.

Positions, orientations and points are those of the run's files, in its world; matrices beside them lead into the axes
that are shown, which stand upright at the first camera and have the truth's metre where the truth is known.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from torchvo360.cameras import Camera, Equirectangular
from torchvo360.checks import InputError
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import quaternion_from_matrix, se3
from torchvo360.viz.deviation import deviation
from torchvo360.viz.plan import eye_level
from torchvo360.viz.report.axes import upright_axes
from torchvo360.viz.report.pictures import Picture
from torchvo360.viz.report.reasons import meaning
from torchvo360.vo import OdometryResult

MOST_POINTS = 60_000
"""More than this change the view little and weigh 16 bytes each."""

KINDS = {"float64": "f8", "float32": "f4", "int32": "i4", "uint16": "u2", "uint8": "u1"}


@dataclass(frozen=True, kw_only=True)
class Content:
    """All that a page tells of a run."""

    name: str
    camera: Camera
    result: OdometryResult
    """With at least one frame."""
    summary: dict[str, Any]
    """Figures, notes and versions, as in summary.json."""
    truth: Trajectory | None = None
    metric: bool = False
    """Whether the estimate's unit is the metre."""
    pictures: Sequence[Picture] = field(default_factory=list)
    defaults: dict[str, Any] = field(default_factory=dict)
    """The settings' usual values, so that the page can mark the others."""

    def __post_init__(self) -> None:
        if not self.result.frames:
            raise InputError("result: expected at least one frame, got none.")


def document(content: Content) -> dict[str, Any]:
    """Return the page's document, without its pictures.

    Raises:
        InputError: Truth is given, and fewer than three poses have a true one.
    """
    result, truth = content.result, content.truth
    estimate = result.trajectory
    found = None if truth is None else deviation(estimate, truth)
    S_drawn_world = torch.eye(4, dtype=torch.float64) if found is None else found.S_truth_world
    up = None
    if result.gravity is not None:
        up = -S_drawn_world[:3, :3] @ torch.tensor(result.gravity, dtype=torch.float64)
    R_view_drawn = upright_axes(estimate if truth is None else truth, up)
    start = S_drawn_world[:3, :3] @ estimate.positions[0] + S_drawn_world[:3, 3]
    T_view_drawn = se3(R_view_drawn, -R_view_drawn @ start)
    S_view_world = T_view_drawn @ S_drawn_world
    errors = None
    if found is not None:
        errors = {}
        for name, values in (("position_m", found.position_m), ("rotation_deg", found.rotation_deg)):
            column = np.full(len(estimate), np.nan)
            column[found.row.numpy()] = values.numpy()
            errors[name] = packed(column, "float32")
    return {
        "name": content.name,
        "unit": "m" if content.metric or truth is not None else "units",
        "camera": {
            "panorama": isinstance(content.camera, Equirectangular),
            "width": content.camera.width,
            "height": content.camera.height,
            "intrinsics": list(content.camera.intrinsics),
        },
        "view_world": S_view_world.flatten().tolist(),
        "frames": _frames(result),
        "points": _points(result, S_view_world),
        "loops": [[edge.i, edge.j] for edge in result.loops],
        "before_loops": packed(result.before_loops.positions.numpy(), "float32") if result.loops else None,
        "truth": None if truth is None else _true_path(truth, T_view_drawn, estimate),
        "errors": errors,
        "summary": {key: value for key, value in content.summary.items() if key != "settings"},
        "settings": _settings(content.summary.get("settings", {}), content.defaults),
    }


def packed(values: np.ndarray, kind: str) -> dict[str, str]:
    """Return an array for the page, little-endian, rows first."""
    data = np.ascontiguousarray(values, dtype="<" + KINDS[kind]).tobytes()
    return {"type": kind, "base64": base64.b64encode(data).decode("ascii")}


def _frames(result: OdometryResult) -> dict[str, Any]:
    frames, trajectory = result.frames, result.trajectory
    first_ns = frames[0].t_ns
    states = list(dict.fromkeys(str(frame.state) for frame in frames))
    reasons = list(dict.fromkeys(frame.reason for frame in frames))
    out: dict[str, Any] = {
        "first_seconds": first_ns / 1e9,
        "states": states,
        "reasons": [[reason, meaning(reason)] for reason in reasons],
        "state": packed(np.array([states.index(str(frame.state)) for frame in frames]), "uint8"),
        "reason": packed(np.array([reasons.index(frame.reason) for frame in frames]), "uint16"),
        "index": packed(np.array([frame.index for frame in frames]), "int32"),
        "seconds": packed(np.array([(frame.t_ns - first_ns) / 1e9 for frame in frames]), "float64"),
        "position": packed(trajectory.positions.numpy(), "float32"),
        "rotation": packed(quaternion_from_matrix(trajectory.T_world_cam[:, :3, :3]).numpy(), "float32"),
    }
    for name in ("residual", "inliers", "a", "b", "milliseconds"):
        out[name] = packed(np.array([getattr(frame, name) for frame in frames]), "float32")
    return out


def _points(result: OdometryResult, S_view_world: torch.Tensor) -> dict[str, Any]:
    cloud = result.points
    kept = torch.isfinite(cloud.xyz).all(-1).nonzero()[:, 0]
    if len(kept) > MOST_POINTS:  # evenly, from any order in which they may lie
        kept = kept[torch.randperm(len(kept), generator=torch.Generator().manual_seed(0))[:MOST_POINTS].sort().values]
    xyz = cloud.xyz[kept].double()
    shown = (xyz @ S_view_world[:3, :3].mT + S_view_world[:3, 3]).numpy()
    path = (result.trajectory.positions @ S_view_world[:3, :3].mT + S_view_world[:3, 3]).numpy()
    return {
        "total": len(cloud.xyz),
        "xyz": packed(xyz.numpy(), "float32"),
        "rgb": packed(cloud.rgb[kept].numpy(), "uint8"),
        "frame": packed(cloud.frame[kept].numpy(), "int32"),
        "eye_level": packed(eye_level(shown, path), "uint8"),
    }


def _true_path(truth: Trajectory, T_view_truth: torch.Tensor, estimate: Trajectory) -> dict[str, Any]:
    """Return the true positions while the run lasts, where they are shown."""
    during = (truth.t_ns >= estimate.t_ns[0]) & (truth.t_ns <= estimate.t_ns[-1])
    shown = truth.positions[during] @ T_view_truth[:3, :3].mT + T_view_truth[:3, 3]
    return {"shown": packed(shown.numpy(), "float32")}


def _settings(settings: dict[str, Any], defaults: dict[str, Any], prefix: str = "") -> list[list[Any]]:
    """Return every setting by its dotted name, its value in words, and whether it is the usual one."""
    rows: list[list[Any]] = []
    for key, value in settings.items():
        usual = defaults.get(key)
        if isinstance(value, dict):
            rows += _settings(value, usual if isinstance(usual, dict) else {}, f"{prefix}{key}.")
        else:
            rows.append([prefix + key, _word(value), not defaults or _word(value) == _word(usual)])
    return rows


def _word(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_word, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
