"""The command: what it writes and prints, what it refuses and how, and how it stops."""

import csv
import dataclasses
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

import torchvo360
from torchvo360 import opening, outputs, runner
from torchvo360.cli import main
from torchvo360.cli.command import ENVIRONMENT, conf_folder
from torchvo360.cli.configuration import compose
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.data.tum import read_tum
from torchvo360.export import write_tum
from torchvo360.outputs import COLUMNS, ERRORS, FILES, new_folder
from torchvo360.runner import StopSignals
from torchvo360.settings import RunConfig
from torchvo360.vo import VisualOdometry

WITHOUT_PICTURE = set(FILES) - {"trajectory.png", "errors.png", "run.rrd"}

SMALL = SyntheticConfig(width=128, height=64, frames=8)
SYNTHETIC = ["input=synthetic", "synthetic.width=128", "synthetic.height=64", "synthetic.frames=8", "plot=false"]
MAPPED = ["input=synthetic", "synthetic.width=256", "synthetic.height=128", "synthetic.frames=12", "threads=1"]
"""Large enough for a map."""


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Run in an empty folder, as an installed command does; what it sets in the environment is not left behind."""
    monkeypatch.chdir(tmp_path)
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    """Frames of 128 x 64, blue first."""
    return [
        cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR) for frame in SyntheticSequence(SMALL) if frame.image is not None
    ]


@pytest.fixture
def images(pictures) -> Path:
    """A folder of images in the current one."""
    return write_images(Path("images"), pictures)


def write_images(folder: Path, pictures) -> Path:
    folder.mkdir()
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{number}.png"), picture)
    return folder


def summary_of(folder: Path) -> dict:
    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    return json.loads((folder / "summary.json").read_text(), parse_constant=refuse)


def rows_of(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "frames.csv").read_text().splitlines()))


def only_run(parent: str) -> Path:
    (folder,) = Path("runs", parent).iterdir()
    return folder


def here() -> set[str]:
    return {str(path) for path in Path().rglob("*")}


# Composition


def test_the_embedded_clip_brings_its_own_settings_and_no_other_input_does():
    assert (compose([], conf_folder()).mask, compose([], conf_folder()).camera.fit) == ("below:-18", "stretch")
    other = compose(["input=x/theta_walk.mp4"], conf_folder())
    assert (other.mask, other.camera.fit) == (None, "none")


def test_the_command_line_goes_before_the_clips_settings():
    config = compose(["mask=null", "camera.fit=crop"], conf_folder())
    assert (config.mask, config.camera.fit) == (None, "crop")


@pytest.mark.parametrize(
    "name", ["a(1), b=[2].mp4", "it's.mp4", "C:\\x\\", "2024", "true", "a b.mp4", "x/*.png", "1e3"]
)
def test_names_of_files_are_taken_as_they_stand(name):
    config = compose([f"input={name}", f"out={name}", f"truth={name}"], conf_folder())
    assert (config.input, config.out, config.truth) == (name, name, name)


def test_masks_are_words_or_lists_of_them():
    assert compose(["mask=[below:-18,box:-1:2:3.5:4]"], conf_folder()).mask == ["below:-18", "box:-1:2:3.5:4"]
    assert compose(["mask=above:80"], conf_folder()).mask == "above:80"


@pytest.mark.parametrize("group", ["vo", "synthetic", "clip"])
def test_every_preset_composes(group):
    for path in (conf_folder() / group).glob("*.yaml"):
        assert isinstance(compose([f"{group}={path.stem}"], conf_folder()), RunConfig)


def test_help_and_the_manual_name_every_setting_and_every_file(capsys):
    assert main(["--help"]) == 0
    page = capsys.readouterr().out
    manual = (Path(torchvo360.__file__).parents[1] / "docs" / "usage.md").read_text()
    for name in [field.name for field in dataclasses.fields(RunConfig)] + list(FILES):
        assert name in page, name
        assert name in manual, name
    for name in [field.name for field in dataclasses.fields(SyntheticConfig)] + [*ERRORS, *COLUMNS]:
        assert f"`{name}`" in manual, name


def test_cfg_prints_the_settings_as_yaml_and_writes_nothing(capsys):
    assert main(["--cfg", "seed=3"]) == 0
    settings = yaml.safe_load(capsys.readouterr().out)
    assert settings["seed"] == 3
    assert settings["mask"] == "below:-18"
    assert not here()


def test_version_is_told(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("torchvo360 ")


# Runs


def test_a_run_leaves_its_files_and_nothing_else(images, capsys):
    before = here()
    assert main(["input=images", "plot=false"]) == 0
    folder = only_run("images")
    assert {path.name for path in folder.iterdir()} == WITHOUT_PICTURE
    assert here() - before == {"runs", "runs/images", str(folder)} | {str(path) for path in folder.iterdir()}
    printed = capsys.readouterr()
    assert printed.err == ""  # no progress bar either: it is no terminal
    assert printed.out.splitlines()[-1] == f"results: {folder}"
    assert len(read_tum(folder / "trajectory.txt")) == SMALL.frames
    rows = rows_of(folder)
    assert tuple(rows[0]) == COLUMNS
    assert [int(row["index"]) for row in rows] == list(range(SMALL.frames))
    assert all(float(row["milliseconds"]) > 0 for row in rows)
    summary = summary_of(folder)
    assert sum(summary["states"].values()) == summary["frames"] == SMALL.frames
    assert summary["settings"]["input"] == "images"
    assert yaml.safe_load((folder / "config.yaml").read_text())["input"] == "images"
    assert "ate_rmse_m" not in summary


def test_synthetic_input_prints_its_figures_and_maps(capsys):
    assert main([*MAPPED, "out=x"]) == 0
    summary, printed = summary_of(Path("x")), capsys.readouterr().out
    for name in (*ERRORS, "coverage", "fps"):
        assert f"\n{name} " in printed
        assert isinstance(summary[name], float)
    assert summary["coverage"] == 1
    assert summary["keyframes"] > 0
    assert f"element vertex {summary['points']}\n".encode() in (Path("x") / "map.ply").read_bytes()
    assert (Path("x") / "trajectory.png").exists() == (importlib.util.find_spec("matplotlib") is not None)


def test_a_truth_file_gives_the_figures(images):
    write_tum("truth.txt", SyntheticSequence(SMALL).truth)
    assert main(["input=images", "truth=truth.txt", "plot=false", "out=x"]) == 0
    assert summary_of(Path("x"))["pairs"] == SMALL.frames


def test_figures_that_are_not_finite_are_null_in_the_summary_and_undefined_in_print(images, capsys):
    still = SyntheticSequence(dataclasses.replace(SMALL, motion="still"))
    write_tum("truth.txt", still.truth)
    main(["input=images", "truth=truth.txt", "plot=false", "out=x"])
    summary = summary_of(Path("x"))
    assert summary["path_length_m"] == 0
    assert summary["ate_percent"] in (0, None)
    assert "nan" not in capsys.readouterr().out


def test_the_same_input_and_settings_give_the_same_bits():
    assert [main([*MAPPED, "plot=false", f"out={name}"]) for name in "ab"] == [0, 0]
    for file in ("trajectory.txt", "map.ply"):
        assert (Path("a") / file).read_bytes() == (Path("b") / file).read_bytes()
    assert summary_of(Path("a"))["keyframes"] > 0


def test_bad_frames_in_the_middle_get_poses_and_the_run_goes_on(pictures, capsys):
    folder = write_images(Path("images"), pictures)
    cv2.imwrite(str(folder / "2.png"), np.zeros_like(pictures[0]))
    cv2.imwrite(str(folder / "3.png"), np.full_like(pictures[0], 255))
    cv2.imwrite(str(folder / "4.png"), pictures[0][:32, :64])
    (folder / "5.png").write_bytes((folder / "5.png").read_bytes()[:100])
    assert main(["input=images", "plot=false", "out=x"]) == 0
    summary = summary_of(Path("x"))
    assert summary["unusable_frames"] == {"black": 1, "white": 1, "size": 1, "unreadable": 1}
    assert "unusable frames: 1 black, 1 white, 1 size, 1 unreadable" in capsys.readouterr().out
    assert len(read_tum("x/trajectory.txt")) == SMALL.frames
    reasons = [row["reason"] for row in rows_of(Path("x"))]
    assert reasons[2:6] == ["bad_frame_black", "bad_frame_white", "bad_frame_size", "bad_frame_unreadable"]


def test_a_truncated_video_is_used_as_far_as_it_goes_and_that_is_said(capsys):
    whole = Path(torchvo360.__file__).parent / "data" / "clips" / "theta_walk.mp4"
    data = whole.read_bytes()
    Path("cut.mp4").write_bytes(data[: len(data) // 12])
    assert main(["input=cut.mp4", "camera.fit=stretch", "resize=128x64", "plot=false", "out=x"]) == 0
    frames = summary_of(Path("x"))["frames"]
    assert 2 <= frames < 100
    assert "note: cut.mp4: expected 300 frames, could read " in capsys.readouterr().out


def test_wide_input_is_brought_down_unless_told_otherwise(images, monkeypatch, capsys):
    monkeypatch.setattr(opening, "AUTO_WIDTH", 64)
    assert [main(["input=images", "plot=false", "out=auto"]), summary_of(Path("auto"))["width"]] == [0, 64]
    assert "frames of 128 x 64 were brought down to 64 x 32" in capsys.readouterr().out
    assert [main(["input=images", "plot=false", "out=kept", "resize=null"]), summary_of(Path("kept"))["width"]] == [
        0,
        128,
    ]
    assert [main(["input=images", "plot=false", "out=set", "resize=96x48"]), summary_of(Path("set"))["width"]] == [
        0,
        96,
    ]
    assert "brought down" not in capsys.readouterr().out


def test_threads_hold_for_the_run_alone(images):
    before = torch.get_num_threads(), cv2.getNumThreads()
    assert main(["input=images", "plot=false", "threads=1", "out=x"]) == 0
    assert summary_of(Path("x"))["threads"] == 1
    assert (torch.get_num_threads(), cv2.getNumThreads()) == before


def test_a_missing_matplotlib_is_said_in_one_line(images, monkeypatch, capsys):
    for module in (outputs, runner):
        monkeypatch.setattr(module, "can_plot", lambda: False)
    assert main(["input=images", "out=x"]) == 0
    (note,) = [line for line in capsys.readouterr().out.splitlines() if "trajectory.png" in line]
    assert "torchvo360[viz]" in note
    assert main(["input=images", "out=y", "plot=true"]) == 2
    assert not Path("y").exists()


def test_runs_within_one_second_do_not_collide():
    with ExitStack() as stack:
        folders = [stack.enter_context(new_folder(None, Path("runs/walk"))) for _ in range(3)]
        assert len(set(folders)) == 3
        assert all(folder.is_dir() for folder in folders)
    assert not here()  # nothing was put into them


def test_a_run_is_replaced_only_on_request(images, capsys):
    assert main(["input=images", "out=x"]) == 0
    first = (Path("x") / "summary.json").read_bytes()
    assert main(["input=images", "out=x"]) == 2
    assert "overwrite=true" in capsys.readouterr().err
    assert (Path("x") / "summary.json").read_bytes() == first
    assert main(["input=images", "out=x", "overwrite=true", "plot=false", "seed=5"]) == 0
    assert summary_of(Path("x"))["settings"]["seed"] == 5
    assert {path.name for path in Path("x").iterdir()} == WITHOUT_PICTURE


def test_a_defect_shows_itself_and_leaves_no_folder(images, monkeypatch):
    def fail(self, frame):
        raise RuntimeError("a defect")

    monkeypatch.setattr(VisualOdometry, "step", fail)
    with pytest.raises(RuntimeError, match="a defect"):
        main(["input=images"])
    assert not Path("runs").exists()


# Other cameras


def test_two_panoramas_in_each_frame_give_metres_from_the_first_frame():
    world = SyntheticSequence(SyntheticConfig(width=256, height=128, frames=10, stereo_baseline=0.2, stereo_axis="y"))
    moments = [[image for image in (frame.image, *frame.others) if image is not None] for frame in world]
    write_images(Path("packed"), [np.concatenate(pair)[..., ::-1] for pair in moments])
    write_tum(Path("truth.txt"), world.truth)
    rig = ["rig.layout=top_bottom", "rig.axis=y", "rig.baseline=0.2"]
    assert main(["input=packed", *rig, "truth=truth.txt", "plot=false", "out=x"]) == 0
    assert {row["reason"] for row in rows_of(Path("x"))} <= {"stereo_ranges", "ok"}
    assert summary_of(Path("x"))["scale"] == pytest.approx(1, abs=0.02)


def test_a_folder_of_rgbd_data_runs_without_further_settings():
    for number in range(3):
        Path("rgbd_dataset_freiburg3_noise/rgb").mkdir(parents=True, exist_ok=True)
        noise = np.random.default_rng(number).integers(0, 256, (480, 640, 3), dtype=np.uint8)
        cv2.imwrite(f"rgbd_dataset_freiburg3_noise/rgb/{number}.png", noise)
    lines = [f"{1341846313 + number / 30:.6f} rgb/{number}.png\n" for number in range(3)]
    Path("rgbd_dataset_freiburg3_noise/rgb.txt").write_text("".join(lines))
    assert main(["input=rgbd_dataset_freiburg3_noise", "plot=false", "out=x"]) == 0
    summary = summary_of(Path("x"))
    assert (summary["width"], summary["height"], summary["frames"]) == (640, 480, 3)
    assert rows_of(Path("x"))[0]["time"].startswith("1341846313.0")


def test_the_odometry_is_given_the_imu(images, monkeypatch):
    given = {}

    class Odometry(VisualOdometry):
        def __init__(self, *arguments, imu=None, **settings) -> None:
            given["imu"] = imu
            super().__init__(*arguments, **settings)

    monkeypatch.setattr(runner, "VisualOdometry", Odometry)
    Path("imu.csv").write_text("".join(f"{5_000_000 * k},0,0,0,0,-9.8,0\n" for k in range(60)))
    settings = ["imu=imu.csv", "imu_sensor.T_cam_imu=[0.1,0,0,0,0,0,1]", "imu_sensor.gyro=0.002"]
    assert main(["input=images", *settings, "plot=false", "out=x"]) == 0
    assert (len(given["imu"].samples), given["imu"].noise.gyro) == (60, 0.002)
    assert [note for note in summary_of(Path("x"))["notes"] if note.startswith("imu: it told rotations at most")]
    assert main(["input=images", "plot=false", "out=y"]) == 0
    assert given["imu"] is None
    assert not [note for note in summary_of(Path("y"))["notes"] if note.startswith("imu")]


# Bad input


def prepare_bad_input(pictures) -> None:
    write_images(Path("images"), pictures)
    write_images(Path("one"), pictures[:1])
    write_images(Path("oblong"), [np.full((66, 128, 3), 90, np.uint8)] * 2)
    write_images(Path("black"), [np.zeros((64, 128, 3), np.uint8)] * 3)
    Path("empty").mkdir()
    Path("text.mp4").write_text("no video " * 99)
    cv2.imwrite("nothing.png", np.zeros((64, 128), np.uint8))
    cv2.imwrite("small.png", np.full((32, 64), 255, np.uint8))
    np.save("nan.npy", np.full((64, 128, 3), np.nan))
    Path("nan").mkdir()
    for number in range(3):
        np.save(f"nan/{number}.npy", np.full((64, 128, 3), np.nan))
    Path("epoch.txt").write_text("".join(f"{1403636579 + k} 0 0 {k} 0 0 0 1\n" for k in range(9)))
    Path("words.txt").write_text("one two three\n")
    lens = "cam0: {camera_model: pinhole, distortion_model: none, resolution: [752, 480], intrinsics: [%s]}"
    Path("other_size.yaml").write_text(lens % "460, 460, 370, 240")
    Path("no_focal_length.yaml").write_text(lens % "0, 460, 370, 240")
    samples = ["0,0,0,9.8,0,0\n"] * 9
    Path("epoch.csv").write_text("".join(f"{1403636579763555584 + 5000000 * k},{s}" for k, s in enumerate(samples)))
    Path("reversed.csv").write_text("".join(f"{-5000000 * k},{s}" for k, s in enumerate(samples)))
    Path("tum").mkdir()
    Path("tum/rgb.txt").write_text("0.1 rgb/0.png\n")


BAD = {
    "input=~nobody_of_this_name/walk.mp4": "input: expected a known user's folder, got ~nobody_of_this_name/walk.mp4",
    # keys and values
    "inptu=x": "inptu: expected a known key such as input, got inptu=x",
    "vo.map.pints=3": "vo.map.points",
    "keyframe_flow=3": "vo.map.keyframe_flow_deg",
    "qqq=1": "qqq: expected a known key",
    "+qqq=1": "qqq: expected a known key",
    "~start": "~start: expected key=value",
    "walk.mp4": "walk.mp4: expected key=value",
    "--frames": "--frames: expected key=value",
    "start=abc": "start: expected an integer, got abc",
    "start=null": "start: expected a value, got null",
    "fps=x": "fps: expected a number, got x",
    "progress=maybe": "progress: expected true or false, got maybe",
    "seed=1,2": "seed: expected one value",
    "seed=[1": "seed: expected a value",
    "seed=${nope}": "'nope'",
    "camera=stretch": "camera: expected its keys one by one",
    "vo=quick": "vo: expected one of accurate, clean, default, fast, got quick",
    "clip=nope": "clip: expected one of none, theta_walk, got nope",
    "hydra.nope=1": "hydra.nope",
    "vo.map.points=5": "vo.map.points: expected at least 100, got 5",
    "vo.track.steps_by_level=3": "vo.track.steps_by_level: expected a list such as [1,2], got 3",
    "synthetic.world=moon": "synthetic.world: expected one of room",
    "resize=abc": "resize: expected WIDTHxHEIGHT",
    "resize=640x300": "resize: expected a width of twice the height",
    "threads=0": "threads: expected at least 1, got 0",
    "threads=100000": "threads: expected at most",
    "vo.epipolar.max_half_width_px=100000": "max_half_width_px: expected 3 to 256, got 100000",
    "vo.track.huber=-1": "huber: expected a finite number above 0",
    "vo.blur_px=200": "blur_px: expected a finite number",
    "device=tpu": "device: expected one of cpu, cuda, got 'tpu'",
    "seed=-1": "seed: expected 0 to",
    "start=-1": "start: expected at least 0",
    "start=400": "start: expected less than the 300 frames",
    "every=0": "every: expected at least 1",
    "stop=1": "input: expected at least two frames after start, stop and every",
    "fps=0": "fps: expected a frame rate above 0",
    "camera.fit=squash": "camera.fit: expected one of none, stretch, crop",
    "plot=maybe": "plot: expected one of auto, true, false",
    # inputs
    "input=": "input: expected a video",
    "input=nowhere.mp4": "nowhere.mp4, which does not exist",
    "input=text.mp4": "text.mp4, which cannot be read",
    "input=one": "input: expected at least two frames, got 1",
    "input=one/0.png": "got the image one/0.png",
    "input=empty": "input: expected image files",
    "input=none/*.png": "no match for none/*.png",
    "input=oblong": "128 x 66 (3.0 % off)",
    "input=black": "input: expected at least two usable frames, got 0 of 3 (3 black)",
    "input=nan": "input: expected readable images",
    "input=synthetic every=2": "every: expected no value for a synthetic input",
    "input=synthetic synthetic.panorama=nope.jpg": "synthetic.panorama: expected the path of a readable image",
    # cameras and rigs
    "camera.model=pinhole": "camera.intrinsics: expected [fx, fy, cx, cy] of numbers, got None",
    "camera.model=pinhole camera.intrinsics=[0,9,3,4]": "camera.fx: expected a focal length other than zero, got 0",
    "camera.calibration=nope.yaml input=images": "camera.calibration: nope.yaml: expected a calibration file, got",
    "camera.calibration=words.txt input=images": "words.txt: expected a calibration in YAML",
    "camera.calibration=no_focal_length.yaml input=images": "no_focal_length.yaml, cam0: fx: expected a focal length",
    "camera.calibration=other_size.yaml input=images": "expected images of 752 x 480 or in proportion",
    "input=synthetic camera.model=equirectangular": "camera: expected no value for a synthetic input",
    "rig.layout=top_bottom rig.T_first_second=[1,2,3]": "rig.T_first_second: expected 16 finite numbers by rows, or 7",
    "rig.layout=top_bottom rig.baseline=1 input=images": "frames of 128 x 64: input: expected a width of twice",
    "rig.layout=left_right rig.baseline=1 input=images": "got 64 x 64",
    "rig.layout=left_right input=images": "rig: expected rig.baseline, rig.T_first_second or a calibration of two",
    "rig.layout=left_right rig.T_first_second=[0,0,0,0,0,0,1] input=images camera.fit=stretch": "got 0 m apart",
    # inertial measurements and data sets
    "imu_sensor.T_cam_imu=[1]": "imu_sensor.T_cam_imu: expected 16 finite numbers by rows, or 7",
    "imu=epoch.csv input=images": "imu_sensor.T_cam_imu: expected the sensor's pose, here or in camera.calibration",
    "imu=nope.csv input=images imu_sensor.T_cam_imu=[0,0,0,0,0,0,1]": "imu: nope.csv: expected",
    "imu=reversed.csv input=images imu_sensor.T_cam_imu=[0,0,0,0,0,0,1]": "imu: reversed.csv, line 2: expected a time",
    "imu=epoch.csv input=images imu_sensor.T_cam_imu=[0,0,0,0,0,0,1]": "imu: expected samples at the frames' times, 0",
    "imu=epoch.csv input=images imu_sensor.T_cam_imu=[0,0,0,0,0,0,1] imu_sensor.offset_s=1e99": "imu_sensor.offset_s: ",
    "imu=epoch.csv input=synthetic": "imu: expected auto or null for a synthetic input",
    "depth_scale=1000 input=images": "depth_scale: expected no value but for the folder of a data set, got 1000.0",
    "stereo=false input=images": "stereo: expected no value but for the folder of a data set, got False",
    "input=tum fps=10": "fps: expected no value for the data set in tum, got 10.0",
    "input=tum rig.layout=left_right": "rig.layout: expected no value for the data set in tum, got left_right",
    "input=tum": "camera: expected a calibration for tum",
    # masks, truths, folders
    "input=images mask=nothing.png": "mask: expected at least 1% of the image to be left",
    "input=images mask=below:90": "mask: expected at least 1% of the image to be left",
    "input=images mask=small.png": "mask: expected the frames' size 128 x 64, got 64 x 32",
    "input=images mask=nope.png": "'nope.png', which does not exist",
    "input=images mask=words.txt": "words.txt, which cannot be read",
    "input=images mask=below:-91": "mask: expected an angle between -90 and 90",
    "input=images mask=[below:-9,abov:3]": "'abov:3'",
    "mask=3": "mask: expected an image file, a sector or a list of them, got 3",
    "input=images truth=nope.txt": "truth: nope.txt: expected a trajectory file",
    "input=images truth=words.txt": "truth: words.txt, line 1: expected 8 numbers",
    "input=images truth=epoch.txt": "truth: expected poses at the frames' times, 0 to 0.2",
    "input=images out=words.txt": "out: expected a folder that can be written, got words.txt",
    "input=images out=words.txt/x/y": "out: expected a folder that can be written, got words.txt/x/y",
    "out=": "out: expected a folder",
    # sweeps
    "-m inptu=1,2": "inptu: expected a known key such as input",
    "-m seed=0,x": "seed: expected an integer, got x",
    "-m seed=0,1 out=a,b": "out: expected one folder for the whole sweep",
    "-m seed=0,1 out=images": "out: expected a new or empty folder for a sweep",
}


def test_bad_input_gets_one_sentence_exit_code_2_and_no_folder(pictures, capsys):
    prepare_bad_input(pictures)
    before = here()
    for line, phrase in BAD.items():
        assert main(line.split(" ")) == 2, line
        printed = capsys.readouterr()
        assert printed.out == "", line
        assert printed.err.startswith("torchvo360: "), line
        assert printed.err.endswith("\n"), line
        assert printed.err.count("\n") == 1, printed.err
        assert phrase in printed.err, printed.err
        assert here() == before, line


def test_cuda_is_refused_where_there_is_none(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main([*SYNTHETIC, "device=cuda"]) == 2
    assert "device: expected cpu" in capsys.readouterr().err
    assert not here()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_folder_without_permission_is_refused(images, capsys):
    Path("locked").mkdir(mode=0o500)
    assert main(["input=images", "out=locked/x"]) == 2
    assert "out: expected a folder that can be written" in capsys.readouterr().err


def test_a_truth_that_turns_out_too_sparse_costs_the_figures_and_not_the_results(images, capsys):
    Path("sparse.txt").write_text("0 0 0 0 0 0 0 1\n0.2 0 0 1 0 0 0 1\n")
    assert main(["input=images", "truth=sparse.txt", "plot=false", "out=x"]) == 2
    assert "truth: expected at least 3 poses" in capsys.readouterr().err
    assert "ate_rmse_m" not in summary_of(Path("x"))


# Sweeps


def test_a_sweep_gives_every_job_its_own_folder(capsys):
    assert main(["-m", *SYNTHETIC, "seed=0,1"]) == 0
    folder = only_run("sweep")
    assert {path.name for path in folder.iterdir()} == {"0", "1", "multirun.yaml"}
    assert [summary_of(folder / name)["settings"]["seed"] for name in "01"] == [0, 1]
    assert all({path.name for path in (folder / name).iterdir()} == WITHOUT_PICTURE for name in "01")
    assert {path.name for path in Path().iterdir()} == {"runs"}
    assert "job 1: " in capsys.readouterr().out


def test_the_embedded_clips_settings_hold_for_its_job_alone(images):
    arguments = ["-m", "input=theta_walk,images", "stop=3", "resize=128x64", "plot=false", "out=sweep"]
    assert main(arguments) == 0
    assert [summary_of(Path("sweep", name))["settings"]["mask"] for name in "01"] == ["below:-18", None]


def test_a_job_that_cannot_run_does_not_keep_the_others_from_running(images, capsys):
    assert main(["-m", "input=nowhere,images", "plot=false", "out=sweep"]) == 2
    assert {path.name for path in Path("sweep").iterdir()} == {"1", "multirun.yaml"}
    assert "torchvo360: job 0: input: expected" in capsys.readouterr().err


def test_a_sweep_of_nothing_but_mistakes_leaves_no_folder():
    assert main(["-m", "input=nowhere,nothing"]) == 2
    assert not here()


# Stopping


def test_the_first_signal_is_noted_and_the_second_acts_as_before():
    # A process that a shell put into the background begins with signals ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with StopSignals() as stop:
            os.kill(os.getpid(), signal.SIGINT)
            assert stop.received == signal.SIGINT
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_stopping_before_two_frames_leaves_nothing(images, monkeypatch, capsys):
    step = VisualOdometry.step

    def stopped(self, frame):
        os.kill(os.getpid(), signal.SIGTERM)
        return step(self, frame)

    monkeypatch.setattr(VisualOdometry, "step", stopped)
    assert main(["input=images"]) == 143
    assert "nothing is written" in capsys.readouterr().err
    assert not Path("runs").exists()


def start(*arguments: str) -> subprocess.Popen[str]:
    """Start the command in a process of its own, with the environment of a user."""
    environment = {name: value for name, value in os.environ.items() if name not in ENVIRONMENT}
    environment["PYTHONPATH"] = str(Path(torchvo360.__file__).parents[1])
    return subprocess.Popen(
        [sys.executable, "-m", "torchvo360", *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_signal_ends_the_run_and_keeps_what_was_done():
    codes = {"SIGINT": 130, "SIGTERM": 143}
    still = [*SYNTHETIC, "synthetic.motion=still", "threads=1"]
    assert (
        main([*still, "synthetic.frames=3", "out=compiled"]) == 0
    )  # where nothing was compiled yet, that takes its time
    endless = [*still, "synthetic.frames=100000"]
    processes = {name: start(*endless, f"out={name}") for name in codes}
    for name, process in processes.items():
        while not Path(name).exists():
            assert process.poll() is None
            time.sleep(0.05)
    time.sleep(3)  # some frames, once the compiled passes are loaded
    for name, process in processes.items():
        process.send_signal(getattr(signal, name))
    for name, process in processes.items():
        out, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (codes[name], "")
        assert f"note: stopped by {name} after " in out
        assert {path.name for path in Path(name).iterdir()} == WITHOUT_PICTURE
        frames = summary_of(Path(name))["frames"]
        assert 2 <= frames < 100000
        assert len(read_tum(Path(name) / "trajectory.txt")) == frames


def test_a_signal_ends_a_sweep(images, monkeypatch):
    step = VisualOdometry.step

    def stopped(self, frame):
        if frame.index == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, frame)

    monkeypatch.setattr(VisualOdometry, "step", stopped)
    assert main(["-m", "input=images", "seed=0,1", "plot=false", "out=x"]) == 130
    assert {path.name for path in Path("x").iterdir()} == {"0", "multirun.yaml"}
    assert summary_of(Path("x/0"))["frames"] == 3


def test_the_command_runs_as_a_process_from_any_folder(images):
    good, bad = start("input=images", "plot=false"), start("input=nowhere")
    out, err = good.communicate(timeout=60)
    assert (good.returncode, err) == (0, "")
    assert f"results: {only_run('images')}" in out
    out, err = bad.communicate(timeout=60)
    assert (bad.returncode, out, err.count("\n")) == (2, "", 1)
