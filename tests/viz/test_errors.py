"""The picture of the errors over time, and the errors themselves."""

import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import se3, se3_exp, so3_exp
from torchvo360.viz.deviation import deviation

ORIGIN = torch.zeros(3, dtype=torch.float64)


def circle(frames: int = 60) -> Trajectory:
    angle = torch.linspace(0, 5.5, frames, dtype=torch.float64)
    zero = torch.zeros_like(angle)
    t = torch.stack([2 * angle.sin(), 0.1 * (3 * angle).sin(), 2 * angle.cos()], -1)
    return Trajectory((angle * 1e9).long(), se3(so3_exp(torch.stack([zero, angle, zero], -1)), t))


def in_another_world(trajectory: Trajectory, scale: float = 1.0) -> Trajectory:
    T = se3_exp(torch.tensor([5, -3, 1, 0.3, 2.0, -0.6], dtype=torch.float64)) @ trajectory.T_world_cam
    T[:, :3, 3] *= scale
    return Trajectory(trajectory.t_ns, T)


def test_a_perfect_estimate_in_any_world_and_unit_has_no_error():
    found = deviation(in_another_world(circle(), 0.3), circle())
    assert found.row.tolist() == list(range(60))
    assert float(found.position_m.max()) < 1e-9
    assert float(found.rotation_deg.max()) < 1e-5


def test_a_single_wrong_pose_stands_out_by_as_much_as_it_is_wrong():
    wrong = circle().T_world_cam.clone()
    wrong[30] = wrong[30] @ se3(so3_exp(torch.tensor([0, 0, 0.1], dtype=torch.float64)), ORIGIN)
    wrong[30, 1, 3] += 0.2
    found = deviation(in_another_world(Trajectory(circle().t_ns, wrong), 0.3), circle())
    assert int(found.position_m.argmax()) == int(found.rotation_deg.argmax()) == 30
    assert float(found.position_m[30]) == pytest.approx(0.2, rel=0.1)
    assert float(found.rotation_deg[30]) == pytest.approx(math.degrees(0.1), rel=0.1)


def test_the_errors_are_those_of_the_evaluation():
    from torchvo360.evaluation import evaluate

    noise = se3_exp(0.02 * torch.randn(60, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    estimate = in_another_world(Trajectory(circle().t_ns, circle().T_world_cam @ noise), 0.3)
    found, figures = deviation(estimate, circle()), evaluate(estimate, circle())
    assert float(found.position_m.square().mean().sqrt()) == pytest.approx(figures.ate_rmse_m)
    assert float(found.rotation_deg.median()) == pytest.approx(figures.rotation_median_deg)
    torch.testing.assert_close(found.S_truth_world, figures.T_truth_estimate)


def test_poses_without_a_true_one_are_left_out():
    truth = Trajectory(circle().t_ns[10:40:2], circle().T_world_cam[10:40:2])
    assert deviation(circle(), truth).row.tolist() == list(range(10, 40, 2))


def tinted(path, colour: str) -> int:
    """The number of pixels in a state's colour, as it lies on white with an opacity of 0.3."""
    image = cv2.imread(str(path))
    assert image is not None
    assert image.shape[0] > 500
    rgb = np.array(list(bytes.fromhex(colour[1:])))
    return int((np.abs(image[..., ::-1].astype(int) - (0.3 * rgb + 0.7 * 255)).max(-1) <= 2).sum())


def test_unusual_states_are_tinted_and_the_usual_one_is_not(tmp_path):
    pytest.importorskip("matplotlib")
    from torchvo360.viz import plot_errors
    from torchvo360.viz.plots import STATE_COLOURS

    noise = se3_exp(0.02 * torch.randn(60, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    estimate = Trajectory(circle().t_ns, circle().T_world_cam @ noise)
    states = ["tracking"] * 30 + ["lost"] * 20 + ["weak"] * 10
    plot_errors(tmp_path / "errors.png", estimate, circle(), states=states, title="walk")
    plot_errors(tmp_path / "plain.png", estimate, circle())
    lost, weak, tracking = (tinted(tmp_path / "errors.png", STATE_COLOURS[s]) for s in ("lost", "weak", "tracking"))
    assert lost > 1.5 * weak > 0
    assert tracking < 0.01 * weak
    assert tinted(tmp_path / "plain.png", STATE_COLOURS["lost"]) < 0.01 * lost


def test_bad_arguments_are_refused_and_nothing_is_written(tmp_path):
    pytest.importorskip("matplotlib")
    from torchvo360.viz import plot_errors

    with pytest.raises(InputError, match=r"^states: expected one for each of the 60 poses, got 2"):
        plot_errors(tmp_path / "a.png", circle(), circle(), states=["tracking", "lost"])
    with pytest.raises(InputError, match=r"^truth: expected at least 3 poses"):
        plot_errors(tmp_path / "a.png", circle(), circle(2))
    assert not list(tmp_path.iterdir())


def test_a_missing_matplotlib_is_named_with_the_extra_that_brings_it():
    script = (
        "import sys; sys.modules['matplotlib'] = None\n"
        "import torch; from torchvo360.viz import plot_errors; from torchvo360.data import Trajectory\n"
        "T = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)\n"
        "three = Trajectory(torch.arange(3), T)\n"
        "plot_errors('never.png', three, three)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "ModuleNotFoundError: plots: expected matplotlib, which `pip install torchvo360[viz]` brings." in done.stderr
