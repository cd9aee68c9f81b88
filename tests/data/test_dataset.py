from pathlib import Path

import pytest

from torchvo360.cameras import Pinhole
from torchvo360.checks import InputError
from torchvo360.data.dataset import open_dataset, recognise


def with_files(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("")
    return folder


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        (("rgb.txt", "depth.txt"), "tum_rgbd"),
        (("rgb.txt", "rgb/1.png"), "tum_rgbd"),
        (("calib.txt", "image_0/0.png"), "kitti"),
        (("times.txt", "image_2/0.png"), "kitti"),
        (("mav0/cam0/data.csv",), "euroc"),
        (("mav0/imu0/data.csv",), "euroc"),
        (("cam0/data.csv",), "euroc"),
        (("cam0/sensor.yaml",), "euroc"),
        (("image_0/0.png",), None),
        (("calib.txt", "times.txt"), None),
        (("cam0/0.png", "cam1/0.png"), None),
        (("rgb/0.png",), None),
        (("0.png", "1.png"), None),
        ((), None),
    ],
)
def test_a_folder_is_recognised_by_the_files_that_no_other_kind_has(tmp_path, names, kind):
    assert recognise(with_files(tmp_path, *names)) == kind


def test_what_is_none_of_them_is_left_to_others(tmp_path):
    (tmp_path / "video.mp4").write_bytes(b"")
    for path in (tmp_path, tmp_path / "video.mp4", tmp_path / "absent", tmp_path / "*.png", ""):
        assert open_dataset(path) is None
        assert open_dataset(str(path)) is None


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("tum_rgbd", "rgb.txt: expected a text file with lines `timestamp filename`, got No such file"),
        ("kitti", "expected a folder image_0 or image_2 with a left camera's images, got neither"),
        ("euroc", "cam0/data.csv: expected a text file with lines .* got No such file"),
        ("replica", "kind: expected one of auto, tum_rgbd, kitti, euroc, got 'replica'"),
    ],
)
def test_an_empty_folder_that_is_said_to_be_one_is_refused_in_one_sentence(tmp_path, kind, message):
    with pytest.raises(InputError, match=message) as error:
        open_dataset(tmp_path, kind=kind, camera=Pinhole(4, 4, 1.0, 1.0, 2.0, 2.0) if kind == "tum_rgbd" else None)
    assert str(error.value).count(". ") == 0


@pytest.mark.parametrize("kind", ["tum_rgbd", "kitti", "euroc"])
def test_a_path_that_is_no_folder_is_refused_for_a_named_kind(tmp_path, kind):
    with pytest.raises(InputError, match=f"input: expected a folder of the kind {kind}, got .*absent"):
        open_dataset(tmp_path / "absent", kind=kind)


@pytest.mark.parametrize("name", ["mav0/cam0/data.csv", "image_0/calib.txt"])
def test_a_camera_of_ones_own_is_refused_where_the_folder_has_a_calibration(tmp_path, name):
    folder = with_files(tmp_path, name, "calib.txt")
    with pytest.raises(InputError, match=r"camera: expected none for .* its own calibration"):
        open_dataset(folder, camera=Pinhole(4, 4, 1.0, 1.0, 2.0, 2.0))


def test_a_bad_selection_is_refused_before_the_folder_is_read(tmp_path):
    with pytest.raises(InputError, match="stop: expected more than start"):
        open_dataset(tmp_path, start=3, stop=3)
