"""The command `torchvo360-export`: what it writes, what it refuses in one sentence, and what it leaves alone."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from exact_run import FRAMES, HOSTS, config_of, exact_run, sequence_of, write_run

import torchvo360
from torchvo360.cli.command import ENVIRONMENT
from torchvo360.cli.export import main
from torchvo360.cli.export_settings import NAMES, ExportConfig
from torchvo360.data.trajectory import Trajectory
from torchvo360.data.tum import read_tum
from torchvo360.export import dataset, read_ply
from torchvo360.export.folder import atomic_folder
from torchvo360.export.recorded import Recorded, read_recorded

COLMAP = ("cameras.bin", "images.bin", "points3D.bin", "cameras.txt", "images.txt", "points3D.txt")


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Run in an empty folder; what the command sets in the environment is not left behind."""
    monkeypatch.chdir(tmp_path)
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)


@pytest.fixture(scope="module")
def journey(tmp_path_factory) -> tuple[Path, Recorded]:
    """A folder of rendered frames, and the run upon them; its second frame has no pose and its third none to trust."""
    sequence = sequence_of()
    frames = tmp_path_factory.mktemp("frames")
    for index in range(FRAMES):
        cv2.imwrite(str(frames / f"{index}.png"), sequence.frame(index).image[..., ::-1])
    recorded = exact_run(sequence)
    state = ["initialising", "lost", "weak", *["tracking"] * (FRAMES - 3)]
    keep = [at for at in range(FRAMES) if at != 1]
    trajectory = Trajectory(recorded.t_ns[keep], recorded.trajectory.T_world_cam[keep])
    return frames, replace(recorded, trajectory=trajectory, state=state)


@pytest.fixture
def run_folder(journey) -> Path:
    """That run in the folder `run`."""
    frames, recorded = journey
    return write_run(Path("run"), recorded, {"input": str(frames), "vo": {"unknown_to_this_version": 1}})


def copied_frames(journey) -> Path:
    """Return the folder `frames` with copies of the frames."""
    return Path(shutil.copytree(journey[0], "frames"))


