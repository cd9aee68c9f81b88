import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import se3, se3_exp, sim3_exp, so3_exp

pytest.importorskip("matplotlib")
from torchvo360.viz.plots import STATE_COLOURS, TRUTH_COLOUR, _upright_view, plot_trajectory

EYE = torch.eye(3, dtype=torch.float64)


def circle(frames: int = 60, *, tall: float = 1.0) -> Trajectory:
    """A loop in the plane of x and z, the camera upright, y down."""
    angle = torch.linspace(0, 5.5, frames, dtype=torch.float64)
    zero = torch.zeros_like(angle)
    t = torch.stack([2 * angle.sin(), 0.1 * (3 * angle).sin(), 2 * tall * angle.cos()], -1)
    return Trajectory((angle * 1e9).long(), se3(so3_exp(torch.stack([zero, angle, zero], -1)), t))


def colours(path) -> set[str]:
    """The colours that at least a few pixels of the picture have."""
    image = cv2.imread(str(path))
    assert image is not None
    assert image.shape[0] > 500
    assert image.shape[1] > 800
    values, counts = np.unique(image.astype(np.int64) @ [1, 1 << 8, 1 << 16], return_counts=True)
    return {f"#{value:06X}" for value, count in zip(values, counts, strict=True) if count > 20}


@pytest.mark.parametrize("tall", [0.3, 3.0])
def test_every_state_and_the_truth_are_seen(tmp_path, tall):
    truth = circle(tall=tall)
    states = [word for word in STATE_COLOURS for _ in range(12)]
    plot_trajectory(tmp_path / "all.png", truth, truth=truth, states=states, title="all")
    assert {*STATE_COLOURS.values(), TRUTH_COLOUR} <= colours(tmp_path / "all.png")
    plot_trajectory(tmp_path / "plain.png", truth)
    assert STATE_COLOURS["tracking"] in colours(tmp_path / "plain.png")
    assert not {STATE_COLOURS["lost"], STATE_COLOURS["weak"]} & colours(tmp_path / "plain.png")


def test_with_truth_the_picture_does_not_depend_on_the_world_of_the_estimate(tmp_path):
    truth = circle()
    noise = 0.02 * torch.randn(60, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    estimate = Trajectory(truth.t_ns, se3_exp(noise) @ truth.T_world_cam)
    S = sim3_exp(torch.tensor([1, 2, 3, 0.5, -0.4, 2.0, 0.7], dtype=torch.float64))
    T = S @ estimate.T_world_cam
    T[:, :3, :3] /= math.exp(0.7)
    pictures = []
    for name, drawn in (("a.png", estimate), ("b.png", Trajectory(truth.t_ns, T))):
        plot_trajectory(tmp_path / name, drawn, truth=truth)
        pictures.append(cv2.imread(str(tmp_path / name)))
    assert float(np.abs(pictures[0].astype(int) - pictures[1]).mean()) < 0.01


def test_without_truth_the_picture_does_not_depend_on_the_world(tmp_path):
    T = se3_exp(torch.tensor([5, -3, 1, 0.3, 2.0, -0.6], dtype=torch.float64))
    for name, drawn in (("a.png", circle()), ("b.png", Trajectory(circle().t_ns, T @ circle().T_world_cam))):
        plot_trajectory(tmp_path / name, drawn)
    a, b = (cv2.imread(str(tmp_path / name)).astype(int) for name in ("a.png", "b.png"))
    assert float(np.abs(a - b).mean()) < 0.01


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_height_is_the_axis_of_the_world_that_points_up_and_the_view_is_no_mirror(axis, sign):
    up = sign * EYE[axis]
    down_to_up = torch.linalg.cross(torch.tensor([0.0, -1, 0], dtype=torch.float64), up)
    if float(down_to_up.norm()) < 1e-9:
        R = EYE if sign < 0 else so3_exp(torch.tensor([math.pi, 0, 0], dtype=torch.float64))
    else:
        R = so3_exp(down_to_up / down_to_up.norm() * math.pi / 2)
    tilt = so3_exp(torch.tensor([0.2, 0.1, 0.3], dtype=torch.float64))
    view = _upright_view(Trajectory(circle().t_ns, se3(tilt @ R, EYE[0]) @ circle().T_world_cam))
    torch.testing.assert_close(view.R_view_world[2], up)
    assert float(torch.linalg.det(view.R_view_world)) == pytest.approx(1)
    assert view.labels[2] == f"{'' if sign > 0 else '−'}{'xyz'[axis]} (m)"


@pytest.mark.parametrize("frames", [1, 2])
def test_a_short_or_motionless_trajectory_is_drawn(tmp_path, frames):
    still = Trajectory(torch.arange(frames), torch.eye(4, dtype=torch.float64).expand(frames, 4, 4))
    plot_trajectory(tmp_path / "still.png", still, states=["initialising"] * frames)
    assert len(colours(tmp_path / "still.png")) > 1


def test_bad_arguments_are_refused_and_nothing_is_written(tmp_path):
    empty = Trajectory(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4, 4, dtype=torch.float64))
    with pytest.raises(InputError, match=r"^estimate: expected at least one pose, got none"):
        plot_trajectory(tmp_path / "a.png", empty)
    with pytest.raises(InputError, match=r"^states: expected one for each of the 60 poses, got 2"):
        plot_trajectory(tmp_path / "a.png", circle(), states=["tracking", "lost"])
    with pytest.raises(InputError, match=r"^truth: expected at least 3 poses"):
        plot_trajectory(tmp_path / "a.png", circle(), truth=circle(2))
    assert not list(tmp_path.iterdir())


def test_a_missing_matplotlib_is_named_with_the_extra_that_brings_it():
    script = (
        "import sys; sys.modules['matplotlib'] = None\n"
        "import torch; from torchvo360.viz import plot_trajectory; from torchvo360.data import Trajectory\n"
        "one = Trajectory(torch.zeros(1, dtype=torch.int64), torch.eye(4, dtype=torch.float64)[None])\n"
        "plot_trajectory('never.png', one)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "ModuleNotFoundError: plots: expected matplotlib, which `pip install torchvo360[viz]` brings." in done.stderr
