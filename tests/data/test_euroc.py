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
from torchvo360.inertial import ImuNoise
from torchvo360.lie import quaternion_from_matrix, se3, se3_exp, se3_inverse, so3_exp

T0 = 1_403_715_523_912_143_104
STEP = 50_000_000
INTRINSICS = (30.0, 31.0, 15.2, 11.9)

# cam0 lies across the body, cam1 beside it, as on the real rig
T_BODY_CAM0 = torch.tensor(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ],
    dtype=torch.float64,
)
T_CAM0_CAM1 = se3_exp(torch.tensor([0.11, 0.001, -0.002, 0.01, -0.02, 0.005], dtype=torch.float64))
T_BODY_CAM1 = T_BODY_CAM0 @ T_CAM0_CAM1
T_BODY_IMU = se3_exp(torch.tensor([0.01, 0.02, 0.03, 0.1, 0.0, -0.2], dtype=torch.float64))


def picture(k: int, camera: int = 0, width: int = 32, height: int = 24) -> np.ndarray:
    v, u = np.mgrid[:height, :width]
    return (40 + 10 * k + 5 * camera + 2 * u + v).astype(np.uint8)


def matrix(T: torch.Tensor) -> str:
    return (
        "  cols: 4\n  rows: 4\n  data: ["
        + ",\n         ".join(", ".join(f"{value:.12g}" for value in row) for row in T.tolist())
        + "]\n"
    )


def camera_yaml(
    T_body_cam: torch.Tensor,
    *,
    size: tuple[int, int] = (32, 24),
    intrinsics: tuple[float, ...] = INTRINSICS,
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
) -> str:
    return (
        "%YAML:1.0\n# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0 (MT9M034)\n\n"
        f"# Sensor extrinsics wrt. the body-frame.\nT_BS:\n{matrix(T_body_cam)}\n"
        f"rate_hz: 20\nresolution: {list(size)}\ncamera_model: pinhole\n"
        f"intrinsics: {list(intrinsics)} #fu, fv, cu, cv\n"
        f"distortion_model: radial-tangential\ndistortion_coefficients: {list(distortion)}\n"
    )


def imu_yaml() -> str:
    return (
        f"%YAML:1.0\nsensor_type: imu\ncomment: VI-Sensor IMU (ADIS16448)\nT_BS:\n{matrix(T_BODY_IMU)}rate_hz: 200\n"
        "gyroscope_noise_density: 1.5e-04     # [ rad / s / sqrt(Hz) ]\n"
        "gyroscope_random_walk: 2e-5\n"  # a word for YAML
        "accelerometer_noise_density: 2.5000e-3\naccelerometer_random_walk: 4.0000e-3\n"
    )


def write_camera(folder: Path, yaml: str, images: list[np.ndarray], t_ns: list[int]) -> None:
    (folder / "data").mkdir(parents=True)
    (folder / "sensor.yaml").write_text(yaml)
    for image, t in zip(images, t_ns, strict=True):
        assert cv2.imwrite(str(folder / "data" / f"{t}.png"), image)
    rows = "".join(f"{t},{t}.png\r\n" for t in t_ns)
    (folder / "data.csv").write_bytes(f"#timestamp [ns],filename\r\n{rows}".encode())


def write_euroc(root: Path, *, cameras: int = 2, imu: bool = True, frames: int = 4) -> Path:
    t_ns = [T0 + STEP * k for k in range(frames)]
    for camera, T in enumerate((T_BODY_CAM0, T_BODY_CAM1)[:cameras]):
        images = [picture(k, camera) for k in range(frames)]
        write_camera(root / "mav0" / f"cam{camera}", camera_yaml(T), images, t_ns)
    if imu:
        folder = root / "mav0" / "imu0"
        folder.mkdir()
        (folder / "sensor.yaml").write_text(imu_yaml())
        rows = "".join(f"{T0 + 5_000_000 * k},0.01,0.02,0.03,9.2,0.3,-3.1\n" for k in range(40))
        (folder / "data.csv").write_text(f"#timestamp [ns],w_RS_S_x [rad s^-1]\n{rows}")
    return root