def refused(capsys, *arguments: str) -> str:
    """Run the command, which must refuse with one sentence, and return that."""
    assert main(arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    (sentence,) = output.err.splitlines()
    assert sentence.startswith("torchvo360-export: ")
    assert sentence.endswith(".")
    return sentence


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", NAMES)
def test_every_format_is_written_into_the_runs_folder_by_default(run_folder, capsys, name):
    before = content(run_folder)
    assert main([f"run={run_folder}", f"format={name}"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{name}: {run_folder / NAMES[name]}"
    after = content(run_folder)
    new = set(after) - set(before)
    assert all(path.startswith(NAMES[name]) for path in new)
    assert new
    assert before == {path: data for path, data in after.items() if path not in new}
    assert not [path for path in run_folder.iterdir() if path.name.startswith(".")]


def test_colmap_holds_images_of_the_keyframes_and_the_model(run_folder, capsys):
    assert main([f"run={run_folder}", "out=data", "size=48", "image=png"]) == 0
    assert {path.name for path in Path("data/sparse/0").iterdir()} == set(COLMAP)
    names = {path.name for path in Path("data/images").iterdir()}
    assert {name.split("_")[1] for name in names} == {f"{index:06d}" for index in HOSTS}
    assert len(names) == 6 * len(HOSTS)
    assert cv2.imread("data/images/frame_000010_left.png").shape == (48, 48, 3)
    assert "left out" not in capsys.readouterr().out


def test_every_nth_frame_leaves_out_those_that_cannot_be_trusted_and_says_so(run_folder, capsys):
    assert main([f"run={run_folder}", "format=nerfstudio", "out=data", "frames=1"]) == 0
    frames = json.loads(Path("data/transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [
        f"images/frame_{index:06d}.jpg" for index in range(FRAMES) if index not in (1, 2)
    ]
    lines = capsys.readouterr().out.splitlines()
    assert "note: 2 of 20 frames are left out: 1 without a pose, 1 weak." in lines


def test_frames_before_the_map_are_left_out_unless_they_are_keyframes(run_folder):
    recorded = read_recorded(run_folder)
    recorded.state[3] = "initialising"
    kept, notes = recorded.chosen(1)
    assert 0 in kept  # a keyframe
    assert 3 not in kept
    assert notes == ["3 of 20 frames are left out: 1 without a pose, 1 weak, 1 initialising."]


def test_kitti_has_a_line_a_frame_and_says_what_it_made_up(run_folder, capsys):
    assert main([f"run={run_folder}", "format=kitti", "out=poses.txt"]) == 0
    rows = np.loadtxt("poses.txt")
    assert rows.shape == (FRAMES, 12)
    recorded = read_recorded(run_folder)
    ahead = np.linalg.inv(recorded.trajectory.T_world_cam[0].numpy()) @ recorded.trajectory.T_world_cam[1].numpy()
    np.testing.assert_allclose(rows[2], ahead[:3].ravel(), atol=1e-8)
    assert "note: 1 frames without a pose" in capsys.readouterr().out


def test_tum_and_ply_are_the_runs_own(run_folder):
    assert main([f"run={run_folder}", "format=tum", "out=poses.txt"]) == 0
    torch.testing.assert_close(
        read_tum("poses.txt").T_world_cam, read_tum(run_folder / "trajectory.txt").T_world_cam, atol=1e-7, rtol=0
    )
    assert main([f"run={run_folder}", "format=ply", "out=points.ply"]) == 0
    assert torch.equal(read_ply("points.ply")[0], read_ply(run_folder / "map.ply")[0])


def test_a_mask_and_a_smaller_size_of_the_run_hold_for_the_export(journey):
    frames = copied_frames(journey)
    for path in frames.iterdir():
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (512, 256)))
    config = {"input": "frames", "resize": "256x128", "mask": "below:-30", "threads": 10**6}
    write_run(Path("run"), journey[1], config)
    assert main(["run=run", "format=nerfstudio", "out=data"]) == 0
    assert cv2.imread("data/images/frame_000000.jpg").shape == (128, 256, 3)
    mask = cv2.imread("data/masks/mask.png", cv2.IMREAD_GRAYSCALE)
    assert (mask[:64] == 255).all()
    assert (mask[-42:] == 0).all()
    frames.rename("moved")
    assert main(["run=run", "out=colmap"]) == 2
    assert not Path("colmap").exists()
    assert main(["run=run", "out=colmap", "input=moved"]) == 0
    assert len(list(Path("colmap/masks").iterdir())) == len(list(Path("colmap/images").iterdir())) == 5 * len(HOSTS)


def test_a_video_becomes_a_posed_data_set_in_one_command(capsys):
    (Path("colmap") / "file").mkdir(parents=True)  # not in the way: without `out` the run's folder is the place
    arguments = ["input=theta_walk", "stop=24", "plot=false", "report=false", "frames=4", "fov=95"]
    assert main(arguments) == 0
    (run,) = Path("runs/theta_walk").iterdir()
    assert (run / "summary.json").is_file()
    assert {path.name for path in (run / "colmap/sparse/0").iterdir()} == set(COLMAP)
    out = capsys.readouterr().out
    assert f"results: {run}" in out
    assert "faces down" in out  # the operator's mask
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(run / "colmap/sparse/0")
    off = [
        np.linalg.norm(image.project_point(model.points3D[point.point3D_id].xyz) - point.xy)
        for image in model.images.values()
        for point in image.points2D
    ]
    assert len(off) > 300
    assert np.median(off) < 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "run: expected the folder of a run, or input=PATH to make one, got neither."),
        (["run=nowhere"], "run: expected the folder of a finished run, got nowhere, without summary.json"),
        (["run=run", "format=usd"], "format: expected one of colmap, nerfstudio, tum, kitti, euroc, frusta, ply, got"),
        (["run=run", "fromat=tum"], "fromat: expected a known key such as format, got fromat=tum."),
        (["run=run", "colmap"], "colmap: expected key=value, such as run=runs/walk."),
        (["run=run", "frames=0"], "frames: expected keyframes or a number such as 10, got 0."),
        (["run=run", "frames=some"], "frames: expected keyframes or a number such as 10, got some."),
        (["run=run", "faces=5"], "faces: expected 4 or 6, got 5."),
        (["run=run", "size=10000000"], "size: expected an integer from 8 to 8192, got 10000000."),
        (["run=run", "out="], "out: expected a name, got an empty one."),
        (["run=~nobody_of_this_name/run"], "run: expected a known user's folder, got ~nobody_of_this_name/run."),
        (["input=synthetic", "faces=5"], "faces: expected 4 or 6, got 5."),
        (
            ["input=synthetic", "out=run/map.ply/data"],
            "out: expected a place that can be written, got run/map.ply/data",
        ),
        (["run=run", "faces=many"], "faces: expected an integer, got many."),
        (["run=run", "fov=20"], "fov: expected a finite number above 90 at most 120, got 20"),
        (["run=run", "image=gif"], "image: expected one of jpg, png, got 'gif'."),
        (["run=run", "format=tum", "frames=3"], "frames: expected no value for format=tum, got 3."),
        (["run=run", "format=nerfstudio", "fov=95"], "fov: expected no value for format=nerfstudio, got 95.0."),
        (["run=run", "format=frusta", "out=cameras.obj"], "out: expected one of .glb, .ply, got '.obj'."),
        (["run=run", "format=tum", "out=run"], "out: expected a file for format=tum, got run, which is none."),
        (["run=run", "out=run"], "out: expected a new name, or overwrite=true, got run, which is there."),
        (["run=run", "input=nowhere.mp4"], "got nowhere.mp4, which does not exist"),
        (["input=nowhere.mp4"], "got nowhere.mp4, which does not exist"),
        (["input=theta_walk", "speed=3"], "speed: expected a known key"),
    ],
)
def test_mistakes_are_told_in_one_sentence_and_nothing_is_written(run_folder, capsys, arguments, message):
    before = {str(path) for path in Path().rglob("*")}
    assert message in refused(capsys, *arguments)
    assert {str(path) for path in Path().rglob("*")} == before


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("summary.json", "{", "run: expected a summary.json that torchvo360 wrote"),
        ("summary.json", "{}", "run: expected a summary.json that torchvo360 wrote"),
        ("trajectory.txt", "# timestamp tx ty tz qx qy qz qw\n", "expected lines `timestamp tx ty tz qx qy qz qw`"),
        ("trajectory.txt", None, "run: run/trajectory.txt: expected a trajectory file, got No such file"),
        ("map.ply", "ply\n", "run: run/map.ply: expected a point cloud as torchvo360 writes it"),
        ("frames.csv", "index,time,state\n", "run: expected frames in run/frames.csv, got none."),
        ("frames.csv", "a,b\n1,2\n", "run: expected frames as torchvo360 writes them"),
        ("frames.csv", None, "run: expected run/frames.csv, got No such file"),
        ("frames.csv", "index,time,state\n0,inf,tracking\n", "run: expected frames as torchvo360 writes them"),
        ("frames.csv", f"index,time,state\n{10**30},0,tracking\n", "run: expected frames as torchvo360 writes them"),
        ("frames.csv", "index,time,state\n0,0,flying\n", "run: expected frames as torchvo360 writes them"),
        ("frames.csv", "index,time,state\n0,0,tracking\n", "got 18 poses in trajectory.txt at times of no frame in"),
        ("summary.json", '{"width": Infinity, "height": 1}', "run: expected a summary.json that torchvo360 wrote"),
        ("summary.json", '{"width": 2, "height": 1, "gravity": [1]}', "run: expected a summary.json that torchvo360"),
        ("config.yaml", "", "run: expected settings as torchvo360 writes them in run/config.yaml, got: no input."),
        ("config.yaml", None, "run: expected run/config.yaml, got No such file"),
        ("config.yaml", "input: [", "run: expected settings as torchvo360 writes them in run/config.yaml, got: "),
        ("config.yaml", "start: many", "run: expected settings as torchvo360 writes them in run/config.yaml, got: "),
        ("config.yaml", "input: gone.mp4", "gone.mp4, which does not exist (the input of the run in run; input=PATH"),
    ],
)
def test_a_damaged_run_is_told_in_one_sentence(run_folder, capsys, file, text, message):
    (run_folder / file).unlink() if text is None else (run_folder / file).write_text(text)
    before = content(Path())
    assert message in refused(capsys, "run=run", "out=data")
    assert content(Path()) == before


