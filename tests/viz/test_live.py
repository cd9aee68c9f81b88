"""The recording for the Rerun viewer, read back by Rerun's own reader, and what a run without it does not load."""

import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchvo360.cli import main
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.data.tum import read_tum
from torchvo360.export import read_ply
from torchvo360.viz.live import live_view
from torchvo360.vo import VisualOdometry

FRAMES = 34
"""Beyond the first look at the map so far."""

SMALL = ["input=synthetic", "synthetic.width=192", "synthetic.height=96", f"synthetic.frames={FRAMES}", "plot=false"]


@pytest.fixture
def _installed() -> None:
    pytest.importorskip("rerun", reason="rerun-sdk, of the extra `live`, is not installed")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """The folder of a run that was recorded."""
    pytest.importorskip("rerun", reason="rerun-sdk, of the extra `live`, is not installed")
    folder = tmp_path_factory.mktemp("recorded")
    assert main([*SMALL, f"out={folder}", "viz=rerun", "report=false"]) == 0
    return folder


def tables(path: Path) -> dict[str, list[Any]]:
    """The record batches of a recording by entity."""
    from rerun.chunk import RrdReader  # pyright: ignore[reportMissingImports]

    out: dict[str, list[Any]] = {}
    for chunk in RrdReader(path).stream():
        out.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return out


def values(batches: list[Any], column: str) -> list[Any]:
    return [value for batch in batches for value in batch.column(column).to_pylist()]


def test_the_recording_holds_every_frame_with_its_values(recorded):
    found = tables(recorded / "run.rrd")
    rows = [line.split(",") for line in (recorded / "frames.csv").read_text().splitlines()[1:]]
    for entity in ("/world/camera", "/image", "/values/milliseconds"):
        assert sorted(values(found[entity], "frame")) == list(range(FRAMES)), entity
    residuals = {
        index: value[0]
        for index, value in zip(
            values(found["/values/residual"], "frame"),
            values(found["/values/residual"], "Scalars:scalars"),
            strict=True,
        )
    }
    expected = {int(row[0]): float(row[4]) for row in rows if row[4]}
    assert residuals.keys() == expected.keys()
    np.testing.assert_allclose([residuals[index] for index in expected], list(expected.values()), rtol=1e-5)
    said = [text[0] for text in values(found["/states"], "TextLog:text")]
    assert said[0].startswith("initialising: ")
    assert said[-1] == f"{rows[-1][2]}: {rows[-1][3]}"


def test_the_recordings_last_map_and_path_are_those_of_the_files(recorded):
    found = tables(recorded / "run.rrd")
    frame = read_ply(recorded / "map.ply")[2].tolist()
    counts = {}
    for entity, batches in found.items():
        if entity.startswith("/world/map/"):
            at = values(batches, "frame")
            positions = values(batches, "Points3D:positions")
            counts[int(entity.rsplit("/", 1)[1])] = len(positions[max(range(len(at)), key=lambda k: (at[k], k))])
    assert counts == Counter(frame)
    last = max(
        zip(values(found["/world/path"], "frame"), values(found["/world/path"], "LineStrips3D:strips"), strict=True),
        key=lambda row: row[0],
    )
    path = read_tum(recorded / "trajectory.txt").positions
    np.testing.assert_allclose(np.array(last[1][0]), path, atol=1e-5)


def test_recording_changes_nothing_of_the_results(recorded, tmp_path):
    assert main([*SMALL, f"out={tmp_path}", "report=false"]) == 0
    assert not (tmp_path / "run.rrd").exists()
    for name in ("trajectory.txt", "map.ply"):
        assert (tmp_path / name).read_bytes() == (recorded / name).read_bytes()


def test_a_run_without_recording_takes_an_older_one_away(recorded):
    assert (recorded / "run.rrd").read_bytes()[:4] == b"RRF2"
    assert main([*SMALL, f"out={recorded}", "overwrite=true", "report=false", "synthetic.frames=4"]) == 0
    assert not (recorded / "run.rrd").exists()


@pytest.mark.usefixtures("_installed")
def test_a_run_that_does_not_end_leaves_no_recording(tmp_path):
    sequence = SyntheticSequence(SyntheticConfig(width=64, height=32, frames=2))
    odometry = VisualOdometry(sequence.camera)
    with live_view("rerun", tmp_path / "run.rrd", "walk", sequence.camera) as live:
        assert live is not None
        for frame in sequence:
            live.show(frame, odometry.step(frame))
        assert list(tmp_path.iterdir())
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("_installed")
def test_a_pinhole_image_stands_before_its_camera(tmp_path):
    arguments = [*SMALL[1:], "input=synthetic", "synthetic.camera=pinhole", "synthetic.frames=6"]
    assert main([*arguments, f"out={tmp_path}", "viz=rerun", "report=false"]) == 0
    found = tables(tmp_path / "run.rrd")
    assert "/image" not in found
    columns = {name for batch in found["/world/camera/image"] for name in batch.schema.names}
    assert {"Pinhole:image_from_camera", "EncodedImage:blob"} <= columns


def test_without_the_viewer_nothing_of_it_is_loaded(tmp_path):
    script = (
        "import sys; from torchvo360.cli import main\n"
        f"code = main({[*SMALL, 'synthetic.frames=4', f'out={tmp_path}']!r})\n"
        "assert code == 0; assert not [name for name in sys.modules if name.partition('.')[0] == 'rerun']"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_missing_sdk_is_named_with_the_extra_that_brings_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main([*SMALL, f"out={tmp_path / 'x'}", "viz=rerun"]) == 2
    assert "viz: expected rerun-sdk, which pip install 'torchvo360[live]' brings" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.usefixtures("_installed")
def test_a_viewer_that_cannot_be_found_is_said_in_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main([*SMALL, f"out={tmp_path / 'x'}", "viz=rerun_viewer"]) == 2
    assert "viz: expected the command `rerun` on the PATH" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
