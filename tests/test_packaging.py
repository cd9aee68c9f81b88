"""What is shipped, and that it finds its parts."""

import ast
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import torchvo360
from torchvo360.cli.command import conf_folder
from torchvo360.settings import CLIPS

PACKAGE = Path(torchvo360.__file__).parent
ROOT = PACKAGE.parent

OUT_OF_REACH = ("No matching distribution found for hatchling", "No module named pip")


def test_the_configuration_and_the_clip_are_found():
    conf = conf_folder()
    assert (conf / "config.yaml").is_file()
    assert (conf / "help.txt").is_file()
    for clip in CLIPS.glob("*.mp4"):
        assert (conf / "clip" / f"{clip.stem}.yaml").is_file()
        assert "Apache License" in (CLIPS / "LICENSE").read_text()
        assert clip.stat().st_size <= 2_000_000


def test_only_the_command_knows_hydra():
    for file in PACKAGE.rglob("*.py"):
        tree = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        names = [alias.name for node in tree if isinstance(node, ast.Import) for alias in node.names]
        tree = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        names += [node.module or "" for node in tree if isinstance(node, ast.ImportFrom)]
        knows = any(name.partition(".")[0] in ("hydra", "omegaconf") for name in names)
        assert not knows or file.is_relative_to(PACKAGE / "cli"), file


@pytest.mark.slow
def test_the_wheel_holds_the_configuration_and_runs_from_it(tmp_path):
    if not (ROOT / "pyproject.toml").is_file():
        pytest.skip("an installed package cannot be built")
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--quiet", "-w", str(tmp_path), str(ROOT)]
    built = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    if any(words in built.stderr for words in OUT_OF_REACH):
        pytest.skip("building needs pip and hatchling, which are neither here nor in reach")
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "installed")
    shipped = {name.partition("/")[0] for name in names}
    assert shipped == {"torchvo360", f"torchvo360-{wheel.name.split('-')[1]}.dist-info"}
    conf = {f"torchvo360/conf/{path.relative_to(conf_folder())}" for path in conf_folder().rglob("*") if path.is_file()}
    assert {*conf, "torchvo360/py.typed", "torchvo360/data/clips/theta_walk.mp4"} <= set(names)
    assert "torchvo360/data/clips/LICENSE" in names
    page = {f"torchvo360/{path.relative_to(PACKAGE)}" for path in (PACKAGE / "viz" / "report" / "template").iterdir()}
    assert page <= set(names)

    run = [sys.executable, "-m", "torchvo360", "--cfg"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "installed")}
    printed = subprocess.run(
        run, capture_output=True, text=True, timeout=120, check=True, cwd=tmp_path, env=environment
    )
    assert "mask: below:-18" in printed.stdout
