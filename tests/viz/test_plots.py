import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from torchvo360.checks import InputError, ShapeError
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import se3, se3_exp, sim3_exp, so3_exp

pytest.importorskip("matplotlib")
from torchvo360.viz.plots import (
    STATE_COLOURS,
    TRUTH_COLOUR,
    _upright_view,
    plot_trajectory,
)
from torchvo360.vo import PointCloud

EYE = torch.eye(3, dtype=torch.float64)


def circle(frames: int = 60, *, tall: float = 1.0) -> Trajectory:
    """A loop in the plane of x and z, the camera upright, y down."""
    angle = torch.linspace(0, 5.5, frames, dtype=torch.float64)
    zero = torch.zeros_like(angle)
    t = torch.stack([2 * angle.sin(), 0.1 * (3 * angle).sin(), 2 * tall * angle.cos()], -1)
    return Trajectory((angle * 1e9).long(), se3(so3_exp(torch.stack([zero, angle, zero], -1)), t))


def patch(centre: tuple[float, float, float], colour: str, *, size: float = 0.5, count: int = 2000) -> PointCloud:
    """Points of one colour in a cube about a place."""
    xyz = torch.tensor(centre) + size * (torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    rgb = torch.tensor(list(bytes.fromhex(colour[1:])), dtype=torch.uint8).expand(count, 3)
    return PointCloud(xyz, rgb, torch.zeros(count).int())


def joined(*clouds: PointCloud) -> PointCloud:
    return PointCloud(*(torch.cat([getattr(cloud, name) for cloud in clouds]) for name in ("xyz", "rgb", "frame")))


def read(path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image


def places(path, colour: str) -> np.ndarray:
    """Column and row of the pixels of the picture that have a colour."""
    image = read(path)
    return np.argwhere((image == list(bytes.fromhex(colour[1:]))[::-1]).all(-1))[:, ::-1]


def colours(path) -> set[str]:
    """The colours that at least a few pixels of the picture have."""
    image = read(path)
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
        pictures.append(read(tmp_path / name))
    assert float(np.abs(pictures[0].astype(int) - pictures[1]).mean()) < 0.01


def test_without_truth_the_picture_does_not_depend_on_the_world(tmp_path):
    T = se3_exp(torch.tensor([5, -3, 1, 0.3, 2.0, -0.6], dtype=torch.float64))
    for name, drawn in (("a.png", circle()), ("b.png", Trajectory(circle().t_ns, T @ circle().T_world_cam))):
        plot_trajectory(tmp_path / name, drawn)
    a, b = (read(tmp_path / name).astype(int) for name in ("a.png", "b.png"))
    assert float(np.abs(a - b).mean()) < 0.01


EAST, SOUTH = "#A03C14", "#14A03C"


@pytest.fixture
def walls() -> PointCloud:
    """Two walls about the loop, in colours of their own: to the right of the first camera, and behind it."""
    start = circle().T_world_cam[0, :3, 3]
    assert start.tolist() == [0, 0, 2]
    return joined(patch((3, 0, 0), EAST), patch((0, 0, -3), SOUTH))


@pytest.mark.parametrize("with_truth", [False, True])
def test_the_map_is_drawn_in_its_colours_where_it_is(tmp_path, walls, with_truth):
    # the true world: z up, and of another scale; as seen from above its y axis is the camera's forward
    S = se3(so3_exp(torch.tensor([-math.pi / 2, 0, 0], dtype=torch.float64)), torch.tensor([3.0, 1, 2]).double())
    true_T = S @ circle().T_world_cam
    true_T[:, :3, 3] *= 2.5
    truth = Trajectory(circle().t_ns, true_T) if with_truth else None
    plot_trajectory(tmp_path / "map.png", circle(), truth=truth, points=walls, states=["lost"] * 60)
    path = places(tmp_path / "map.png", STATE_COLOURS["lost"])
    path = path[path[:, 1] < 0.68 * read(tmp_path / "map.png").shape[0]]  # the height is drawn below
    middle = (path.min(0) + path.max(0)) / 2
    east, south = (places(tmp_path / "map.png", colour) for colour in (EAST, SOUTH))
    assert len(east) > 100
    assert len(south) > 100
    radius = np.ptp(path[:, 0]) / 2  # 2 of the odometry's units
    np.testing.assert_allclose((np.median(east, 0) - middle) / radius, [1.5, 0], atol=0.1)
    np.testing.assert_allclose((np.median(south, 0) - middle) / radius, [0, 1.5], atol=0.1)


def test_far_points_do_not_change_the_view(tmp_path, walls):
    far = patch((0, 0, 0), "#3C14A0", size=1000.0, count=60)
    far.xyz[:, 1] = 0
    for name, points in (("near.png", walls), ("far.png", joined(walls, far))):
        plot_trajectory(tmp_path / name, circle(), points=points)
    near, with_far = (places(tmp_path / name, STATE_COLOURS["tracking"]) for name in ("near.png", "far.png"))
    np.testing.assert_allclose(np.ptp(with_far, 0), np.ptp(near, 0), rtol=0.03)


def test_floor_and_ceiling_do_not_cover_the_walls(tmp_path, walls):
    ceiling, floor = (patch((0, y, 0), c, size=0.3, count=500) for y, c in ((-2, "#3C14A0"), (2, "#14143C")))
    plot_trajectory(tmp_path / "room.png", circle(), points=joined(walls, ceiling, floor))
    seen = colours(tmp_path / "room.png")
    assert {EAST, SOUTH} <= seen
    assert not {"#3C14A0", "#14143C"} & seen


def test_without_points_the_picture_is_that_of_the_path_alone(tmp_path):
    none = PointCloud(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8), torch.zeros(0).int())
    for name, points in (("path.png", None), ("none.png", none)):
        plot_trajectory(tmp_path / name, circle(), points=points)
    assert (tmp_path / "none.png").read_bytes() == (tmp_path / "path.png").read_bytes()


def test_points_that_are_not_finite_are_left_out(tmp_path, walls):
    nowhere = torch.tensor([[math.nan] * 3, [math.inf, 0, 0]])
    bad = PointCloud(nowhere, torch.zeros(2, 3, dtype=torch.uint8), torch.zeros(2).int())
    for name, points in (("walls.png", walls), ("bad.png", joined(bad, walls))):
        plot_trajectory(tmp_path / name, circle(), points=points)
    assert (tmp_path / "bad.png").read_bytes() == (tmp_path / "walls.png").read_bytes()


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
    uneven = PointCloud(torch.zeros(2, 3), torch.zeros(3, 3).byte(), torch.zeros(2).int())
    with pytest.raises(ShapeError, match=r"^points.rgb"):
        plot_trajectory(tmp_path / "a.png", circle(), points=uneven)
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
