from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchvo360.cameras import Pinhole
from torchvo360.checks import InputError
from torchvo360.data.dataset import open_dataset
from torchvo360.data.recording import Recording
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.lie import se3, se3_inverse, so3_exp

FX, CX, CY = 36.0, 15.6, 11.7
BASELINE = 0.54
# a camera 2 beside camera 0, and 3 beside 1, as in the published calibrations: not quite on one line
CENTRES = {0: (0.0, 0.0, 0.0), 1: (BASELINE, 0.0, 0.0), 2: (-0.06, 0.001, -0.003), 3: (0.475, -0.002, -0.003)}


def picture(k: int, camera: int = 0, width: int = 32, height: int = 24) -> np.ndarray:
    v, u = np.mgrid[:height, :width]
    return (40 + 10 * k + 3 * camera + 2 * u + v).astype(np.uint8)


def projection(camera: int, fx: float = FX, cx: float = CX, cy: float = CY) -> list[float]:
    K = np.array([[fx, 0, cx], [0, fx, cy], [0, 0, 1]])
    return np.concatenate([K, -K @ np.array(CENTRES[camera])[:, None]], 1).flatten().tolist()


def row(values: list[float]) -> str:
    return " ".join(f"{value:.12e}" for value in values)


def write_kitti(
    root: Path,
    *,
    cameras: tuple[int, ...] = (0, 1, 2, 3),
    frames: int = 4,
    images: dict[int, list[np.ndarray]] | None = None,
    calib: str | None = None,
    T_world_cam0: torch.Tensor | None = None,
) -> Path:
    folder = root / "sequences" / "07"
    folder.mkdir(parents=True)
    for camera in cameras:
        (folder / f"image_{camera}").mkdir()
        for k in range(frames):
            image = picture(k, camera) if images is None else images[camera][k]
            assert cv2.imwrite(str(folder / f"image_{camera}" / f"{k:06d}.png"), image)
    lines = "".join(f"P{camera}: {row(projection(camera))}\n" for camera in range(4))
    (folder / "calib.txt").write_text(lines + "Tr: " + row([0.0] * 12) + "\n" if calib is None else calib)
    (folder / "times.txt").write_text("".join(f"{0.1036 * k:.6e}\n" for k in range(frames)))
    if T_world_cam0 is not None:
        (root / "poses").mkdir()
        lines = "".join(row(T[:3].flatten().tolist()) + "\n" for T in T_world_cam0)
        (root / "poses" / "07.txt").write_text(lines)
    return folder


def opened(folder: Path, **options) -> Recording:
    sequence = open_dataset(str(folder), **options)
    assert isinstance(sequence, Recording)
    return sequence


def refused(folder: Path, message: str, **options) -> None:
    with pytest.raises(InputError, match=message) as error:
        opened(folder, **options)
    assert str(error.value).count(". ") == 0  # one sentence


def path_of(frames: int) -> torch.Tensor:
    s = torch.arange(frames, dtype=torch.float64)[:, None]
    axis = torch.tensor([[0.02, 0.1, -0.01]], dtype=torch.float64)
    return se3(so3_exp(s * axis), s * torch.tensor([[0.1, -0.02, 1.0]], dtype=torch.float64))


def test_frames_bring_both_images_and_times_in_nanoseconds(tmp_path):
    sequence = opened(write_kitti(tmp_path, cameras=(0, 1)))
    frames = list(sequence)
    assert sequence.name == "kitti_07"
    assert (sequence.length, sequence.imu, sequence.truth, sequence.notes) == (4, None, None, [])
    assert [frame.t_ns for frame in frames] == [0, 103_600_000, 207_200_000, 310_800_000]
    for k, frame in enumerate(frames):
        assert frame.image is not None
        assert frame.others[0] is not None
        np.testing.assert_array_equal(frame.image, picture(k, 0)[..., None].repeat(3, -1))
        np.testing.assert_array_equal(frame.others[0], picture(k, 1)[..., None].repeat(3, -1))


def test_half_a_pixel_is_added_and_the_right_camera_is_to_the_right(tmp_path):
    sequence = opened(write_kitti(tmp_path, cameras=(0, 1)))
    camera = Pinhole(32, 24, FX, FX, CX + 0.5, CY + 0.5)
    assert sequence.camera == camera
    assert sequence.rig is not None
    assert sequence.rig.cameras == (camera, camera)
    expected = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    expected[1, 0, 3] = BASELINE
    torch.testing.assert_close(sequence.rig.T_body_cam, expected)


