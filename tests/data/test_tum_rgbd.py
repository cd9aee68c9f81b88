from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchvo360.cameras import Lens, Pinhole
from torchvo360.checks import InputError
from torchvo360.data.dataset import open_dataset
from torchvo360.data.recording import Recording
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.data.tum_rgbd import DISTORTION, INTRINSICS, TOLERANCE_NS, associate
from torchvo360.lie import matrix_from_quaternion, quaternion_from_matrix, se3, se3_inverse

T0 = 1_305_031_102_175_304_000
STEP = 33_000_000
CAMERA = Pinhole(32, 24, 30.0, 31.0, 16.5, 12.5)


def picture(k: int, width: int = 32, height: int = 24) -> np.ndarray:
    v, u = np.mgrid[:height, :width]
    return np.stack([40 + 5 * k + 0 * u, 60 + 3 * u % 120, 60 + 3 * v % 150], -1).astype(np.uint8)


def seconds(t_ns: int) -> str:
    return f"{t_ns // 10**9}.{t_ns % 10**9 // 1000:06d}"


def write_tum(
    folder: Path,
    *,
    colour: list[np.ndarray] | None = None,
    depth: list[np.ndarray] | None = None,
    depth_t_ns: list[int] | None = None,
    T_world_cam: torch.Tensor | None = None,
) -> Path:
    """Write images every 33 ms, and their depths 5 ms later if no times are given."""
    colour = [picture(k) for k in range(4)] if colour is None else colour
    depth = [np.full(colour[0].shape[:2], 5000 + 500 * k, np.uint16) for k in range(4)] if depth is None else depth
    t_ns = [T0 + STEP * k for k in range(len(colour))]
    depth_t_ns = [t + 5_000_000 for t in t_ns] if depth_t_ns is None else depth_t_ns
    for name, images, times in (("rgb", colour, t_ns), ("depth", depth, depth_t_ns)):
        (folder / name).mkdir(parents=True, exist_ok=True)
        lines = ["# images\n", "# file: 'rgbd_dataset.bag'\n", "# timestamp filename\n"]
        for image, t in zip(images, times, strict=True):
            file = f"{name}/{seconds(t)}.png"
            assert cv2.imwrite(str(folder / file), image[..., ::-1] if name == "rgb" else image)
            lines.append(f"{seconds(t)} {file}\n")
        (folder / f"{name}.txt").write_text("".join(lines))
    (folder / "accelerometer.txt").write_text("# timestamp ax ay az\n1 2 3 4\n")
    if T_world_cam is not None:
        q = quaternion_from_matrix(T_world_cam[:, :3, :3])
        rows = torch.cat([T_world_cam[:, :3, 3], q], -1).tolist()
        poses = (f"{seconds(t)} {' '.join(f'{x:.15g}' for x in row)}\n" for t, row in zip(t_ns, rows, strict=True))
        (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "".join(poses))
    return folder


def opened(folder: Path, **options) -> Recording:
    sequence = open_dataset(folder, **{"camera": CAMERA, **options})
    assert isinstance(sequence, Recording)
    return sequence


def refused(folder: Path, message: str, **options) -> None:
    with pytest.raises(InputError, match=message) as error:
        opened(folder, **options)
    assert str(error.value).count(". ") == 0  # one sentence


def test_frames_bring_colour_depth_in_metres_and_the_stamps(tmp_path):
    sequence = opened(write_tum(tmp_path / "room"))
    frames = list(sequence)
    assert [frame.t_ns for frame in frames] == [T0 + STEP * k for k in range(4)]
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert sequence.length == 4
    assert (sequence.name, sequence.camera, sequence.truth, sequence.rig, sequence.imu, sequence.mask) == (
        "room",
        CAMERA,
        None,
        None,
        None,
        None,
    )
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, picture(k))
        assert frame.depth is not None
        assert frame.depth.dtype == np.float32
        np.testing.assert_allclose(frame.depth, np.full((24, 32), 1 + 0.1 * k), rtol=1e-6)
    assert [frame.t_ns for frame in sequence] == [frame.t_ns for frame in frames]  # again


def test_unknown_depth_stays_zero_and_the_scale_is_the_callers(tmp_path):
    depth = [np.full((24, 32), 1500, np.uint16) for _ in range(4)]
    depth[0][:, 0] = 0
    frame = next(iter(opened(write_tum(tmp_path / "room", depth=depth), depth_scale=1000.0)))
    assert frame.depth is not None
    assert not frame.depth[:, 0].any()
    np.testing.assert_allclose(frame.depth[:, 1:], 1.5)


