from pathlib import Path

import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data.tum import read_tum
from torchvo360.lie import so3_exp

LINE = "1.5 1 2 3 0 0 0 1"


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "poses.txt"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_line_is_time_translation_and_quaternion_with_the_real_part_last(tmp_path):
    trajectory = read_tum(written(tmp_path, "# timestamp tx ty tz qx qy qz qw\n\n2.25 1 2 3 0 0.6 0 0.8\n"))
    assert trajectory.t_ns.tolist() == [2_250_000_000]
    assert trajectory.t_ns.dtype == torch.int64
    assert trajectory.T_world_cam.dtype == torch.float64
    angle = 2 * torch.atan2(torch.tensor(0.6, dtype=torch.float64), torch.tensor(0.8, dtype=torch.float64))
    expected = so3_exp(torch.stack([torch.zeros_like(angle), angle, torch.zeros_like(angle)]))
    torch.testing.assert_close(trajectory.T_world_cam[0, :3, :3], expected)
    assert trajectory.positions.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    ("word", "t_ns"),
    [
        ("1305031526.671473123", 1_305_031_526_671_473_123),  # a float64 is off by up to 119 ns here
        ("0.033333333", 33_333_333),
        ("-0.5", -500_000_000),
        ("1e-9", 1),
        ("1.40363657925e9", 1_403_636_579_250_000_000),
    ],
)
def test_times_keep_every_nanosecond(tmp_path, word, t_ns):
    assert read_tum(written(tmp_path, f"{word} 0 0 0 0 0 0 1")).t_ns.tolist() == [t_ns]


def test_a_quaternion_of_another_length_is_normalised(tmp_path):
    twice = read_tum(written(tmp_path, "0 0 0 0 0 0.2 0.4 1.6"))
    once = read_tum(written(tmp_path, "0 0 0 0 0 0.1 0.2 0.8"))
    torch.testing.assert_close(twice.T_world_cam, once.T_world_cam)


def test_windows_line_ends_a_byte_order_mark_and_tabs_are_read(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_bytes(b"\xef\xbb\xbf# comment\r\n0 1 2 3 0 0 0 1\r\n1\t1 2 3  0 0 0 1\r\n")
    assert len(read_tum(path)) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected lines `timestamp tx ty tz qx qy qz qw`, got none"),
        ("# only a comment\n", "got none"),
        (f"{LINE}\n2 1 2 3 0 0 0\n", "line 2: expected 8 numbers, .* got 7"),
        (f"# comment\n{LINE}\n2 1 2 3 0 0 0 1 9\n", "line 3: expected 8 numbers, .* got 9"),
        ("1 2 three 4 0 0 0 1\n", "line 1: expected 8 numbers, .* got '1 2 three"),
        ("time 1 2 3 0 0 0 1\n", "line 1: expected 8 numbers"),
        ("nan 1 2 3 0 0 0 1\n", "line 1: expected finite numbers"),
        ("inf 1 2 3 0 0 0 1\n", "line 1: expected finite numbers"),
        ("1 1 nan 3 0 0 0 1\n", "line 1: expected finite numbers"),
        ("1 1 2 3 0 0 inf 1\n", "line 1: expected finite numbers"),
        ("1 1 2 3 0 0 0 0\n", "line 1: expected a unit quaternion .* got zero"),
        (f"{LINE}\n{LINE}\n", "line 2: expected a time later than the line before, got 1.5"),
        (f"{LINE}\n1.4 1 2 3 0 0 0 1\n", "line 2: expected a time later .* got 1.4"),
        ("1e300 1 2 3 0 0 0 1\n", "line 1: expected a time in seconds"),
    ],
)
def test_a_bad_line_is_named_by_its_number(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(InputError, match=message) as refused:
        read_tum(path)
    assert str(refused.value).startswith(str(path))
    assert str(refused.value).count(". ") == 0  # one sentence


def test_a_missing_file_a_folder_and_a_binary_file_are_refused(tmp_path):
    for path in (tmp_path / "absent.txt", tmp_path):
        with pytest.raises(InputError, match="expected a trajectory file, got"):
            read_tum(path)
    binary = tmp_path / "image.txt"
    binary.write_bytes(b"\xff\xd8\xff\xe0" + bytes(range(256)))
    with pytest.raises(InputError, match="got a binary file"):
        read_tum(binary)