def test_points_that_are_not_finite_are_refused(run_folder, capsys):
    path = run_folder / "map.ply"
    path.write_bytes(path.read_bytes()[:-19] + np.full(3, np.nan, np.float32).tobytes() + bytes(7))
    assert "map.ply: expected finite coordinates, got others" in refused(capsys, "run=run", "out=data")


def test_a_mask_that_hides_all_faces_is_told(journey, capsys):
    write_run(Path("run"), journey[1], {"input": str(journey[0]), "mask": "above:-70"})
    message = "faces: expected some of which the mask leaves more than 2 %, got none."
    assert message in refused(capsys, "run=run", "out=data", "faces=4")
    assert not Path("data").exists()


def test_an_input_that_has_changed_is_refused(run_folder, journey, capsys):
    frames = copied_frames(journey)
    for index in range(12, FRAMES):
        (frames / f"{index}.png").unlink()
    message = "input: expected frames up to 19 as in the run, got 11 for the last one."
    assert message in refused(capsys, "run=run", "out=data", "input=frames")
    for path in frames.iterdir():
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (128, 64)))
    message = "input: expected frames of 256 x 128 as in the run, got 128 x 64: it is another one by now."
    assert message in refused(capsys, "run=run", "out=data", "input=frames")
    assert not Path("data").exists()


