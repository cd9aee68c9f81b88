"""Trajectories as KITTI's and EuRoC's: our readers and evo's find what was written."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from torchvo360.checks import InputError, ShapeError
from torchvo360.data.euroc import open_euroc
from torchvo360.data.kitti import open_kitti
from torchvo360.data.selection import Selection
from torchvo360.data.trajectory import Trajectory
from torchvo360.export.euroc import HEADER, write_euroc
from torchvo360.export.kitti import poses_at, write_kitti
from torchvo360.lie import se3_exp, se3_inverse, so3_angle

ALL = Selection(0, None, 1)


def wandering(count: int) -> Trajectory:
    xi = torch.randn(count, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Trajectory(1_403_636_579_763_555_584 + 50_000_000 * torch.arange(count), se3_exp(xi))


def write_images(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.full((16, 24, 3), 90, np.uint8))


def test_the_kitti_reader_finds_the_poses_relative_to_the_first(tmp_path):
    written = wandering(5)
    folder = tmp_path / "sequences" / "07"
    write_images(folder / "image_2", [f"{number:06d}.png" for number in range(5)])
    (folder / "times.txt").write_text("\n".join(f"{0.1 * number:e}" for number in range(5)))
    (folder / "calib.txt").write_text("P2: 20 0 12 0 0 20 8 0 0 0 1 0\n")
    (tmp_path / "poses").mkdir()
    write_kitti(tmp_path / "poses" / "07.txt", written.T_world_cam)
    truth = open_kitti(folder, selection=ALL, stereo=False).truth
    assert truth is not None
    expected = se3_inverse(written.T_world_cam[0]) @ written.T_world_cam
    torch.testing.assert_close(truth.T_world_cam, expected, atol=1e-10, rtol=0)
    torch.testing.assert_close(truth.T_world_cam[0], torch.eye(4, dtype=torch.float64), atol=1e-12, rtol=0)


def test_the_euroc_reader_finds_poses_and_every_nanosecond(tmp_path):
    written = wandering(5)
    camera = tmp_path / "mav0" / "cam0"
    write_images(camera / "data", [f"{t_ns}.png" for t_ns in written.t_ns.tolist()])
    (camera / "data.csv").write_text("\n".join(f"{t_ns},{t_ns}.png" for t_ns in written.t_ns.tolist()))
    settings = {
        "camera_model": "pinhole",
        "intrinsics": [20.0, 20.0, 11.5, 7.5],
        "resolution": [24, 16],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [0.0] * 4,
        "T_BS": {"rows": 4, "cols": 4, "data": np.eye(4).ravel().tolist()},
    }
    (camera / "sensor.yaml").write_text(yaml.safe_dump(settings))
    (tmp_path / "mav0" / "state_groundtruth_estimate0").mkdir()
    write_euroc(tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv", written)
    truth = open_euroc(tmp_path, selection=ALL, stereo=False).truth
    assert truth is not None
    assert truth.t_ns.tolist() == written.t_ns.tolist()
    torch.testing.assert_close(truth.T_world_cam, written.T_world_cam, atol=1e-10, rtol=0)


def test_evo_reads_both(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    written = wandering(6)
    write_kitti(tmp_path / "poses.txt", written.T_world_cam)
    write_euroc(tmp_path / "data.csv", written)
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "poses.txt"))
    relative = se3_inverse(written.T_world_cam[0]) @ written.T_world_cam
    np.testing.assert_allclose(np.stack(kitti.poses_se3), relative.numpy(), atol=1e-10)
    euroc = file_interface.read_euroc_csv_trajectory(str(tmp_path / "data.csv"))
    np.testing.assert_allclose(np.stack(euroc.poses_se3), written.T_world_cam.numpy(), atol=1e-10)
    np.testing.assert_allclose(euroc.timestamps, written.t_ns.numpy() / 1e9, atol=1e-6)


def test_the_texts_are_what_the_formats_say(tmp_path):
    still = Trajectory(torch.tensor([1_500_000_000]), torch.eye(4, dtype=torch.float64)[None])
    write_kitti(tmp_path / "poses.txt", still.T_world_cam)
    assert (tmp_path / "poses.txt").read_text() == "1 0 0 0 0 1 0 0 0 0 1 0\n"
    write_euroc(tmp_path / "data.csv", still)
    assert (tmp_path / "data.csv").read_text() == f"{HEADER}\n1500000000,0,0,0,1,0,0,0\n"


def test_a_pose_between_two_lies_on_the_motion_between_them():
    known = wandering(3)
    middle = (known.t_ns[0] + known.t_ns[1]) // 2
    T = poses_at(known, torch.stack([known.t_ns[0], middle, known.t_ns[1], known.t_ns[2]]))
    torch.testing.assert_close(T[[0, 2, 3]], known.T_world_cam, atol=1e-9, rtol=0)
    half = se3_inverse(T[0]) @ T[1]
    torch.testing.assert_close(T[0] @ half @ half, T[2], atol=1e-9, rtol=0)
    assert float(so3_angle(half[:3, :3])) > 0.01


def test_times_beyond_a_trajectory_get_its_first_and_last_pose():
    known = wandering(3)
    T = poses_at(known, torch.stack([known.t_ns[0] - 10**9, known.t_ns[2] + 10**9]))
    torch.testing.assert_close(T, known.T_world_cam[[0, 2]], atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    ("T", "error", "message"),
    [
        (torch.zeros(0, 4, 4, dtype=torch.float64), InputError, "expected at least one pose, got none"),
        (torch.zeros(2, 4, 4, dtype=torch.float64), InputError, "expected rigid motions"),
        (torch.zeros(2, 3, 4, dtype=torch.float64), ShapeError, "expected shape"),
    ],
)
def test_poses_that_are_none_are_refused_and_nothing_is_written(tmp_path, T, error, message):
    with pytest.raises(error, match=message):
        write_kitti(tmp_path / "poses.txt", T)
    assert not list(tmp_path.iterdir())