@pytest.mark.parametrize("number", ["1", "2", "3"])
def test_the_folders_name_tells_the_published_camera_and_half_a_pixel_is_added(tmp_path, number):
    colour = [picture(k, 640, 480) for k in range(2)]
    depth = [np.full((480, 640), 10_000, np.uint16) for _ in range(2)]
    folder = write_tum(tmp_path / f"rgbd_dataset_freiburg{number}_desk", colour=colour, depth=depth)
    sequence = opened(folder, camera=None)
    fx, fy, cx, cy = INTRINSICS[number]
    lens = Lens(640, 480, fx, fy, cx + 0.5, cy + 0.5, "radtan" if DISTORTION[number] else "none", DISTORTION[number])
    if number == "3":
        assert sequence.camera == Pinhole(640, 480, fx, fy, cx + 0.5, cy + 0.5)
    frame = next(iter(sequence))
    assert frame.image is not None
    assert frame.depth is not None
    # what the lens saw at the ray's pixel is what the camera shows there: blue is 60 + 3 row, up to the jumps
    uv = sequence.camera.pixel_grid(dtype=torch.float64)
    seen, valid = lens.project(sequence.camera.ray(uv))
    assert bool(valid[1:-1, 1:-1].all())
    blue = torch.from_numpy(colour[0][:, 0, 2].astype(np.float64))
    row = seen[..., 1].floor().long().clamp(1, 478)
    smooth = (blue[row + 1] - blue[row - 1]).abs() == 6
    expected = 60 + 3 * (seen[..., 1] - 0.5) % 150
    got = torch.from_numpy(frame.image[..., 2]).double()
    assert float((got - expected)[smooth].abs().max()) < 0.8  # rounding, and the interpolation's 1/32 px
    assert float((got - expected)[smooth].mean().abs()) < 0.03  # 0.01 px
    np.testing.assert_allclose(frame.depth[frame.depth > 0], 2.0)
    assert frame.depth.shape == frame.image.shape[:2] == (sequence.camera.height, sequence.camera.width)


def test_times_pair_nearest_first_and_once():
    rgb = np.array([0, 33, 66, 99, 200, 300]) * 1_000_000
    depth = np.array([16, 50, 70, 101, 110, 321]) * 1_000_000
    # 66 takes 70 and 99 takes 101; 33 is as near to 16 as to 50, and 0 has only 16
    assert associate(rgb, depth, TOLERANCE_NS).tolist() == [0, 1, 2, 3, -1, -1]
    assert associate(rgb, rgb, TOLERANCE_NS).tolist() == list(range(6))
    both = np.array([0, 10]) * 1_000_000
    assert associate(both, np.array([9_000_000]), TOLERANCE_NS).tolist() == [-1, 0]
    assert associate(np.array([0]), np.array([TOLERANCE_NS]), TOLERANCE_NS).tolist() == [0]
    assert associate(np.array([0]), np.array([TOLERANCE_NS + 1]), TOLERANCE_NS).tolist() == [-1]


def test_a_colour_image_without_depth_near_in_time_stays_and_is_noted(tmp_path):
    times = [T0 - 2_000_000, T0 + STEP - 3_000_000, T0 + 2 * STEP + 4_000_000]
    sequence = opened(write_tum(tmp_path / "room", depth=[np.full((24, 32), 5000, np.uint16)] * 3, depth_t_ns=times))
    assert [frame.depth is not None for frame in sequence] == [True, True, True, False]
    assert sequence.notes == ["depth: 1 of 4 colour images have none within 20 ms."]


def test_start_stop_and_every_keep_the_sources_numbers(tmp_path):
    sequence = opened(write_tum(tmp_path / "room"), start=1, every=2)
    assert [frame.index for frame in sequence] == [1, 3]
    assert sequence.length == 2
    frames = list(sequence)
    np.testing.assert_array_equal(frames[1].image, picture(3))
    assert frames[1].depth is not None
    assert frames[1].depth[0, 0] == pytest.approx(1.3)
    refused(tmp_path / "room", "expected at least two frames after start, stop and every, got 1", stop=1)
    refused(tmp_path / "room", "start: expected less than the 4 frames", start=9)
    refused(tmp_path / "room", "every: expected at least 1", every=0)


def test_another_size_scales_the_camera_and_never_mixes_depths(tmp_path):
    depth = [np.where(np.arange(32) % 8 < 4, 5000, 20_000).astype(np.uint16)[None].repeat(24, 0) for _ in range(4)]
    sequence = opened(write_tum(tmp_path / "room", depth=depth), resize=(16, 12))
    assert sequence.camera == Pinhole(16, 12, 15.0, 15.5, 8.25, 6.25)
    frame = next(iter(sequence))
    assert frame.image is not None
    assert frame.image.shape == (12, 16, 3)
    np.testing.assert_allclose(frame.image, picture(0).reshape(12, 2, 16, 2, 3).mean((1, 3)), atol=0.51)
    np.testing.assert_array_equal(frame.depth, depth[0][::2, ::2] / np.float32(5000))
    refused(tmp_path / "room", "resize: expected a width and a height", resize=(0, 5))