def test_frames_whose_images_cannot_be_used_are_left_out_with_a_note(run_folder, journey, capsys):
    frames = copied_frames(journey)
    cv2.imwrite(str(frames / f"{HOSTS[1]}.png"), np.zeros((128, 256, 3), np.uint8))
    assert main(["run=run", "out=data", "input=frames"]) == 0
    assert "note: 1 of 3 frames are left out: their images cannot be used." in capsys.readouterr().out
    names = {path.name.split("_")[1] for path in Path("data/images").iterdir()}
    assert names == {f"{HOSTS[0]:06d}", f"{HOSTS[2]:06d}"}
    for path in frames.iterdir():
        cv2.imwrite(str(path), np.zeros((128, 256, 3), np.uint8))
    message = "frames: expected some whose images can be used, got none."
    assert message in refused(capsys, "run=run", "out=none", "input=frames")


@pytest.mark.parametrize("name", ["colmap", "nerfstudio"])
def test_blurred_frames_are_left_out_with_a_note(run_folder, journey, capsys, name):
    frames = copied_frames(journey)
    image = cv2.imread(str(frames / "12.png"))
    cv2.imwrite(str(frames / "12.png"), cv2.GaussianBlur(image, (0, 0), 1.5))
    assert main(["run=run", f"format={name}", "out=data", "input=frames", "frames=3"]) == 0
    assert "note: 1 of 7 frames are left out: they are blurred." in capsys.readouterr().out
    indices = {path.name.split("_")[1].split(".")[0] for path in Path("data/images").iterdir()}
    assert indices == {f"{index:06d}" for index in (0, 3, 6, 9, 15, 18)}
    listing = Path("data/sparse/0/images.txt" if name == "colmap" else "data/transforms.json").read_text()
    assert "frame_000009" in listing
    assert "frame_000012" not in listing


def test_a_rendered_input_is_rendered_again():
    sequence = sequence_of()
    write_run(Path("run"), exact_run(sequence), config_of(sequence))
    assert main(["run=run", "format=nerfstudio", "out=data", "image=png"]) == 0
    np.testing.assert_array_equal(cv2.imread("data/images/frame_000010.png")[..., ::-1], sequence.frame(10).image)