def test_colour_is_preferred_with_its_own_place(tmp_path):
    T_world_cam0 = path_of(4)
    sequence = opened(write_kitti(tmp_path, T_world_cam0=T_world_cam0))
    frame = next(iter(sequence))
    assert frame.image is not None
    assert frame.image[0, 0].tolist() == [46, 46, 46]
    assert sequence.rig is not None
    apart = torch.tensor(CENTRES[3], dtype=torch.float64) - torch.tensor(CENTRES[2], dtype=torch.float64)
    torch.testing.assert_close(sequence.rig.T_body_cam[1, :3, 3], apart, atol=1e-9, rtol=0)
    # the truth is of the camera whose images are used: where camera 2 is in camera 0
    assert sequence.truth is not None
    assert sequence.truth.t_ns.tolist() == [frame.t_ns for frame in sequence]
    centre = torch.tensor([*CENTRES[2], 1.0], dtype=torch.float64)
    torch.testing.assert_close(sequence.truth.positions, (T_world_cam0 @ centre)[:, :3], atol=1e-9, rtol=0)
    torch.testing.assert_close(sequence.truth.T_world_cam[:, :3, :3], T_world_cam0[:, :3, :3])


def test_one_camera_where_the_other_is_not_there_or_not_wanted(tmp_path):
    folder = write_kitti(tmp_path / "a", cameras=(0,), T_world_cam0=path_of(4))
    sequence = opened(folder)
    assert sequence.rig is None
    assert next(iter(sequence)).others == ()
    assert sequence.truth is not None
    torch.testing.assert_close(sequence.truth.T_world_cam, path_of(4))
    assert opened(write_kitti(tmp_path / "b"), stereo=False).rig is None


def test_start_stop_every_and_another_size(tmp_path):
    sequence = opened(write_kitti(tmp_path, cameras=(0, 1)), start=1, every=2, resize=(16, 12))
    assert [frame.index for frame in sequence] == [1, 3]
    camera = Pinhole(16, 12, FX / 2, FX / 2, (CX + 0.5) / 2, (CY + 0.5) / 2)
    assert sequence.rig is not None
    assert sequence.rig.cameras == (camera, camera)
    for frame in sequence:
        for image in (frame.image, *frame.others):
            assert image is not None
            assert image.shape == (12, 16, 3)


def test_an_absent_image_is_a_problem_of_its_frame_alone(tmp_path):
    folder = write_kitti(tmp_path, cameras=(0, 1))
    (folder / "image_0" / "000001.png").unlink()
    (folder / "image_1" / "000002.png").unlink()
    (folder / "image_1" / "000003.png").write_bytes(b"no image")
    frames = list(opened(folder))
    assert [frame.problem for frame in frames] == ["", "unreadable", "", ""]
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert [frame.others[0] is None for frame in frames] == [False, True, True, True]


def test_times_beyond_the_last_image_are_left_out_and_noted(tmp_path):
    folder = write_kitti(tmp_path, cameras=(0,))
    (folder / "image_0" / "000003.png").unlink()
    sequence = opened(folder)
    assert sequence.length == 3
    assert sequence.notes == ["times.txt: of 4 times the first 3 have images."]


def test_left_and_right_images_that_do_not_belong_together_are_refused(tmp_path):
    folder = write_kitti(tmp_path / "number", cameras=(0, 1))
    (folder / "image_1" / "000003.png").unlink()
    refused(folder, "image_1: expected as many images as the left camera's 4, got 3")
    assert opened(folder, stereo=False).length == 4
    sizes = {0: [picture(k) for k in range(4)], 1: [picture(k, width=30) for k in range(4)]}
    folder = write_kitti(tmp_path / "size", cameras=(0, 1), images=sizes)
    refused(folder, "expected the cameras' images to have one size, got 30 x 24 and 32 x 24")


GOOD = f"P0: {row(projection(0))}\nP1: {row(projection(1))}\n"


@pytest.mark.parametrize(
    ("calib", "message"),
    [
        ("", "calib.txt: expected lines `P0: .* got none"),
        (f"P1: {row(projection(1))}\n", "calib.txt: expected a line `P0:` with 12 numbers, got none"),
        (f"P0: {row(projection(0))}\n", "calib.txt: expected a line `P1:` with 12 numbers, got none"),
        (f"P0: {row(projection(0)[:11])}\n", "calib.txt, line 1: expected 13 columns, P0: and 12 numbers, got 12"),
        (GOOD.replace("e+00", "e+zz", 1), "calib.txt, line 1: expected numbers"),
        (f"P0: {row(projection(0, fx=0.0))}\n", "line 1: expected a projection .* fx and fy above 0"),
        (f"P0: {row(projection(0, fx=-36.0))}\n", "line 1: expected a projection .* fx and fy above 0"),
        (f"P0: {row([1.0] * 12)}\n", "line 1: expected a projection"),
        (f"P0: {row([float('nan')] * 12)}\n", "line 1: expected finite numbers"),
        (f"P0: {row(projection(0, cx=600.0))}\nP1: {row(projection(1))}\n", "P0: expected a principal point near"),
        (
            f"P0: {row(projection(0))}\nP1: {row(projection(2))}\n",
            "expected camera 1 to the right of camera 0, got .*-0.06",
        ),
    ],
)
def test_an_impossible_calibration_is_refused(tmp_path, calib, message):
    refused(write_kitti(tmp_path, cameras=(0, 1), calib=calib), message)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ("", "times.txt: expected lines `time in seconds`, got none"),
        ("0.0\n0.1\n0.2\n", "times.txt: expected a time for each of 4 images, got 3"),
        ("0.0\n0.2\n0.1\n0.3\n", "times.txt, line 3: expected a time later than the line before, got 0.1"),
        ("0.0\n0.1\nsoon\n0.3\n", "times.txt, line 3: expected a time in seconds, got 'soon'"),
        ("0.0 1\n0.1 2\n", "times.txt, line 1: expected 1 column, time in seconds, got 2"),
    ],
)
def test_bad_times_are_refused(tmp_path, times, message):
    folder = write_kitti(tmp_path, cameras=(0, 1))
    (folder / "times.txt").write_text(times)
    refused(folder, message)


