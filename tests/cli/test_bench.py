"""The command `torchvo360-bench`: it survives what fails and what dies, goes on where it stopped, and says so.

Most tests put a module in the place of the package that writes what a run writes, and do not wait for odometry.
"""

import csv
import json
import os
import signal
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from torchvo360.checks import InputError
from torchvo360.cli.bench import main
from torchvo360.cli.benchmark.report import table_of_sequences
from torchvo360.cli.benchmark.suite import find_sequences
from torchvo360.cli.command import conf_folder
from torchvo360.cli.configuration import compose
from torchvo360.data.trajectory import Trajectory
from torchvo360.export import write_tum
from torchvo360.lie import se3_exp

SUITES = conf_folder() / "bench" / "suite"

TINY = {"width": 128, "height": 64, "frames": 8}

STUB = """
import os, pathlib, shutil, signal, sys, time

settings = dict(word.split("=", 1) for word in sys.argv[1:])
name, out, cured = settings["input"].strip("'"), pathlib.Path(settings["out"]), os.path.exists("cured")
with open("calls.txt", "a") as calls:
    calls.write(f"{name} {settings['seed']}\\n")
if name == "dies.mp4" and not cured:
    os.kill(os.getpid(), signal.SIGKILL)
if name == "refused.mp4" and not cured:
    print("torchvo360: input: expected a video, got none.", file=sys.stderr)
    sys.exit(2)
if name == "crashes.mp4" and not cured:
    raise ValueError("of its own")
if name == "waits.mp4" and not cured:
    pathlib.Path("waiting").touch()
    time.sleep(60)
if name == "deadly.mp4" and not cured:
    pathlib.Path("cured").touch()
    os.kill(os.getppid(), signal.SIGKILL)
    sys.exit(1)
shutil.copy("estimate.txt", out / "trajectory.txt")
if name != "*.png":
    shutil.copy("truth.txt", out / "truth.txt")
(out / "frames.csv").write_text("index,time,state,milliseconds\\n0,0,tracking,5\\n")
(out / "config.yaml").write_text("input: '*.png'\\n")
(out / "summary.json").write_text("{}")
"""


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def walk(noise: float) -> Trajectory:
    generator = torch.Generator().manual_seed(0)
    steps = 0.05 * torch.randn(30, 6, generator=generator, dtype=torch.float64)
    steps[:, 2] += 0.1
    steps += noise * torch.randn(30, 6, generator=generator, dtype=torch.float64)
    poses = [torch.eye(4, dtype=torch.float64)]
    for step in steps[1:]:
        poses.append(poses[-1] @ se3_exp(step))
    return Trajectory(torch.arange(30) * 10**8, torch.stack(poses))


@pytest.fixture
def stub(tmp_path) -> None:
    """A module of the current folder that stands for the package in `python -m torchvo360`."""
    (tmp_path / "torchvo360.py").write_text(STUB)
    write_tum(tmp_path / "truth.txt", walk(0.0))
    write_tum(tmp_path / "estimate.txt", walk(0.01))


def write_list(*names: str) -> str:
    Path("list.yaml").write_text(yaml.safe_dump([{"input": f"{name}.mp4"} for name in names]))
    return "dataset=list.yaml"


def rows_of(folder: str) -> dict[str, dict[str, str]]:
    rows = csv.DictReader(Path(folder, "table.csv").read_text(encoding="utf-8").splitlines())
    return {f"{row['sequence']} {row['preset']} {row['seed']}".strip(): row for row in rows}


def calls() -> list[str]:
    path = Path("calls.txt")
    done = path.read_text().split("\n")[:-1] if path.exists() else []
    path.unlink(missing_ok=True)
    return done