def test_a_run_without_a_map_still_gives_its_poses_and_every_nth_frame(journey, capsys):
    frames, recorded = journey
    empty = replace(recorded, xyz=recorded.xyz[:0], rgb=recorded.rgb[:0], host=recorded.host[:0])
    write_run(Path("run"), empty, {"input": str(frames)})
    assert "frames: expected a run with a map for keyframes" in refused(capsys, "run=run", "out=data")
    assert main(["run=run", "out=data", "frames=10"]) == 0
    assert len(list(Path("data/images").iterdir())) == 1 * 6  # the first frame is from before the map


@pytest.mark.parametrize("existing", ["nothing", "export"])
@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), KeyboardInterrupt()])
@pytest.mark.parametrize(("name", "out"), [("colmap", "data"), ("kitti", "data.txt")])
def test_a_full_disk_or_ctrl_c_leaves_what_existed(run_folder, capsys, monkeypatch, name, out, failure, existing):
    arguments = ["run=run", f"format={name}", f"out={out}", "overwrite=true"]
    if existing == "export":
        assert main(arguments) == 0
    before = content(Path())
    method, allowed = ("write_text", 0) if name == "kitti" else ("write_bytes", 2)
    keep, written = getattr(Path, method), []

    def fail(path, *rest, **options):
        written.append(path)
        if len(written) > allowed:
            path.touch()
            raise failure
        return keep(path, *rest, **options)

    capsys.readouterr()
    with monkeypatch.context() as patched:
        patched.setattr(Path, method, fail)
        if isinstance(failure, OSError):
            expected = f"out: expected a place that can be written, got {out}: No space left on device."
            assert expected in refused(capsys, *arguments)
        else:
            assert main(arguments) == 130
            assert capsys.readouterr().err == "torchvo360-export: interrupted.\n"
    assert len(written) == allowed + 1
    assert content(Path()) == before


def test_an_export_is_replaced_only_when_asked_and_other_files_never(run_folder, capsys):
    arguments = ["run=run", "format=nerfstudio", "out=data"]
    assert main(arguments) == 0
    assert main([*arguments, "overwrite=true", "frames=5"]) == 0
    assert len(list(Path("data/images").iterdir())) == 4
    Path("data/notes.txt").write_text("mine")
    capsys.readouterr()
    message = "out: expected a folder that an export wrote, got data, which holds notes.txt."
    assert message in refused(capsys, *arguments, "overwrite=true")
    assert Path("data/notes.txt").read_text() == "mine"


def test_a_folder_that_cannot_get_its_name_puts_the_old_one_back(tmp_path, monkeypatch):
    final = tmp_path / "data"
    final.mkdir()
    (final / "old").write_text("old")
    real = os.replace

    def fail(source, target):
        if Path(source).name.endswith(".part"):
            raise OSError(errno.EIO, "defect")
        real(source, target)

    monkeypatch.setattr(os, "replace", fail)
    for place in (final, tmp_path / "new" / "data"):
        with pytest.raises(OSError, match="defect"), atomic_folder(place) as temporary:
            (temporary / "new").write_text("new")
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    assert content(tmp_path) == {"data/old": b"old"}


@pytest.mark.usefixtures("listening")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_it_and_leaves_nothing_half_written(run_folder, monkeypatch, number, code):
    def interrupted(path, image):
        path.touch()
        os.kill(os.getpid(), number)

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(dataset, "_encode", interrupted)
    try:
        ended = main(["run=run", "out=data"])
    except SystemExit as stopped:
        ended = stopped.code
    assert ended == code
    assert signal.getsignal(signal.SIGTERM) == before
    assert {path.name for path in Path().iterdir()} == {"run"}


def test_the_module_is_a_command(run_folder):
    environment = os.environ | {"PYTHONPATH": str(Path(torchvo360.__file__).parents[1]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "torchvo360.cli.export", "run=run", "format=frusta", "out=cameras.ply"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "frusta: cameras.ply\n", "")


def test_the_help_names_every_setting_and_format(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("torchvo360-export: ")
    for name in (*(f"{field}=" for field in ExportConfig.__dataclass_fields__), *NAMES):
        assert name in text
