"""What is read of a run's folder and of a trajectory alone, and how a damaged one is refused."""

import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data.trajectory import Trajectory
from torchvo360.evaluation.estimate import read_estimate
from torchvo360.export import write_tum

HEADER = "index,time,state,reason,residual,inliers,a,b,milliseconds\n"


@pytest.fixture
def folder(tmp_path):
    """A run of four frames."""
    poses = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    poses[:, 0, 3] = torch.arange(4)
    write_tum(tmp_path / "trajectory.txt", Trajectory(torch.arange(4) * 10**8, poses))
    states = ("initialising", "tracking", "tracking", "lost")
    rows = (f"{index},{index / 10},{state},ok,,,0,0,{10 * index}\n" for index, state in enumerate(states))
    (tmp_path / "frames.csv").write_text(HEADER + "".join(rows))
    return tmp_path


def test_a_runs_folder_tells_poses_states_and_times(folder):
    estimate = read_estimate(folder)
    assert len(estimate.trajectory) == 4
    assert estimate.states == {"initialising": 1, "tracking": 2, "lost": 1}
    assert estimate.milliseconds == (0, 10, 20, 30)
    assert estimate.name == str(folder)


def test_a_trajectory_alone_and_a_folder_without_frames_have_no_states(folder):
    assert read_estimate(folder / "trajectory.txt").states == {}
    (folder / "frames.csv").unlink()
    assert read_estimate(folder).milliseconds == ()


def test_a_frame_without_a_time_counts_by_its_state_alone(folder):
    (folder / "frames.csv").write_text(HEADER + "0,0,weak,ok,,,,,\n1,0.1,weak,ok,,,,,5\n")
    estimate = read_estimate(folder)
    assert (estimate.states["weak"], estimate.milliseconds) == (2, (5,))


@pytest.mark.parametrize("line", ["0,0,asleep,ok,,,,,5", "0,0,weak,ok,,,,,soon", "0,0"])
def test_damaged_frames_are_told_by_file_and_line(folder, line):
    (folder / "frames.csv").write_text(f"{HEADER}0,0,weak,ok,,,,,5\n{line}\n")
    with pytest.raises(InputError, match=r"frames\.csv, line 3: expected a known state and a time"):
        read_estimate(folder)


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"expected a run's folder, with trajectory\.txt, or a TUM file"):
        read_estimate(tmp_path)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", r"expected lines `timestamp tx ty tz qx qy qz qw`, got none"),
        ("# nothing\n", "got none"),
        ("0 0 0 0 0 0 0 1\n0.1 0 0 0\n", r"trajectory\.txt, line 2: expected 8 numbers"),
        ("0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", r"line 2: expected a time later"),
    ],
)
def test_an_empty_or_damaged_trajectory_is_told_by_file_and_line(folder, text, complaint):
    (folder / "trajectory.txt").write_text(text)
    with pytest.raises(InputError, match=complaint):
        read_estimate(folder)