@pytest.mark.slow
def test_a_real_run_and_one_that_kills_its_own_process_stand_in_one_table(tmp_path, monkeypatch, capsys):
    killer = "import os, signal\nfrom torch import nn\n\n\nclass Net(nn.Module):\n    def __init__(self):\n"
    Path("deadly.py").write_text(killer + "        os.kill(os.getpid(), signal.SIGKILL)\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), str(conf_folder().parent)]))
    entries = [{"name": "killed", "depth": {"_target_": "deadly.Net"}}, {"name": "fine", "vo": "clean"}]
    settings = {"input": "synthetic", "synthetic": TINY, "plot": False, "report": False}
    Path("mine.yaml").write_text(yaml.safe_dump({"settings": settings, "sequences": entries}))
    assert main(["dataset=mine.yaml", "seeds=[3]", "out=b"]) == 1
    rows = rows_of("b")
    assert (rows["killed default 3"]["ending"], rows["fine default 3"]["ending"]) == ("failed", "finished")
    assert rows["killed default 3"]["problem"] == "killed by SIGKILL, as for want of memory"
    assert 0 < float(rows["fine default 3"]["ate_percent"]) < 3
    settings = yaml.safe_load(Path("b/fine/default/seed_3/config.yaml").read_text())
    assert (settings["seed"], settings["synthetic"]["seed"], settings["vo"]["blur_px"]) == (3, 3, 0.5)
    said = capsys.readouterr()
    assert "killed, default, seed 3: killed by SIGKILL" in said.out
    assert said.err == "torchvo360-bench: not finished: 1 of 2 runs; the same call with out=b goes on.\n"


@pytest.mark.usefixtures("stub")
def test_what_fails_is_told_and_done_again_and_what_is_finished_is_kept(capsys):
    names = ("good", "refused", "dies", "crashes")
    dataset = write_list(*names)
    assert main([dataset, "out=b"]) == 1
    assert len(calls()) == 4
    rows = rows_of("b")
    problems = {name: rows[f"{name} default 0"]["problem"] for name in names}
    assert problems == {
        "good": "",
        "refused": "input: expected a video, got none.",
        "dies": "killed by SIGKILL, as for want of memory",
        "crashes": "ValueError: of its own",
    }
    assert "| refused | default | 0/1 |" in Path("b/table.md").read_text()
    assert "seed 0: input: expected a video, got none." in Path("b/table.md").read_text()
    Path("cured").touch()
    capsys.readouterr()
    assert main([dataset, "seeds=2", "out=b"]) == 0
    missing = [*(f"{name}.mp4 0" for name in names[1:]), *(f"{name}.mp4 1" for name in names)]
    assert sorted(calls()) == sorted(missing)
    said = capsys.readouterr()
    assert said.out.startswith("1 of 8 runs are finished already.")
    assert said.err == ""
    assert {row["ending"] for row in rows_of("b").values()} == {"finished", ""}


def test_a_line_of_the_table_holds_the_problems_of_all_its_seeds():
    rows = [
        {"sequence": "a", "preset": "fast", "seed": seed, "ending": "failed", "problem": f"no. {seed}"}
        for seed in (0, 1)
    ]
    text = table_of_sequences(rows, problems=True).as_markdown()
    assert "| a | fast | 0/2 | seed 0: no. 0; seed 1: no. 1 |" in text


@pytest.mark.usefixtures("stub")
@pytest.mark.parametrize("missing", ["summary.json", "job.json"])
def test_a_half_done_run_is_done_anew_in_an_empty_folder(missing):
    dataset = write_list("good", "other")
    assert main([dataset, "out=b"]) == 0
    calls()
    folder = Path("b/good/default/seed_0")
    (folder / "part").touch()
    if missing == "summary.json":
        (folder / missing).unlink()
    else:  # the benchmark died before it saw the end
        record = json.loads((folder / missing).read_text())
        (folder / missing).write_text(json.dumps(record | {"code": None}))
    assert main([dataset, "out=b"]) == 0
    assert calls() == ["good.mp4 0"]
    assert not (folder / "part").exists()


@pytest.mark.usefixtures("stub")
def test_presets_and_seeds_have_folders_of_their_own_and_summaries_are_by_preset():
    assert (
        main([write_list("good", "other"), "presets=[default,fast]", "seeds=[4,9]", "vo.window.steps=2", "out=b"]) == 0
    )
    assert len(list(Path("b").glob("*/*/seed_*/summary.json"))) == 8
    overrides = json.loads(Path("b/other/fast/seed_9/job.json").read_text())["overrides"]
    assert {"vo=fast", "vo.window.steps=2", "seed=9", "progress=false"} <= set(overrides)
    rows = rows_of("b")
    assert {name for name in rows if name.startswith("median")} == {"median default", "median fast"}
    value = float(rows["good default 4"]["ate_rmse_m"])
    assert float(rows["median fast"]["ate_rmse_m"]) == pytest.approx(value)
    assert value > 1e-3


@pytest.mark.usefixtures("stub")
def test_an_input_without_true_poses_is_finished_without_errors():
    for number in range(2):
        cv2.imwrite(f"{number}.png", np.zeros((32, 64, 3), np.uint8))
    Path("list.yaml").write_text("[{name: truthless, input: '*.png'}]")
    assert main(["dataset=list.yaml", "out=b"]) == 0
    row = rows_of("b")["truthless default 0"]
    assert (row["ending"], row["tracking_percent"], row["problem"]) == ("finished", "100", "no true poses")
    assert "ate_rmse_m" not in row


@pytest.mark.usefixtures("stub")
def test_a_folder_with_other_settings_is_not_mixed_up(capsys):
    dataset = write_list("good")
    assert main([dataset, "out=b"]) == 0
    before = Path("b/table.csv").read_bytes()
    assert main([dataset, "out=b", "stop=30"]) == 2
    assert "out: expected runs with these settings or a new folder" in capsys.readouterr().err
    assert Path("b/table.csv").read_bytes() == before


@pytest.mark.usefixtures("stub", "listening")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_benchmark_keeps_what_is_finished(number):
    dataset = write_list("good", "waits", "other")

    def stop_it() -> None:
        deadline = time.monotonic() + 30
        while not Path("waiting").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=stop_it)
    thread.start()
    try:
        assert main([dataset, "out=b"]) == 128 + number
    finally:
        thread.join()
    rows = rows_of("b")
    assert [rows[f"{name} default 0"]["ending"] for name in ("good", "waits", "other")] == [
        "finished",
        *["not done"] * 2,
    ]
    assert len(calls()) == 2
    Path("cured").touch()
    assert main([dataset, "out=b"]) == 0
    assert calls() == ["waits.mp4 0", "other.mp4 0"]


