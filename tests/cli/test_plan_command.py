"""The command `torchvo360-plan`: what it writes and prints of a real clip and a rendered world, what it refuses."""

import csv
import itertools
import json
import math
import shutil
from dataclasses import fields

import pytest
import torch
import yaml

from torchvo360.cli.command import ENVIRONMENT
from torchvo360.cli.command import main as run_odometry
from torchvo360.cli.plan import main
from torchvo360.cli.plan_settings import PlanSettings
from torchvo360.cli.surroundings import read_surroundings
from torchvo360.data.tum import read_tum
from torchvo360.mapping import FREE, OCCUPIED, OccupancyMap, read_map, write_map

FILES = {"map.pgm", "map.yaml", "path.csv", "plan.json"}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A run of the embedded clip."""
    folder = tmp_path_factory.mktemp("walk")
    assert run_odometry(["stop=60", f"out={folder}", "plot=false", "progress=false"]) == 0
    return folder


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    """A run of a rendered hall with a depth sensor."""
    folder = tmp_path_factory.mktemp("hall")
    size = ["synthetic.width=256", "synthetic.height=128", "synthetic.frames=30", "synthetic.depth_noise=0.01"]
    arguments = ["input=synthetic", "synthetic.world=pillars", *size, f"out={folder}", "plot=false", "progress=false"]
    assert run_odometry(arguments) == 0
    return folder


@pytest.fixture
def drawn(tmp_path):
    """A map that is there: a hall of 6 x 4 m with a wall across it and a gap."""
    states = torch.full((40, 60), FREE, dtype=torch.int8)
    states[:28, 30] = OCCUPIED
    return write_map(tmp_path, OccupancyMap(states, 0.1))


def csv_path(folder):
    with (folder / "path.csv").open(newline="") as file:
        return [(float(row["x"]), float(row["y"])) for row in csv.DictReader(file)]


def test_a_real_walk_becomes_a_map_whose_walkway_is_free(walk, capsys):
    assert main([f"run={walk}", "plot=false"]) == 0
    told = capsys.readouterr().out
    assert "units of the run" in told
    assert "x (right)" in told
    assert {path.name for path in (walk / "plan").iterdir()} == FILES
    map = read_map(walk / "plan" / "map.yaml")
    assert (walk / "plan" / "map.yaml").read_text().startswith("# lengths are in units")
    plan = json.loads((walk / "plan" / "plan.json").read_text())
    S = torch.tensor(plan["S_map_world"], dtype=torch.float64)
    centres = read_tum(walk / "trajectory.txt").positions @ S[:3, :3].T + S[:3, 3]
    for x, y, z in centres.tolist():
        cell = map.cell_of((x, y))
        assert cell is not None
        assert map.states[cell] == FREE
        assert z > 0
    assert int((map.states == OCCUPIED).sum()) > 100
    way = csv_path(walk / "plan")
    assert way[0] == pytest.approx(centres[0, :2].tolist(), abs=1e-5)
    assert way[-1] == pytest.approx(centres[-1, :2].tolist(), abs=1e-5)
    assert plan["length"] == pytest.approx(sum(math.dist(a, b) for a, b in itertools.pairwise(way)), rel=1e-3)


def test_the_cameras_height_makes_metres(walk, tmp_path):
    assert main([f"run={walk}", "floor=0.45", "camera_height=1.8", f"out={tmp_path / 'm'}", "plot=false"]) == 0
    plan = json.loads((tmp_path / "m" / "plan.json").read_text())
    assert plan["unit"] == "m"
    S = torch.tensor(plan["S_map_world"], dtype=torch.float64)
    assert float(torch.linalg.det(S[:3, :3])) == pytest.approx(4.0**3)
    assert yaml.safe_load((tmp_path / "m" / "map.yaml").read_text())["resolution"] == 0.05


@pytest.mark.parametrize("source", ["points", "sensor", "learned"])
def test_every_source_of_a_run_in_metres_shows_the_hall(hall, tmp_path, source, capsys):
    assert main([f"run={hall}", f"depth={source}", f"out={tmp_path / 'p'}", "plot=false", "stride=4"]) == 0
    floor = float(capsys.readouterr().out.partition("floor: ")[2].split()[0])
    assert floor == pytest.approx(1.62, abs=0.15)
    map = read_map(tmp_path / "p" / "map.yaml")
    assert map.resolution == 0.05
    assert int((map.states == OCCUPIED).sum()) > (20 if source == "learned" else 200)  # the network is seldom sure
    assert 15 < float((map.states == FREE).sum()) * 0.05**2 < 160  # of a hall of 14 x 11 m
    plan = json.loads((tmp_path / "p" / "plan.json").read_text())
    assert plan["unit"] == "m"
    truth = 0.95 * 29 / 30  # walking speed
    assert plan["length"] == pytest.approx(truth, rel=0.15)


def test_a_picture_is_drawn_where_matplotlib_is(hall):
    pytest.importorskip("matplotlib")
    assert main([f"run={hall}", "goal=-1,1.5", "plot=true"]) == 0
    assert (hall / "plan" / "plan.png").read_bytes().startswith(b"\x89PNG")


def test_upwards_can_be_given(hall, tmp_path):
    assert main([f"run={hall}", "up=0,-1,0", f"out={tmp_path / 'p'}", "plot=false"]) == 0
    S = torch.tensor(json.loads((tmp_path / "p" / "plan.json").read_text())["S_map_world"])
    assert float(-S[2, 1]) > 0.98


def test_a_way_on_a_map_that_is_there(drawn, tmp_path, capsys):
    before = drawn.read_bytes(), drawn.with_name("map.pgm").read_bytes()
    assert main([f"map={drawn}", "start=1,1", "goal=5,1", "robot_radius=0.3", "plot=false"]) == 0
    assert "way: " in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "plan").iterdir()} == {"path.csv", "plan.json"}
    assert max(y for _, y in csv_path(tmp_path / "plan")) > 3.0
    assert (drawn.read_bytes(), drawn.with_name("map.pgm").read_bytes()) == before


def test_on_a_map_in_another_unit_the_robots_size_has_to_be_said(tmp_path, capsys):
    path = write_map(tmp_path, OccupancyMap(torch.full((20, 20), FREE, dtype=torch.int8), 0.1), unit="units")
    arguments = [f"map={path}", "start=0.5,0.5", "goal=1.5,0.5", "plot=false", "margin=0"]
    assert main(arguments) == 2
    assert "robot_radius: expected a length in the map's unit" in capsys.readouterr().err
    assert main([*arguments, "robot_radius=0.1"]) == 0
    assert "way: 1 units from (0.5, 0.5) to (1.5, 0.5), 2 corners, without any obstacle" in capsys.readouterr().out
    assert json.loads((tmp_path / "plan" / "plan.json").read_text())["clearance"] is None


def test_no_way_is_told_by_its_own_exit_code_and_leaves_no_old_way(drawn, tmp_path, capsys):
    arguments = [f"map={drawn}", "start=1,1", "plot=false"]
    assert main([*arguments, "goal=5,1"]) == 0
    assert main([*arguments, "goal=5,1", "robot_radius=1.3"]) == 3
    assert "no way: the goal (5, 1) cannot be reached; of " in capsys.readouterr().out
    assert not (tmp_path / "plan" / "path.csv").exists()
    assert json.loads((tmp_path / "plan" / "plan.json").read_text())["reason"] == "unreachable"
    assert main([*arguments, "goal=50,1"]) == 3
    assert "lies outside the map (x 0 to 6, y 0 to 4)" in capsys.readouterr().out
    assert main([*arguments, "goal=3.05,1"]) == 3
    assert "lies in an obstacle" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "run: expected the folder of a run, or map=FILE, got neither or both."),
        (["run=none"], "run: expected the folder of a finished run, got none, without summary.json"),
        (["map=none.yaml", "start=0,0", "goal=1,1"], "map: none.yaml: expected a map's yaml file, got none"),
        (["map=map.yaml", "goal=1,1"], "start: expected start=x,y on a map that is there, got none."),
        (["map=map.yaml", "start=0,0", "goal=1,1", "floor=1"], "floor: expected no value for a map that is there"),
        (["map=map.yaml", "start=0;0", "goal=1,1"], "start: expected 2 numbers such as 1,2, got 0;0."),
        (["map=map.yaml", "start=0,0", "goal=nan,1"], "goal: expected 2 numbers such as 1,2, got nan,1."),
        (["run=x", "up=1,2"], "up: expected 3 numbers such as 1,2,0, got 1,2."),
        (["run=x", "robot_radius=wide"], "robot_radius: expected a number, got wide."),
        (["run=x", "robot_radios=1"], "robot_radios: expected a known key such as robot_radius, got robot_radios=1."),
        (["run=x", "goal"], "goal: expected key=value, such as run=runs/walk."),
        (["run=x", "camera_height=-1"], "camera_height: expected a finite number above 0, got -1.0."),
        (["run=x", "depth=lidar"], "depth: expected one of points, sensor, learned, got 'lidar'."),
        (["run=x", "stride=0"], "stride: expected at least 1, got 0."),
        (["map=map.yaml", "start=0,0", "goal=1,1", "unknown=no"], "unknown: expected one of free, blocked, got 'no'."),
        (["map=map.yaml", "start=0,0", "goal=1,1", "margin=-1"], "margin: expected a finite number of at least 0"),
    ],
)
def test_the_callers_mistake_is_one_sentence_and_nothing_is_written(drawn, tmp_path, arguments, told, capsys):
    before = sorted(tmp_path.rglob("*"))
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(f"torchvo360-plan: {told}")
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert sorted(tmp_path.rglob("*")) == before


def test_what_does_not_go_with_a_run_is_refused(walk, hall, capsys):
    for arguments, told in (
        ([f"run={walk}", "depth=learned"], "depth: expected points for a run in a unit of its own, got learned"),
        ([f"run={hall}", "floor=1.6", "camera_height=1.6"], "floor: expected no value beside camera_height"),
        ([f"run={walk}", "resolution=1e-7"], "resolution: expected at least"),
        ([f"run={walk}", "step=3"], "step: expected less than the robot's height"),
        ([f"run={walk}", "depth=sensor", "metric=true"], "depth: expected points or learned for an input without"),
    ):
        assert main(arguments) == 2
        assert capsys.readouterr().err.startswith(f"torchvo360-plan: {told}")


def test_a_damaged_run_is_refused(walk, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(walk, copy)
    for name in ("map.ply", "trajectory.txt", "frames.csv", "summary.json"):
        whole = (copy / name).read_bytes()
        (copy / name).write_bytes(whole[:40])
        assert main([f"run={copy}", f"out={tmp_path / 'out'}"]) == 2
        assert capsys.readouterr().err.count("\n") == 1
        (copy / name).write_bytes(whole)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_told(drawn, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main([f"map={drawn}", "start=1,1", "goal=2,2", f"out={tmp_path / 'file'}"]) == 2
    assert "out: expected a folder that can be written" in capsys.readouterr().err


def test_a_summary_that_names_the_unit_is_believed(hall, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(hall, copy)
    summary = json.loads((copy / "summary.json").read_text())
    (copy / "summary.json").write_text(json.dumps({**summary, "metric": False}))
    assert not read_surroundings(copy, "points", 2, None).metric
    assert read_surroundings(copy, "points", 2, True).metric


def test_help_names_every_setting(capsys):
    assert main(["--help"]) == 0
    page = capsys.readouterr().out
    assert all(f"{field.name}=" in page for field in fields(PlanSettings))
    assert max(map(len, page.splitlines())) <= 120
