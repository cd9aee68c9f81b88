"""Runs without an error: a rendered world's own poses and ranges, in memory or as a run's folder."""

import csv
import json
from dataclasses import asdict
from pathlib import Path

import torch
import yaml

from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.export import write_ply, write_tum
from torchvo360.export.recorded import Recorded
from torchvo360.export.tracks import grey
from torchvo360.outputs import COLUMNS

HOSTS = (0, 10, 19)
FRAMES = 20


def sequence_of(camera: str = "equirectangular", **settings) -> SyntheticSequence:
    width, height = (256, 128) if camera == "equirectangular" else (200, 150)
    return SyntheticSequence(SyntheticConfig(camera=camera, width=width, height=height, frames=FRAMES, **settings))


def exact_run(sequence: SyntheticSequence, *, count: int = 300, state: list[str] | None = None, **known) -> Recorded:
    """Return true poses and, for each keyframe, points of true range at some of its pixels with contrast."""
    camera, generator = sequence.camera, torch.Generator().manual_seed(0)
    parts = []
    for host in HOSTS:
        colour, reach = sequence.render(host)
        image = grey((colour.permute(1, 2, 0) * 255).to(torch.uint8).numpy())[0, 0]
        contrast = (image.roll(-1, 0) - image.roll(1, 0)).abs() + (image.roll(-1, 1) - image.roll(1, 1)).abs()
        contrast[~reach.isfinite()] = 0
        contrast[:8] = contrast[-8:] = 0
        if not camera.wraps:
            contrast[:, :8] = contrast[:, -8:] = 0
        chance = contrast.flatten() * torch.rand(contrast.numel(), generator=generator)
        pixel = chance.topk(count).indices
        rays = camera.ray(camera.pixel_grid(dtype=torch.float64)).flatten(0, 1)[pixel]
        T_world_cam = sequence.pose(host)
        xyz = (rays * reach.flatten()[pixel, None]) @ T_world_cam[:3, :3].mT + T_world_cam[:3, 3]
        rgb = (colour.flatten(1).T[pixel] * 255).to(torch.uint8)
        parts.append((xyz.float(), rgb, torch.full((count,), host, dtype=torch.int32)))
    xyz, rgb, host = (torch.cat(part) for part in zip(*parts, strict=True))
    return Recorded(
        sequence.truth,
        torch.arange(FRAMES),
        sequence.truth.t_ns,
        state or ["tracking"] * FRAMES,
        xyz,
        rgb,
        host,
        camera.width,
        camera.height,
        **known,
    )


def write_run(folder: Path, recorded: Recorded, config: dict) -> Path:
    """Write what a run would have left, and return its folder."""
    folder.mkdir(parents=True)
    write_tum(folder / "trajectory.txt", recorded.trajectory)
    write_ply(folder / "map.ply", recorded.xyz, recorded.rgb, recorded.host)
    with (folder / "frames.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="")
        writer.writeheader()
        rows = zip(recorded.index.tolist(), recorded.t_ns.tolist(), recorded.state, strict=True)
        for index, t_ns, state in rows:
            writer.writerow({"index": index, "time": f"{t_ns // 10**9}.{t_ns % 10**9:09d}", "state": state})
    (folder / "summary.json").write_text(json.dumps({"width": recorded.width, "height": recorded.height}))
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder


def config_of(sequence: SyntheticSequence) -> dict:
    """Return the settings of a run of this sequence."""
    return {"input": "synthetic", "synthetic": asdict(sequence.config), "vo": {"unknown_to_this_version": 1}}