def write_truth(root: Path, T_world_body: torch.Tensor, t_ns: list[int]) -> None:
    x, y, z, w = quaternion_from_matrix(T_world_body[:, :3, :3]).unbind(-1)
    rows = torch.cat([T_world_body[:, :3, 3], torch.stack([w, x, y, z], -1), torch.zeros(len(t_ns), 9)], -1)
    folder = root / "mav0" / "state_groundtruth_estimate0"
    folder.mkdir()
    lines = (f"{t},{','.join(f'{v:.15g}' for v in row)}\n" for t, row in zip(t_ns, rows.tolist(), strict=True))
    (folder / "data.csv").write_text("#timestamp, p_RS_R_x [m], ..., q_RS_w [], q_RS_x [], ...\n" + "".join(lines))


def opened(folder: Path, **options) -> Recording:
    sequence = open_dataset(folder, **options)
    assert isinstance(sequence, Recording)
    return sequence


def refused(folder: Path, message: str, **options) -> None:
    with pytest.raises(InputError, match=message) as error:
        opened(folder, **options)
    assert str(error.value).count(". ") == 0  # one sentence


def replace(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_frames_bring_both_images_with_every_nanosecond(tmp_path):
    sequence = opened(write_euroc(tmp_path / "V1_02_medium"))
    frames = list(sequence)
    assert (sequence.name, sequence.length, sequence.truth, sequence.mask) == ("V1_02_medium", 4, None, None)
    assert [frame.t_ns for frame in frames] == [T0 + STEP * k for k in range(4)]
    for k, frame in enumerate(frames):
        for camera, image in enumerate((frame.image, *frame.others)):
            assert image is not None
            np.testing.assert_array_equal(image, picture(k, camera)[..., None].repeat(3, -1))


@pytest.mark.parametrize("part", ["", "mav0"])
def test_the_folder_and_the_one_around_it_are_the_same(tmp_path, part):
    sequence = opened(write_euroc(tmp_path / "MH_01") / part)
    assert sequence.name == "MH_01"
    assert sequence.rig is not None
    assert sequence.imu is not None


def test_half_a_pixel_is_added_and_the_rig_keeps_its_places(tmp_path):
    sequence = opened(write_euroc(tmp_path))
    camera = Pinhole(32, 24, 30.0, 31.0, 15.7, 12.4)
    assert sequence.camera == camera
    assert sequence.rig is not None
    assert sequence.rig.cameras == (camera, camera)
    torch.testing.assert_close(sequence.rig.T_body_cam[0], torch.eye(4, dtype=torch.float64))
    torch.testing.assert_close(sequence.rig.T_body_cam[1], T_CAM0_CAM1, atol=1e-9, rtol=0)


def test_the_imu_has_its_place_in_cam0_and_its_noise(tmp_path):
    imu = opened(write_euroc(tmp_path)).imu
    assert imu is not None
    torch.testing.assert_close(T_BODY_CAM0 @ imu.T_cam_imu, T_BODY_IMU, atol=1e-9, rtol=0)
    assert imu.noise == ImuNoise(gyro=1.5e-4, gyro_walk=2e-5, accel=2.5e-3, accel_walk=4e-3)
    assert len(imu.samples) == 40
    assert (imu.samples.period_ns, imu.offset_s) == (5_000_000, 0.0)


def test_what_is_not_there_or_not_wanted_is_left_out(tmp_path):
    alone = opened(write_euroc(tmp_path / "a", cameras=1, imu=False))
    assert (alone.rig, alone.imu, alone.truth) == (None, None, None)
    assert next(iter(alone)).others == ()
    both = opened(write_euroc(tmp_path / "b"), stereo=False, use_imu=False)
    assert (both.rig, both.imu) == (None, None)


def test_an_imu_without_calibration_is_the_body_and_that_is_said(tmp_path):
    (write_euroc(tmp_path) / "mav0" / "imu0" / "sensor.yaml").unlink()
    sequence = opened(tmp_path)
    assert sequence.imu is not None
    torch.testing.assert_close(sequence.imu.T_cam_imu, se3_inverse(T_BODY_CAM0), atol=1e-9, rtol=0)
    assert sequence.imu.noise == ImuNoise()
    assert "no sensor.yaml for imu0" in sequence.notes[0]


def test_the_truth_is_cam0s(tmp_path):
    s = torch.arange(5, dtype=torch.float64)[:, None]
    axis, way = torch.tensor([[0.1, -0.3, 0.2]]).double(), torch.tensor([[1.0, 0.5, -0.2]]).double()
    T_world_body = se3(so3_exp(s * axis), s * way)
    t_ns = [T0 + 25_000_000 * k for k in range(5)]
    write_truth(write_euroc(tmp_path), T_world_body, t_ns)
    truth = opened(tmp_path).truth
    assert truth is not None
    assert truth.t_ns.tolist() == t_ns
    torch.testing.assert_close(truth.T_world_cam, T_world_body @ T_BODY_CAM0, atol=1e-9, rtol=0)


def test_images_belong_together_by_equal_times_alone(tmp_path):
    t_ns = [T0 + STEP * k for k in range(4)]
    root = write_euroc(tmp_path, cameras=1)
    late = [t_ns[0], t_ns[1] + 1, t_ns[3], t_ns[3] + STEP]
    images = [picture(k, 1) for k in (0, 1, 3, 4)]
    write_camera(root / "mav0" / "cam1", camera_yaml(T_BODY_CAM1), images, late)
    frames = list(opened(root))
    assert [frame.t_ns for frame in frames] == t_ns
    assert [frame.others[0] is None for frame in frames] == [False, True, True, False]
    np.testing.assert_array_equal(frames[3].others[0], picture(3, 1)[..., None].repeat(3, -1))


def test_start_stop_every_and_another_size(tmp_path):
    sequence = opened(write_euroc(tmp_path), start=1, stop=4, every=2, resize=(16, 12))
    assert [frame.index for frame in sequence] == [1, 3]
    assert sequence.camera == Pinhole(16, 12, 15.0, 15.5, 7.85, 6.2)
    assert all(image is not None and image.shape == (12, 16, 3) for f in sequence for image in (f.image, *f.others))


def test_listed_images_that_are_absent_or_damaged_are_problems_of_their_frames(tmp_path):
    root = write_euroc(tmp_path)
    for camera, k in ((0, 1), (1, 2)):
        (root / "mav0" / f"cam{camera}" / "data" / f"{T0 + STEP * k}.png").unlink()
    assert cv2.imwrite(str(root / "mav0" / "cam0" / "data" / f"{T0 + STEP * 3}.png"), picture(3, width=20))
    frames = list(opened(root))
    assert [frame.problem for frame in frames] == ["", "unreadable", "", "size"]
    assert [frame.others[0] is None for frame in frames] == [False, True, True, True]


@pytest.mark.parametrize("resize", [None, (80, 60)])
def test_a_distorting_lens_is_undone_to_a_hundredth_of_a_pixel(tmp_path, resize):
    coefficients = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    fx, fy, cx, cy = 96.0, 97.0, 79.3, 59.6
    lenses = [Lens(160, 120, fx, fy, cx + shift + 0.5, cy + 0.5, "radtan", coefficients) for shift in (0.0, 2.0)]
    t_ns = [T0, T0 + STEP]
    for camera, lens in enumerate(lenses):
        # frame 0 shows the slope to the right, frame 1 that downwards: red rises, blue falls
        ray, valid = lens.ray(lens.pinhole.pixel_grid(dtype=torch.float64))
        assert bool(valid.all())
        images = [ramps(ray, axis).round().clamp(0, 255).numpy().astype(np.uint8)[..., ::-1] for axis in (0, 1)]
        yaml = camera_yaml(
            (T_BODY_CAM0, T_BODY_CAM1)[camera],
            size=(160, 120),
            intrinsics=(fx, fy, cx + 2 * camera, cy),
            distortion=coefficients,
        )
        write_camera(tmp_path / "mav0" / f"cam{camera}", yaml, images, t_ns)
    sequence = opened(tmp_path, resize=resize)
    assert sequence.rig is not None
    for axis, frame in enumerate(sequence):
        for camera, image in zip(sequence.rig.cameras, (frame.image, *frame.others), strict=True):
            assert isinstance(camera, Pinhole)
            assert image is not None
            assert image.shape[:2] == (camera.height, camera.width)
            if resize is not None:
                assert (camera.width, camera.height) == resize
            expected = ramps(camera.ray_grid(dtype=torch.float64), axis)
            unclipped = (expected > 10).all(-1) & (expected < 245).all(-1)
            assert float(unclipped.double().mean()) > 0.2
            error = (torch.from_numpy(image.copy()).double() - expected)[unclipped]
            levels_a_pixel = STEEPNESS / camera.intrinsics[axis]
            assert float(error.abs().max()) < 1.2 + levels_a_pixel / 16  # rounded twice, and the place to 1/64 px
            # rising against falling: the half level that results are rounded up by is no shift of the image
            shift_px = (error[:, 0] - error[:, 2]).mean() / 2 / levels_a_pixel
            assert abs(float(shift_px)) < 0.01


STEEPNESS = 401.0


def ramps(ray: torch.Tensor, axis: int) -> torch.Tensor:
    slope = ray[..., axis] / ray[..., 2]
    return torch.stack([128 + STEEPNESS * slope, 128 + 0 * slope, 128 - STEEPNESS * slope], -1)


def test_cameras_of_different_sizes_or_at_one_place_are_refused(tmp_path):
    root = write_euroc(tmp_path, cameras=1)
    t_ns = [T0 + STEP * k for k in range(4)]
    folder = root / "mav0" / "cam1"
    write_camera(folder, camera_yaml(T_BODY_CAM1, size=(30, 24)), [picture(k, width=30) for k in range(4)], t_ns)
    refused(root, "expected the cameras' images to have one size, got 30 x 24 and 32 x 24")
    assert opened(root, stereo=False).rig is None
    (folder / "sensor.yaml").write_text(camera_yaml(T_BODY_CAM0))
    refused(root, "cam1/sensor.yaml: expected T_BS apart from cam0's, got the same place")
    (folder / "sensor.yaml").write_text(camera_yaml(T_BODY_CAM1))
    refused(root, "cam1: expected images of the calibration's size 32 x 24, got 30 x 24")
    (folder / "data.csv").write_text("".join(f"{t + 1},{t}.png\n" for t in t_ns))
    refused(root, "cam1/data.csv: expected images at the times of cam0's, got none")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[30.0, 31.0, 15.2, 11.9]", "[0.0, 31.0, 15.2, 11.9]", "expected a focal length"),
        ("[30.0, 31.0, 15.2, 11.9]", "[30.0, -31.0, 15.2, 11.9]", "expected a focal length fy above 0, got -31"),
        (
            "[30.0, 31.0, 15.2, 11.9]",
            "[30.0, 31.0, 367.2, 11.9]",
            "expected a principal point near the image of 32 x 24",
        ),
        ("[30.0, 31.0, 15.2, 11.9]", "[30.0, 31.0, 15.2]", "sensor.yaml: expected 4 finite numbers in intrinsics"),
        (
            "[30.0, 31.0, 15.2, 11.9]",
            "[30.0, 31.0, .nan, 11.9]",
            "sensor.yaml: expected 4 finite numbers in intrinsics",
        ),
        ("[0.0, 0.0, 0.0, 0.0]", "[0.0]", "sensor.yaml: expected 4 or 5 finite numbers in distortion_coefficients"),
        ("radial-tangential", "polynomial", "sensor.yaml: expected distortion_model to be one of"),
        ("resolution", "size", "sensor.yaml: expected resolution, got none"),
        ("T_BS", "pose", "sensor.yaml: expected T_BS, the camera's pose on the body, got none"),
        ("0.999557249008", "2.5", "T_BS: expected a rigid motion"),
        ("sensor_type: camera", "sensor_type: [camera", "sensor.yaml: expected a calibration in YAML"),
        ("[32, 24]", "[33, 24]", "expected images of the calibration's size 33 x 24, got 32 x 24"),
    ],
)
def test_an_impossible_calibration_is_refused(tmp_path, old, new, message):
    root = write_euroc(tmp_path, cameras=1, imu=False)
    replace(root / "mav0" / "cam0" / "sensor.yaml", old, new)
    refused(root, message)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("2.5000e-3", "0.0", "imu0/sensor.yaml: expected finite numbers above 0 in gyro"),
        ("2.5000e-3", "[1, 2]", "imu0/sensor.yaml: expected finite numbers above 0 in gyro"),
        ("2.5000e-3", "low", "imu0/sensor.yaml: expected finite numbers above 0 in gyro"),
        ("gyroscope_noise", "gyro_noise", "imu0/sensor.yaml: expected gyroscope_noise_density, got none"),
        ("T_BS", "pose", "imu0/sensor.yaml: expected T_BS, got none"),
        ("  data: [", "  data: [3, ", "imu0/sensor.yaml, T_BS: expected 16 finite numbers"),
        ("%YAML:1.0", "\x01", "imu0/sensor.yaml: expected a calibration in YAML, got another text"),
    ],
)
def test_an_impossible_calibration_of_the_imu_is_refused(tmp_path, old, new, message):
    root = write_euroc(tmp_path)
    replace(root / "mav0" / "imu0" / "sensor.yaml", old, new)
    refused(root, message)
    assert opened(root, use_imu=False).imu is None


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("", "cam0/data.csv: expected lines `timestamp .ns.,filename`, got none"),
        ("5,a.png\n5,b.png\n", "cam0/data.csv, line 2: expected a time later than the line before, got 5"),
        ("5,a.png\n4,b.png\n", "cam0/data.csv, line 2: expected a time later than the line before, got 4"),
        ("5\n", "cam0/data.csv, line 1: expected 2 columns, .* got 1"),
        ("1403715523.91,a.png\n", "line 1: expected a time in whole nanoseconds, got .*looks like seconds"),
        ("5,../a.png\n", "line 1: expected the name of a file inside the folder, got '../a.png'"),
        ("5,/a.png\n", "line 1: expected the name of a file inside the folder, got '/a.png'"),
        ("5,\n", "line 1: expected the name of a file inside the folder, got ''"),
        ("5,a.png\n6,b.png\n", "cam0: expected readable images, got none among the first"),
    ],
)
def test_a_bad_list_is_refused(tmp_path, lines, message):
    root = write_euroc(tmp_path, cameras=1)
    (root / "mav0" / "cam0" / "data.csv").write_text(lines)
    refused(root, message)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (f"{T0},0,0,0,1,0,0\n", "data.csv, line 1: expected at least 8 columns, .* got 7"),
        (f"{T0},0,0,0,0,0,0,0\n", "data.csv, line 1: expected a unit quaternion .* got zero"),
        (f"{T0},0,0,inf,1,0,0,0\n", "data.csv, line 1: expected finite numbers, got 'inf'"),
        ("1403715523.9,0,0,0,1,0,0,0\n", "data.csv, line 1: expected a time in whole nanoseconds"),
    ],
)
def test_a_bad_truth_is_refused(tmp_path, line, message):
    write_truth(write_euroc(tmp_path), torch.eye(4).double()[None], [T0])
    (tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv").write_text(line)
    refused(tmp_path, "state_groundtruth_estimate0/" + message)


def test_missing_files_are_named(tmp_path):
    root = write_euroc(tmp_path)
    (root / "mav0" / "cam0" / "sensor.yaml").unlink()
    refused(root, "cam0/sensor.yaml: expected a calibration file, got No such file")
    (root / "mav0" / "cam0" / "data.csv").unlink()
    refused(root, "cam0/data.csv: expected a text file .* got No such file")


def test_a_rendered_sequence_comes_back_with_its_geometry(tmp_path):
    config = SyntheticConfig(camera="pinhole", width=160, height=120, frames=3, fps=20.0, stereo_baseline=0.11)
    world = SyntheticSequence(config)
    assert world.rig is not None
    fx, fy, cx, cy = world.camera.intrinsics
    t_ns = [T0 + int(t) for t in world.truth.t_ns]
    frames = list(world)
    for camera in (0, 1):
        images = [(frame.image, *frame.others)[camera] for frame in frames]
        # the published convention: pixel centres at integers
        yaml = camera_yaml(
            T_BODY_CAM0 @ world.rig.T_body_cam[camera], size=(160, 120), intrinsics=(fx, fy, cx - 0.5, cy - 0.5)
        )
        folder = tmp_path / "mav0" / f"cam{camera}"
        write_camera(folder, yaml, [image for image in images if image is not None], t_ns)
    write_truth(tmp_path, world.truth.T_world_cam @ se3_inverse(T_BODY_CAM0), t_ns)
    sequence = opened(tmp_path)
    assert sequence.rig is not None
    assert sequence.truth is not None
    # by what was read, and by the exact world: frame 0 seen by both cameras of frame 2
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