def test_what_is_wrong_with_one_frame_is_said_there(tmp_path):
    colour = [picture(k) for k in range(4)]
    colour[1] = np.zeros_like(colour[1])
    colour[2] = picture(2, 16, 12)
    folder = write_tum(tmp_path / "room", colour=colour)
    (folder / "rgb" / f"{seconds(T0 + 3 * STEP)}.png").unlink()
    (folder / "depth" / f"{seconds(T0 + 5_000_000)}.png").write_bytes(b"no image")
    frames = list(opened(folder))
    assert [frame.problem for frame in frames] == ["", "black", "size", "unreadable"]
    assert frames[0].depth is None
    assert [frame.image is None for frame in frames] == [False, False, True, True]


def test_a_depth_image_of_another_size_counts_as_none(tmp_path):
    depth = [np.full((24, 32), 5000, np.uint16) for _ in range(4)]
    depth[2] = np.full((12, 16), 5000, np.uint16)
    frames = list(opened(write_tum(tmp_path / "room", depth=depth)))
    assert [frame.depth is None for frame in frames] == [False, False, True, False]


def test_without_depth_txt_the_colour_images_remain(tmp_path):
    folder = write_tum(tmp_path / "room")
    (folder / "depth.txt").unlink()
    sequence = opened(folder)
    assert all(frame.depth is None and frame.image is not None for frame in sequence)
    assert "no depth.txt" in sequence.notes[0]


@pytest.mark.parametrize(
    ("value", "scale", "message"),
    [
        (5000, 1.0, "depth_scale: .* got 5e.03 m with 1 a metre"),
        (300, 5000.0, "depth_scale: .* got 0.06 m with 5000 a metre"),
        (0, 5000.0, "expected depth, got none at any pixel of the first 4 images"),
        (5000, 0.0, "depth_scale: expected a finite number above 0"),
        (5000, float("nan"), "depth_scale: expected a finite number"),
        (5000, 1e300, "depth_scale: expected 0.01 to"),
    ],
)
def test_depth_in_another_unit_or_without_any_value_is_refused(tmp_path, value, scale, message):
    folder = write_tum(tmp_path / "room", depth=[np.full((24, 32), value, np.uint16)] * 4)
    refused(folder, message, depth_scale=scale)


def test_depth_images_of_another_kind_or_size_are_refused(tmp_path):
    eight_bits = write_tum(tmp_path / "a", depth=[np.full((24, 32), 200, np.uint8)] * 4)
    refused(eight_bits, "expected depth images of 16 bits and one channel, got none")
    smaller = write_tum(tmp_path / "b", depth=[np.full((12, 16), 5000, np.uint16)] * 4)
    refused(smaller, "expected depth images of the colour images' size 32 x 24, got 16 x 12")


def test_a_folder_of_no_known_camera_needs_one(tmp_path):
    folder = write_tum(tmp_path / "room")
    refused(folder, "camera: expected a calibration for .*freiburg1, freiburg2 and freiburg3", camera=None)
    refused(folder, "expected images of the calibration's size 64 x 48, got 32 x 24", camera=CAMERA.resized(64, 48))
    refused(folder, "focal length fx above 0, got -30", camera=Pinhole(32, 24, -30.0, 30.0, 16.0, 12.0))
    refused(folder, "a principal point near the image", camera=Pinhole(32, 24, 30.0, 30.0, 318.6, 12.0))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("", "rgb.txt: expected lines `timestamp filename`, got none"),
        ("1.0 rgb/a.png\n1.0 rgb/b.png\n", "rgb.txt, line 2: expected a time later than the line before"),
        ("2.0 rgb/a.png\n1.0 rgb/b.png\n", "rgb.txt, line 2: expected a time later than the line before"),
        ("# x\n1.0\n", "rgb.txt, line 2: expected 2 columns, .* got 1"),
        ("now rgb/a.png\n", "rgb.txt, line 1: expected a time in seconds, got 'now'"),
        ("inf rgb/a.png\n", "rgb.txt, line 1: expected a time in seconds"),
        ("1e300 rgb/a.png\n", "rgb.txt, line 1: expected a time in seconds"),
        ("1.0 /etc/a.png\n", "line 1: expected the name of a file inside the folder, got '/etc/a.png'"),
        ("1.0 rgb/../../a.png\n", "line 1: expected the name of a file inside the folder"),
        ("1.0 rgb\\..\\..\\a.png\n", "line 1: expected the name of a file inside the folder"),
        ("1.0 C:\\a.png\n", "line 1: expected the name of a file inside the folder"),
        ("1.0 rgb/a.png\n2.0 rgb/b\x00.png\n", "rgb.txt: expected readable images, got none"),
        ("1.0 rgb/a.png\n", "expected at least two frames, got 1"),
    ],
)
def test_a_bad_list_is_refused_in_one_sentence(tmp_path, lines, message):
    folder = write_tum(tmp_path / "room")
    (folder / "depth.txt").unlink()
    (folder / "rgb.txt").write_text(lines)
    refused(folder, message)


