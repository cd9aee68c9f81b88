from pathlib import Path

import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data.imu import read_imu_csv

HEADER = "#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_RS_S_x [m s^-2],a_y,a_z\n"
T0 = 1_403_715_523_912_140_001
STEP = 5_000_000


def line(k: int, t_ns: int | str | None = None) -> str:
    return f"{T0 + k * STEP if t_ns is None else t_ns},{k}.5,-0.02,0.07,9.2,0.3,-3.15\n"


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "data.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_times_keep_every_nanosecond_and_rates_come_before_forces(tmp_path):
    samples = read_imu_csv(written(tmp_path, HEADER + "".join(map(line, range(5)))))
    assert samples.t_ns.tolist() == [T0 + k * STEP for k in range(5)]  # a float64 is off by up to 128 ns here
    assert samples.period_ns == STEP
    assert samples.gyro[2].tolist() == [2.5, -0.02, 0.07]
    assert samples.accel[2].tolist() == [9.2, 0.3, -3.15]
    assert (samples.gyro.dtype, samples.accel.dtype) == (torch.float64, torch.float64)


def test_windows_line_ends_a_byte_order_mark_blank_lines_and_spaces_are_read(tmp_path):
    path = tmp_path / "data.csv"
    text = "\ufeff" + HEADER + line(0) + "\n" + line(1).replace(",", " , ")
    path.write_bytes(text.replace("\n", "\r\n").encode())
    assert read_imu_csv(str(path)).t_ns.tolist() == [T0, T0 + STEP]


def test_gaps_and_times_from_zero_are_read(tmp_path):
    text = "".join(line(0, t_ns) for t_ns in (0, STEP, 2 * STEP, 3 * STEP, 2_000_000_000))
    assert read_imu_csv(written(tmp_path, text)).t_ns[-1] == 2_000_000_000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected lines `timestamp .* got none"),
        (HEADER, "got none"),
        (line(0), "expected at least two samples, got 1"),
        (HEADER + line(0) + f"{T0 + STEP},1,2,3,4,5\n", "line 3: expected 7 columns, .* got 6"),
        (HEADER + line(0) + f"{T0 + STEP},1,2,3,4,5,6,7\n", "line 3: expected 7 columns, .* got 8"),
        (HEADER + line(0).replace(",", " "), "line 2: expected 7 columns, .* got 1"),
        (line(0) + "\n" + line(1).replace("9.2", "fast"), "line 3: expected numbers, .* got 'fast'"),
        (line(0) + line(1).replace("9.2", ""), "line 2: expected numbers, .* got ''"),
        (line(0) + line(1).replace("9.2", "nan"), "line 2: expected finite numbers, got 'nan'"),
        (line(0) + line(1).replace("9.2", "1e999"), "line 2: expected finite numbers, got '1e999'"),
        (line(0) + line(2) + line(1), "line 3: expected a time later than the line before, got 14"),
        (line(0) + line(1) + line(1), "line 3: expected a time later than the line before"),
        ("time,w,w,w,a,a,a\n" + line(0), "line 1: expected a time in whole nanoseconds, got 'time'"),
        (line(0, "1403715523.912") + line(0, "1403715523.917"), "line 1: .* nanoseconds, got .*looks like seconds"),
        (line(0, "1.403715523912140032e18") + line(1), "line 1: expected a time in whole nanoseconds, got '1.40"),
        (line(0) + line(1, "9" * 30), "line 2: expected a time in whole nanoseconds, got 999"),
        (line(0) + line(1, "9" * 5000), "line 2: expected a time in whole nanoseconds"),
        (
            "".join(line(0, t) for t in range(0, 25_000, 5000)),
            "expected times in nanoseconds, got a median step of 5000",
        ),
        (
            "".join(line(0, t) for t in range(0, 400_000_000, 100_000_000)),
            "expected at least 20 samples a second, got 10",
        ),
        (line(0) + line(1).replace("9.2", "-1e200"), "line 2: expected numbers up to 100000, got -1e200"),
        ("".join(map(line, range(50))), "expected angular rates in rad/s, got a median of 25"),
        (line(0).replace("9.2,0.3,-3.15", "0,0,1") + line(1).replace("9.2,0.3,-3.15", "0,0,1"), "got a median of 1"),
        (line(0).replace("9.2,0.3,-3.15", "0,0,0") + line(1).replace("9.2,0.3,-3.15", "0,0,0"), "got a median of 0"),
    ],
)
def test_a_bad_file_is_refused_in_one_sentence_with_the_line(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(InputError, match=message) as refused:
        read_imu_csv(path)
    sentence = str(refused.value)
    assert sentence.startswith(str(path))
    assert sentence.count(". ") == 0
    assert len(sentence) < len(str(path)) + 200


def test_a_missing_file_a_folder_and_a_binary_file_are_refused(tmp_path):
    for path in (tmp_path / "absent.csv", tmp_path):
        with pytest.raises(InputError, match="expected a text file"):
            read_imu_csv(path)
    binary = tmp_path / "image.csv"
    binary.write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="got a binary file"):
        read_imu_csv(binary)


def test_a_real_recording_measures_gravity(shared):
    samples = read_imu_csv(shared / "data" / "imu" / "euroc_v1_02_40s" / "mav0" / "imu0" / "data.csv")
    assert samples.period_ns == STEP
    assert float(samples.accel[:200].norm(dim=-1).mean()) == pytest.approx(9.81, abs=0.3)
