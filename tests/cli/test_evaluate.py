"""The command `torchvo360-eval`: what it prints and writes, and one sentence for each mistake."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from torchvo360.cli.evaluate import main
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.data.trajectory import Trajectory
from torchvo360.evaluation import evaluate
from torchvo360.export import write_tum
from torchvo360.lie import se3_exp

FRAMES = 40

CLIP = {"input": "theta_walk", "camera": {"fit": "stretch"}}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def walk(noise: float = 0.0, start_ns: int = 0) -> Trajectory:
    """A winding path; with noise, the same with errors that add up."""
    generator = torch.Generator().manual_seed(0)
    steps = 0.05 * torch.randn(FRAMES, 6, generator=generator, dtype=torch.float64)
    steps[:, 2] += 0.1
    steps += noise * torch.randn(FRAMES, 6, generator=generator, dtype=torch.float64)
    poses = [torch.eye(4, dtype=torch.float64)]
    for step in steps[1:]:
        poses.append(poses[-1] @ se3_exp(step))
    return Trajectory(start_ns + torch.arange(FRAMES) * 33_333_333, torch.stack(poses))


def write_run(folder: str, trajectory: Trajectory, **settings) -> None:
    path = Path(folder)
    path.mkdir(parents=True)
    write_tum(path / "trajectory.txt", trajectory)
    rows = (f"{index},{index / 30},tracking,ok,,,,,{20 + index}\n" for index in range(len(trajectory)))
    (path / "frames.csv").write_text("index,time,state,reason,residual,inliers,a,b,milliseconds\n" + "".join(rows))
    (path / "config.yaml").write_text(yaml.safe_dump(settings))


@pytest.fixture
def runs() -> None:
    """Two runs, and their truth in truth.txt."""
    write_run("runs/a", walk(0.005))
    write_run("runs/b", walk(0.02))
    write_tum("truth.txt", walk())


def rows_of(path: str) -> list[dict[str, str]]:
    return list(csv.DictReader(Path(path).read_text(encoding="utf-8").splitlines()))


@pytest.mark.usefixtures("runs")
@pytest.mark.parametrize("align", ["sim3", "se3", "none"])
def test_run_folders_and_files_are_compared_with_the_last_file(capsys, align):
    assert main(["runs/a", "runs/b", "runs/b/trajectory.txt", "truth.txt", f"align={align}", "out=t.csv"]) == 0
    rows = rows_of("t.csv")
    assert [row["name"] for row in rows[:3]] == ["runs/a", "runs/b", "runs/b/trajectory.txt"]
    assert [row["name"] for row in rows[3:]] == ["mean", "median", "min", "max"]
    for row, noise in zip(rows, (0.005, 0.02, 0.02), strict=False):
        expected = evaluate(walk(noise), walk(), align=align)
        assert float(row["ate_rmse_m"]) == pytest.approx(expected.ate_rmse_m, rel=1e-6)
        assert float(row["rpe_rmse_deg"]) == pytest.approx(expected.rpe_deg.rmse, rel=1e-6)
        assert float(row["drift_percent"]) == pytest.approx(expected.drift.mean_translation_percent, rel=1e-6)
        assert row["align"] == align
    assert (rows[0]["tracking_percent"], rows[0]["milliseconds_median"]) == ("100", "39.5")
    assert rows[2]["tracking_percent"] == ""
    said = capsys.readouterr()
    assert said.out.startswith(
        f"Alignment {align}; ATE and RPE are root mean squares; RPE over 10 poses, drift over 10"
    )
    assert said.err == ""


@pytest.mark.usefixtures("runs")
def test_one_run_has_a_table_without_a_summary(capsys):
    assert main(["runs/a", "truth.txt"]) == 0
    assert "median" not in capsys.readouterr().out


@pytest.mark.usefixtures("runs")
def test_the_settings_of_relative_errors_hold(capsys):
    assert main(["runs/b", "truth.txt", "frames=3", "metres=0.7", "lengths=[1,2]", "out=t.csv"]) == 0
    (row,) = rows_of("t.csv")
    expected = evaluate(walk(0.02), walk(), rpe_frames=3, rpe_metres=0.7, lengths=[1, 2])
    assert expected.rpe_metres_m is not None
    assert float(row["rpe_rmse_m"]) == pytest.approx(expected.rpe_m.rmse, rel=1e-6)
    assert float(row["rpe_metres_rmse_m"]) == pytest.approx(expected.rpe_metres_m.rmse, rel=1e-6)
    assert float(row["drift_deg_per_m"]) == pytest.approx(expected.drift.mean_rotation_deg_per_m, rel=1e-6)
    assert "RPE over 3 poses, drift over 1, 2 m" in capsys.readouterr().out


@pytest.mark.usefixtures("runs")
def test_each_run_can_have_a_truth_of_its_own():
    write_tum("other.txt", walk(0.02))
    assert main(["runs/a", "runs/b", "truth=truth.txt", "truth=other.txt", "out=t.csv"]) == 0
    first, second, *_ = rows_of("t.csv")
    assert float(first["ate_rmse_m"]) > 1e-3
    assert float(second["ate_rmse_m"]) < 1e-6


def test_a_run_is_compared_with_the_truth_of_its_own_input():
    synthetic = {"width": 64, "height": 32, "frames": FRAMES, "fps": 30.0}
    truth = SyntheticSequence(SyntheticConfig(**synthetic)).truth
    assert truth is not None
    write_run("rendered", truth, input="synthetic", synthetic=synthetic)
    write_tum("gt.txt", walk())
    write_run("recorded", walk(0.005), input="gone.mp4", truth="gt.txt")
    assert main(["rendered/", "recorded", "out=t.csv"]) == 0
    rendered, recorded, *_ = rows_of("t.csv")
    assert float(rendered["ate_rmse_m"]) < 1e-6
    assert float(recorded["ate_rmse_m"]) == pytest.approx(evaluate(walk(0.005), walk()).ate_rmse_m, rel=1e-6)


@pytest.mark.usefixtures("runs")
def test_all_formats_are_written_at_once_and_the_printed_table_says_the_same(capsys):
    assert main(["runs/a", "runs/b", "truth.txt", "out=t.csv", "out=t.md", "out=t.tex"]) == 0
    printed = capsys.readouterr().out
    value = f"{float(rows_of('t.csv')[0]['ate_rmse_m']):.4g}"
    assert all(value in text for text in (printed, Path("t.md").read_text(), Path("t.tex").read_text()))


@pytest.mark.usefixtures("runs")
def test_what_cannot_be_evaluated_does_not_keep_the_others_from_it(capsys):
    write_run("late", walk(start_ns=10**12))
    Path("empty").mkdir()
    assert main(["runs/a", "late", "empty", "runs/b", "truth=truth.txt", "out=t.csv"]) == 2
    assert [row["name"] for row in rows_of("t.csv")[:2]] == ["runs/a", "runs/b"]
    late, empty = capsys.readouterr().err.splitlines()
    assert late.startswith(
        "torchvo360-eval: late: truth: expected at least 3 poses at times of the estimate (1000.000 s"
    )
    assert "got 0 (0.000 s to 1.300 s)" in late
    assert empty.startswith("torchvo360-eval: empty: expected a run's folder, with trajectory.txt")


@pytest.mark.usefixtures("runs")
@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ([], "runs: expected run folders or trajectory files"),
        (["align=se3"], "runs: expected run folders"),
        (
            ["runs/a/trajectory.txt"],
            "runs/a/trajectory.txt: expected truth=FILE, as it has no true poses of its own, got none",
        ),
        (["runs/a", "gone.txt"], "truth: gone.txt: expected a trajectory file, got No such file"),
        (["runs/a", "truth="], "truth: expected a TUM file, got an empty name"),
        (["~nobody_of_this_name/a"], "expected a known user's folder, got ~nobody_of_this_name/a"),
        (["gone", "truth=truth.txt"], "gone: expected a trajectory file, got No such file"),
        (["runs/a", "runs/b", *["truth=truth.txt"] * 3], "truth: expected one for all or 2, one for each, got 3"),
        (["runs/a", "truth.txt", "out=t.xls"], "out: expected a name that ends with .csv, .md, .tex"),
        (["runs/a", "truth.txt", "out=none/t.csv"], "t.csv: expected a folder to write to, got none"),
        (["runs/a", "truth.txt", "algin=se3"], "algin: expected a known key such as align"),
        (["runs/a", "truth.txt", "align=sim2"], "align: expected one of sim3, se3, none, got 'sim2'"),
        (["runs/a", "truth.txt", "frames=0"], "frames: expected at least 1, got 0"),
        (["runs/a", "truth.txt", "frames=few"], "frames: expected an integer, got few"),
        (["runs/a", "truth.txt", "metres=-1"], "metres: expected a finite number above 0, got -1"),
        (["runs/a", "truth.txt", "lengths=3"], "lengths: expected a list of metres such as [1,2,5], got 3"),
        (["runs/a", "truth.txt", "lengths=[1,far]"], "lengths: expected a finite number above 0, got 'far'"),
        (["--fast", "runs/a", "truth.txt"], "--fast: expected a run's folder, a trajectory, key=value or --help"),
    ],
)
def test_a_mistake_in_the_call_is_one_sentence(words, complaint, capsys):
    assert main(words) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"torchvo360-eval: {complaint}")
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (CLIP, "run: expected truth=FILE, as it has no true poses of its own, got none"),
        ({"input": "gone.mp4"}, "run, config.yaml: input: expected"),
        ({"input": "gone.mp4", "truth": "gone.txt"}, "run, config.yaml: gone.txt: expected a trajectory file"),
        ({"colour": "red"}, "run/config.yaml: expected the settings of a run, got others"),
        (["a"], "run/config.yaml: expected the settings of a run, got something else"),
        ("{", "run/config.yaml: expected the settings of a run, got a damaged file"),
        (None, "run/config.yaml: expected the settings of a run, got No such file"),
    ],
)
def test_a_run_whose_own_truth_is_out_of_reach_says_why(settings, complaint, capsys):
    write_run("run", walk())
    if settings is None:
        Path("run/config.yaml").unlink()
    else:
        Path("run/config.yaml").write_text(settings if isinstance(settings, str) else yaml.safe_dump(settings))
    assert main(["run"]) == 2
    assert capsys.readouterr().err.startswith(f"torchvo360-eval: {complaint}")


@pytest.mark.usefixtures("runs")
def test_a_table_that_cannot_be_written_keeps_neither_the_others_nor_the_complaints_back(capsys):
    assert main(["runs/a", "gone", "truth=truth.txt", "out=none/t.csv", "out=t.md", "frames=999"]) == 2
    assert Path("t.md").is_file()
    said = capsys.readouterr()
    assert "RPE over 39 poses" in said.out  # as many as there are
    assert [line.split(": ")[1] for line in said.err.splitlines()] == ["gone", "t.csv"]


@pytest.mark.usefixtures("runs")
def test_a_reader_that_goes_away_is_no_defect():
    command = [sys.executable, "-m", "torchvo360.cli.evaluate", "runs/a", "truth.txt"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


@pytest.mark.usefixtures("runs")
def test_a_name_with_an_equal_sign_is_a_file_where_there_is_one():
    Path("runs/a").rename("lr=0.1")
    assert main(["lr=0.1", "truth.txt", "out=t.csv"]) == 0
    assert rows_of("t.csv")[0]["name"] == "lr=0.1"


@pytest.mark.usefixtures("runs")
def test_the_module_is_the_command():
    command = [sys.executable, "-m", "torchvo360.cli.evaluate"]
    done = subprocess.run([*command, "--help"], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.startswith("torchvo360-eval: errors of estimated trajectories")
    assert main(["--help"]) == 0