def test_depth_of_another_clock_is_refused(tmp_path):
    folder = write_tum(tmp_path / "room", depth_t_ns=[10**9 * k for k in range(1, 5)])
    refused(folder, "depth.txt: expected times within 20 ms of those in rgb.txt, got none")


def test_a_rendered_sequence_comes_back_with_its_geometry(tmp_path):
    world = SyntheticSequence(SyntheticConfig(camera="pinhole", width=160, height=120, frames=3, fps=10.0))
    fx, fy, cx, cy = world.camera.intrinsics
    ranges = [world.range(k) for k in range(3)]
    folder = write_tum(
        tmp_path / "walk",
        colour=[frame.image for frame in world if frame.image is not None],
        depth=[(5000 * r).round().clamp(max=65535).numpy().astype(np.uint16) for r in ranges],
        T_world_cam=world.truth.T_world_cam,
    )
    # the published convention: pixel centres at integers
    lens = Lens.of_opencv(160, 120, (fx, fy, cx - 0.5, cy - 0.5))
    sequence = opened(folder, camera=lens)
    assert sequence.truth is not None
    frames = list(sequence)
    assert len(sequence.truth) == len(frames) == 3
    # by what was read: from the depth of frame 0 to the pixels of frame 2
    assert frames[0].depth is not None
    T = sequence.truth.T_world_cam
    p = sequence.camera.ray_grid(dtype=torch.float64) * torch.from_numpy(frames[0].depth).double()[..., None]
    T_2_0 = se3_inverse(T[2]) @ T[0]
    read, valid = sequence.camera.project(p @ T_2_0[:3, :3].mT + T_2_0[:3, 3])
    # by the exact world
    p = world.camera.ray_grid(dtype=torch.float64) * ranges[0].double()[..., None]
    T_2_0 = se3_inverse(world.pose(2)) @ world.pose(0)
    exact, _ = world.camera.project(p @ T_2_0[:3, :3].mT + T_2_0[:3, 3])
    assert float(valid.double().mean()) > 0.5
    assert float((read - exact)[valid].abs().max()) < 0.01


def stored(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def test_a_real_recording_agrees_with_its_depth_and_its_poses(tmp_path, shared):
    source = shared / "data" / "pinhole_rgbd" / "rgbd"
    colour = [stored(source / "color" / f"{k}.png")[..., ::-1] for k in range(1, 6)]
    depth = [stored(source / "depth" / f"{k}.pgm") for k in range(1, 6)]
    values = torch.from_numpy(np.loadtxt(source / "pose.txt"))
    T_world_cam = se3(matrix_from_quaternion(values[:, 3:]), values[:, :3])
    folder = write_tum(tmp_path / "room", colour=colour, depth=depth, T_world_cam=T_world_cam)
    lens = Lens.of_opencv(640, 480, (518.0, 519.0, 325.5, 253.5))
    sequence = opened(folder, camera=lens, depth_scale=1000.0, resize=(320, 240))
    assert sequence.truth is not None
    T, frames = sequence.truth.T_world_cam, list(sequence)
    for a, b in pairwise(range(5)):
        image_a, image_b, z = frames[a].image, frames[b].image, frames[b].depth
        assert image_a is not None
        assert image_b is not None
        assert z is not None
        # what frame b shows, looked up in frame a at the place where its depth and the poses put it
        T_a_b = se3_inverse(T[a]) @ T[b]
        p = sequence.camera.ray_grid(dtype=torch.float64) * torch.from_numpy(z).double()[..., None]
        uv, valid = sequence.camera.project(p @ T_a_b[:3, :3].mT + T_a_b[:3, 3])
        valid = (valid & torch.from_numpy(z > 0)).numpy()
        map_uv = (uv - 0.5).float().numpy()
        warped = cv2.remap(image_a, map_uv[..., 0], map_uv[..., 1], cv2.INTER_LINEAR)
        moved, still = (np.abs(image.astype(float) - image_b)[valid].mean() for image in (warped, image_a))
        assert valid.mean() > 0.3
        assert moved < 0.8 * still