@pytest.mark.slow
@pytest.mark.usefixtures("stub")
def test_a_workers_death_does_not_end_the_benchmark(capsys):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="the launcher joblib is not installed")
    launcher = ["cluster=joblib", "hydra.launcher.n_jobs=2"]
    assert main([write_list("deadly", "good"), "out=b", *launcher]) == 0
    assert "the launcher failed: TerminatedWorkerError" in capsys.readouterr().err
    assert len(list(Path("b").glob("*/default/seed_0/summary.json"))) == 2


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["dataset=gone"], "dataset: expected one of lighting, synthetic, a folder or a list (.yaml), got gone"),
        (["dataset=empty"], "dataset: expected sequences in empty, got none"),
        (["seeds=0"], "seeds: expected their number or a list of different ones, got 0"),
        (["seeds=[1,1]"], "seeds: expected their number or a list of different ones, got [1, 1]"),
        (["seeds=many"], "seeds: expected their number or a list"),
        (["presets=[fast,fast]"], "presets: expected one or a list of different ones"),
        (["presets=hasty", "dataset=one.yaml"], "vo: expected one of"),
        (["align=sim2"], "align: expected one of sim3, se3, none, got 'sim2'"),
        (["seed=3"], "seed: expected seeds in its place for a benchmark, got seed=3"),
        (["vo=fast"], "vo: expected presets in its place"),
        (["input=walk.mp4"], "input: expected dataset in its place"),
        (["synthetic.widht=64"], "synthetic.widht: expected a known key such as synthetic.width"),
        (["synthetic.width=100", "dataset=one.yaml"], "synthetic.width: expected twice the height"),
        (["fast"], "fast: expected key=value, such as dataset=synthetic, or --help"),
        (["out="], "out: expected a folder, got an empty name"),
        (["out=file"], "out: expected a folder that can be written"),
    ],
)
def test_a_mistake_in_the_call_is_one_sentence_and_nothing_is_left(words, complaint, capsys):
    Path("empty").mkdir()
    Path("file").touch()
    Path("one.yaml").write_text("[{name: one, input: synthetic}]")
    assert main([*words, "out=b"] if not words[0].startswith("out") else words) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"torchvo360-bench: {complaint}")
    assert said.count("\n") == 1
    assert sorted(path.name for path in Path().iterdir()) == ["empty", "file", "one.yaml"]


def test_an_unknown_or_absent_launcher_is_named(capsys):
    assert main(["cluster=mine", "out=b"]) == 2
    assert capsys.readouterr().err.startswith("torchvo360-bench: cluster: expected one of joblib, none, ray, submitit")
    assert not Path("b").exists()