def test_bad_poses_are_refused(tmp_path):
    poses = path_of(3)
    refused(write_kitti(tmp_path / "number", T_world_cam0=poses), "07.txt: expected a pose for each of 4 times, got 3")
    poses = path_of(4)
    poses[2, :3, :3] *= 1.1
    refused(write_kitti(tmp_path / "scaled", T_world_cam0=poses), "07.txt, line 3: expected a rotation")


def test_missing_files_are_named(tmp_path):
    folder = write_kitti(tmp_path, cameras=(0,))
    (folder / "times.txt").rename(folder / "elsewhere.txt")
    refused(folder, "times.txt: expected a text file .* got No such file")
    (folder / "elsewhere.txt").rename(folder / "times.txt")
    (folder / "calib.txt").unlink()
    refused(folder, "calib.txt: expected a text file .* got No such file")
    for file in (folder / "image_0").iterdir():
        file.unlink()
    (folder / "calib.txt").write_text(GOOD)
    refused(folder, "image_0: expected images 000000.png, 000001.png and so on, got none")
    for k in range(4):
        (folder / "image_0" / f"{k:06d}.png").write_bytes(b"no image")
    refused(folder, "image_0: expected readable images, got none among the first")
    (folder / "image_0").rename(folder / "image_9")
    refused(folder, "expected a folder image_0 or image_2", kind="kitti")


def test_a_rendered_stereo_sequence_comes_back_with_its_geometry(tmp_path):
    config = SyntheticConfig(camera="pinhole", width=160, height=120, frames=3, fps=10.0, stereo_baseline=0.2)
    world = SyntheticSequence(config)
    fx, fy, cx, cy = world.camera.intrinsics
    pictures: dict[int, list[np.ndarray]] = {0: [], 1: []}
    for frame in world:
        assert frame.image is not None
        assert frame.others[0] is not None
        pictures[0].append(frame.image)
        pictures[1].append(frame.others[0])
    # the published convention: pixel centres at integers, the baseline times -fx in the fourth column
    P = [fx, 0.0, cx - 0.5, 0.0, 0.0, fy, cy - 0.5, 0.0, 0.0, 0.0, 1.0, 0.0]
    calib = f"P0: {row(P)}\nP1: {row([*P[:3], -0.2 * fx, *P[4:]])}\n"
    T_first_cam = se3_inverse(world.pose(0)) @ world.truth.T_world_cam
    folder = write_kitti(tmp_path, cameras=(0, 1), frames=3, images=pictures, calib=calib, T_world_cam0=T_first_cam)
    sequence = opened(folder)
    assert sequence.rig is not None
    assert sequence.truth is not None
    assert world.rig is not None
    # by what was read, and by the exact world: frame 0 seen by the left and the right camera of frame 2
    p = world.range(0).double()[..., None]
    T = sequence.truth.T_world_cam
    T_2_0, exact_2_0 = se3_inverse(T[2]) @ T[0], se3_inverse(world.pose(2)) @ world.pose(0)
    for camera in (0, 1):
        T_cam_first = se3_inverse(sequence.rig.T_body_cam[camera]) @ T_2_0
        exact_cam_first = se3_inverse(world.rig.T_body_cam[camera]) @ exact_2_0
        points = sequence.camera.ray_grid(dtype=torch.float64) * p
        read, valid = sequence.rig.cameras[camera].project(points @ T_cam_first[:3, :3].mT + T_cam_first[:3, 3])
        points = world.camera.ray_grid(dtype=torch.float64) * p
        exact, _ = world.camera.project(points @ exact_cam_first[:3, :3].mT + exact_cam_first[:3, 3])
        assert float(valid.double().mean()) > 0.5
        assert float((read - exact)[valid].abs().max()) < 0.01
