import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchvo360.checks import InputError, ShapeError
from torchvo360.data.trajectory import Trajectory
from torchvo360.data.tum import read_tum
from torchvo360.export import read_ply, write_ply, write_tum
from torchvo360.files import atomic_path
from torchvo360.lie import se3_exp


def trajectory(t_ns: list[int]) -> Trajectory:
    xi = torch.randn(len(t_ns), 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Trajectory(torch.tensor(t_ns, dtype=torch.int64), se3_exp(xi))


def read_by_header(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read by the header alone, as any other program would."""
    data = path.read_bytes()
    header, _, body = data.partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    kinds = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    fields = [(line.split()[2], kinds[line.split()[1]]) for line in lines if line.startswith("property")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    vertices = np.frombuffer(body, np.dtype(fields))
    assert len(vertices) == count
    return (
        np.stack([vertices[name] for name in "xyz"], -1),
        np.stack([vertices[name] for name in ("red", "green", "blue")], -1),
    )


def test_a_file_appears_under_its_name_only_when_it_is_complete(tmp_path):
    final = tmp_path / "result.png"
    with atomic_path(final) as temporary:
        temporary.write_text("half")
        assert not final.exists()
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".png"
        temporary.write_text("whole")
    assert final.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [final]


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("before", [None, "earlier"])
def test_a_failure_leaves_the_folder_as_it_was(tmp_path, failure, before):
    final = tmp_path / "result.txt"
    if before is not None:
        final.write_text(before)

    def fail():
        with atomic_path(final) as temporary:
            temporary.write_text("half")
            raise failure

    with pytest.raises(failure):
        fail()
    assert [path.name for path in tmp_path.iterdir()] == ([] if before is None else ["result.txt"])
    assert before is None or final.read_text() == before


def test_a_block_that_writes_nothing_and_a_folder_in_the_way_are_errors(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "result.txt"):
        pass
    (tmp_path / "taken").mkdir()
    with pytest.raises(OSError, match="taken"), atomic_path(tmp_path / "taken") as temporary:
        temporary.write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_a_process_that_is_killed_leaves_nothing_under_the_final_name(tmp_path):
    script = (
        "import os, sys; from torchvo360.files import atomic_path\n"
        "with atomic_path(sys.argv[1]) as path: path.write_text('half'); os._exit(1)"
    )
    final = tmp_path / "result.txt"
    assert subprocess.run([sys.executable, "-c", script, str(final)], check=False).returncode == 1
    assert not final.exists()
    assert len(list(tmp_path.iterdir())) == 1  # it was being written


def test_other_users_may_read_the_file_as_any_other_one(tmp_path):
    (tmp_path / "plain.txt").write_text("")
    write_tum(tmp_path / "poses.txt", trajectory([0]))
    assert (tmp_path / "poses.txt").stat().st_mode == (tmp_path / "plain.txt").stat().st_mode


@pytest.mark.parametrize(
    "t_ns", [[0, 33_333_333, 66_666_667], [1_403_636_579_763_555_584, 1_403_636_579_763_555_585], [-1]]
)
def test_a_trajectory_comes_back_with_every_nanosecond(tmp_path, t_ns):
    written = trajectory(t_ns)
    write_tum(tmp_path / "poses.txt", written)
    read = read_tum(tmp_path / "poses.txt")
    assert read.t_ns.tolist() == t_ns
    torch.testing.assert_close(read.T_world_cam, written.T_world_cam, atol=1e-8, rtol=1e-8)


def test_the_text_is_what_other_programs_read(tmp_path):
    write_tum(
        tmp_path / "poses.txt",
        Trajectory(torch.tensor([1_500_000_000]), torch.eye(4, dtype=torch.float64)[None]),
    )
    assert (tmp_path / "poses.txt").read_text() == "# timestamp tx ty tz qx qy qz qw\n1.500000000 0 0 0 0 0 0 1\n"


def test_evo_reads_the_trajectory(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    written = trajectory(list(range(0, 10**9, 10**8)))
    write_tum(tmp_path / "poses.txt", written)
    read = file_interface.read_tum_trajectory_file(str(tmp_path / "poses.txt"))
    np.testing.assert_allclose(np.stack(read.poses_se3), written.T_world_cam.numpy(), atol=1e-8)


@pytest.mark.parametrize("count", [0, 1, 1000])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_come_back_from_the_binary_file(tmp_path, count, dtype):
    generator = torch.Generator().manual_seed(1)
    xyz = torch.randn(count, 3, generator=generator, dtype=dtype)
    rgb = torch.randint(0, 256, (count, 3), generator=generator, dtype=torch.uint8)
    frame = torch.arange(count, dtype=torch.int32)
    write_ply(tmp_path / "map.ply", xyz, rgb, frame)
    read_xyz, read_rgb = read_by_header(tmp_path / "map.ply")
    np.testing.assert_array_equal(read_xyz, xyz.float().numpy())
    np.testing.assert_array_equal(read_rgb, rgb.numpy())
    for read, written in zip(read_ply(tmp_path / "map.ply"), (xyz.float(), rgb, frame), strict=True):
        assert torch.equal(read, written)


def test_points_of_a_file_that_is_missing_cut_off_or_another_are_refused(tmp_path):
    path = tmp_path / "map.ply"
    with pytest.raises(InputError, match="expected a point cloud, got none"):
        read_ply(path)
    write_ply(path, torch.zeros(5, 3), torch.zeros(5, 3, dtype=torch.uint8), torch.zeros(5).int())
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    with pytest.raises(InputError, match="the file is cut off"):
        read_ply(path)
    path.write_bytes(whole.replace(b"property int frame\n", b""))
    with pytest.raises(InputError, match="as torchvo360 writes it, got another file"):
        read_ply(path)


@pytest.mark.parametrize(
    ("xyz", "rgb", "error", "message"),
    [
        (torch.zeros(4, 2), torch.zeros(4, 3, dtype=torch.uint8), ShapeError, "xyz: expected shape"),
        (torch.zeros(4, 3), torch.zeros(5, 3, dtype=torch.uint8), ShapeError, "rgb: expected shape"),
        (torch.zeros(4, 3), torch.zeros(4, 3), InputError, "rgb: expected uint8"),
        (torch.zeros(4, 3).long(), torch.zeros(4, 3, dtype=torch.uint8), InputError, "xyz: expected a floating"),
        (torch.full((4, 3), torch.nan), torch.zeros(4, 3, dtype=torch.uint8), InputError, "xyz: expected finite"),
    ],
)
def test_bad_points_are_refused_and_nothing_is_written(tmp_path, xyz, rgb, error, message):
    with pytest.raises(error, match=f"^{message}"):
        write_ply(tmp_path / "map.ply", xyz, rgb, torch.zeros(4).int())
    assert not list(tmp_path.iterdir())