@pytest.mark.parametrize("suite", sorted(SUITES.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_suite_holds_sequences_that_can_be_run(suite):
    for sequence in find_sequences(suite.stem, SUITES):
        config = compose([f"{key}={value}" for key, value in sequence.overrides.items()], conf_folder())
        assert config.input == "synthetic"
        assert set(sequence.name.split("_")) <= set(map(str, vars(config.synthetic).values()))


def test_a_folder_is_searched_for_videos_images_and_their_true_poses():
    for path in ("data/images", "data/walk", "data/kitti/image_0", "data/nothing"):
        Path(path).mkdir(parents=True)
    files = ("a b.mp4", "a b.txt", "images/0.png", "images/groundtruth.txt", "walk/0.jpg", "walk.txt", "notes.txt")
    for file in (*files, "kitti/calib.txt", "nothing/readme.md", "truthless.MOV"):
        Path("data", file).touch()
    found = {sequence.name: dict(sequence.overrides) for sequence in find_sequences("data", SUITES)}
    assert found == {
        "a_b": {"input": "'data/a b.mp4'", "truth": "'data/a b.txt'"},
        "images": {"input": "'data/images'", "truth": "'data/images/groundtruth.txt'"},
        "kitti": {"input": "'data/kitti'"},
        "truthless": {"input": "'data/truthless.MOV'"},
        "walk": {"input": "'data/walk'", "truth": "'data/walk.txt'"},
    }
    (alone,) = find_sequences("data/walk", SUITES)
    assert alone.overrides["input"] == "'data/walk'"


def test_a_list_combines_its_grid_and_finds_files_beside_it():
    Path("lists").mkdir()
    Path("lists/a.mp4").touch()
    content = {
        "settings": {"mask": "below:-60", "synthetic": {"frames": 9}},
        "sequences": [{"input": "a.mp4", "camera": {"fit": "crop"}}, {"name": "far", "input": "b.mp4", "mask": None}],
        "grid": {"synthetic.world": ["room", "field"], "plot": [True, False]},
    }
    Path("lists/mine.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    first, far, *grid = find_sequences("lists/mine.yaml", SUITES)
    common = {"mask": "'below:-60'", "synthetic.frames": "9"}
    assert (first.name, first.overrides) == ("a", {**common, "input": "'lists/a.mp4'", "camera.fit": "'crop'"})
    assert far.overrides["mask"] == "null"
    assert far.overrides["input"] == "'b.mp4'"
    assert [sequence.name for sequence in grid] == ["room_True", "room_False", "field_True", "field_False"]
    assert grid[3].overrides == {**common, "synthetic.world": "'field'", "plot": "false"}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[{", r"mine\.yaml, line \d: expected a list of sequences in YAML, got a damaged file"),
        ("3", r"mine\.yaml: expected a list, or a mapping with settings, sequences, grid"),
        ("{}", r"mine\.yaml: expected a list, or a mapping"),
        ("[]", r"dataset: expected sequences in mine\.yaml, got none"),
        ("[{mask: a.png}]", r"mine\.yaml, sequence 1: expected at least `input` or `name`, got neither"),
        ("[{input: a.mp4}, {inptu: b.mp4, name: b}]", r"sequence 2: inptu: expected a known key such as input"),
        ("[a.mp4]", r"sequence 1: expected settings by their keys, got 'a\.mp4'"),
        ("[{input: a.mp4}, {input: b/a.mov}]", r"dataset: expected a name of its own for every sequence, got a twice"),
        ("{grid: {synthetic.world: room}}", r"expected lists of values by their keys under grid"),
        ("{sequences: {input: a.mp4}}", r"expected a list under sequences"),
        ("!!python/object/apply:os.getcwd []", r"expected a list of sequences in YAML, got a damaged file"),
    ],
)
def test_a_damaged_list_is_told_by_its_place(text, complaint):
    Path("mine.yaml").write_text(text)
    with pytest.raises(InputError, match=complaint):
        find_sequences("mine.yaml", SUITES)


def test_the_help_is_that_of_the_command(capsys):
    assert main(["--help"]) == 0
    assert capsys.readouterr().out.startswith("torchvo360-bench: a whole data set, times presets, times seeds")
