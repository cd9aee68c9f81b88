"""Opening an input: which camera, rig, mask and IMU the settings make of it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchvo360 import opening
from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.data.folder import read_image
from torchvo360.lie import se3_exp, se3_inverse
from torchvo360.opening import open_input
from torchvo360.settings import CameraConfig, ImuConfig, RigConfig, RunConfig

CHAIN = """
cam0: {camera_model: pinhole, intrinsics: [60, 60, 31.5, 23.5], distortion_model: radtan,
       distortion_coeffs: [-0.1, 0.01, 0, 0], resolution: [64, 48], T_cam_imu: %s, timeshift_cam_imu: 0.5}
cam1: {camera_model: pinhole, intrinsics: [70, 70, 31.5, 23.5], distortion_model: none,
       resolution: [64, 48], T_cn_cnm1: %s}
"""
T_CAM_IMU, T_1_0 = se3_exp(torch.tensor([[0.1, 0.2, 0.3, 1, 2, 0.5], [-0.11, 0.0, 0.0, 0.01, 0.02, 0.0]]).double())
FISHEYE = CameraConfig(model="fisheye", intrinsics=[20.0, 20.0, 31.5, 31.5])


def images(folder: Path, width: int, height: int) -> str:
    """Write three images of noise and return their folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for number in range(3):
        cv2.imwrite(str(folder / f"{number}.png"), rng.integers(0, 256, (height, width, 3), dtype=np.uint8))
    return str(folder)


@pytest.fixture
def chain(tmp_path) -> str:
    path = tmp_path / "camchain.yaml"
    path.write_text(CHAIN % (T_CAM_IMU.tolist(), T_1_0.tolist()))
    return str(path)


@pytest.fixture
def samples(tmp_path) -> str:
    path = tmp_path / "imu.csv"
    path.write_text("".join(f"{5_000_000 * k},0,0,0,9.8,0,0\n" for k in range(30)))
    return str(path)


def test_a_panorama_needs_no_settings(tmp_path):
    opened = open_input(RunConfig(input=images(tmp_path / "x", 64, 32)))
    assert opened.sequence.camera == Equirectangular(64, 32)
    assert (opened.sequence.rig, opened.mask, opened.imu, opened.notes) == (None, None, None, [])


def test_a_pinholes_centre_moves_by_half_a_pixel_at_the_door(tmp_path):
    camera = CameraConfig(model="pinhole", intrinsics=[60, 61.0, 31, 23])
    opened = open_input(RunConfig(input=images(tmp_path / "x", 64, 48), camera=camera))
    assert opened.sequence.camera == Pinhole(64, 48, 60, 61, 31.5, 23.5)
    assert opened.mask is None
    stored, _ = read_image(tmp_path / "x" / "0.png")
    assert stored is not None
    np.testing.assert_array_equal(next(iter(opened.sequence)).image, stored)


@pytest.mark.parametrize(
    ("config", "stored", "native", "size"),
    [
        (RunConfig(camera=CameraConfig(model="pinhole", intrinsics=[60, 60, 31, 23])), (64, 48), "64 x 48", (32, 24)),
        (RunConfig(camera=FISHEYE), (64, 64), "124 x 62", (32, 16)),
        (RunConfig(rig=RigConfig(layout="top_bottom", baseline=0.1)), (64, 64), "64 x 32", (32, 16)),
    ],
)
def test_wide_input_of_any_camera_is_brought_down(tmp_path, monkeypatch, config, stored, native, size):
    monkeypatch.setattr(opening, "AUTO_WIDTH", 32)
    opened = open_input(replace(config, input=images(tmp_path, *stored)))
    camera = opened.sequence.camera
    assert (camera.width, camera.height) == size
    assert [frame.image.shape for frame in opened.sequence if frame.image is not None] == [(*size[::-1], 3)] * 3
    (note,) = opened.notes
    assert note.startswith(f"frames of {native} were brought down to {size[0]} x {size[1]}; ")
    kept = open_input(replace(config, input=str(tmp_path), resize=None)).sequence.camera
    assert f"{kept.width} x {kept.height}" == native


def test_a_fisheye_that_sees_beyond_120_degrees_becomes_a_masked_panorama(tmp_path):
    opened = open_input(RunConfig(input=images(tmp_path / "x", 64, 64), camera=FISHEYE))
    assert isinstance(opened.sequence.camera, Equirectangular)
    assert opened.mask is not None
    flat = CameraConfig(model="fisheye", intrinsics=FISHEYE.intrinsics, view="pinhole")
    opened = open_input(RunConfig(input=images(tmp_path / "x", 64, 64), camera=flat))
    assert isinstance(opened.sequence.camera, Pinhole)


def test_the_users_mask_and_the_lenss_hold_both(tmp_path):
    folder = images(tmp_path / "x", 64, 64)
    seen = open_input(RunConfig(input=folder, camera=FISHEYE)).mask
    both = open_input(RunConfig(input=folder, camera=FISHEYE, mask="below:0")).mask
    assert seen is not None
    assert both is not None
    half = seen.clone()
    half[len(seen) // 2 :] = False
    torch.testing.assert_close(both, half)
    behind = ["box:-150:-90:150:90", "above:80", "below:-80"]
    with pytest.raises(InputError, match=r"^mask: expected some of what the lens sees to be left, got none of it\.$"):
        open_input(RunConfig(input=folder, camera=FISHEYE, mask=behind))


@pytest.mark.parametrize("swap", [False, True])
def test_a_chain_of_two_cameras_makes_the_rig_of_a_packed_input(tmp_path, chain, swap):
    config = RunConfig(
        input=images(tmp_path / "x", 128, 48),
        camera=CameraConfig(calibration=chain),
        rig=RigConfig(layout="left_right", swap=swap),
    )
    sequence = open_input(config).sequence
    assert sequence.rig is not None
    torch.testing.assert_close(sequence.rig.T_other_first(1), T_1_0)
    first, second = sequence.rig.cameras
    assert (first, first.intrinsics[0]) == (sequence.camera, 60)
    assert (first.width, first.height) == (second.width, second.height)
    stored, _ = read_image(tmp_path / "x" / "0.png")
    assert stored is not None
    parts = (stored[:, 64:], stored[:, :64]) if swap else (stored[:, :64], stored[:, 64:])
    frame = next(iter(sequence))
    assert frame.image is not None
    assert frame.others[0] is not None
    for image, part in zip((frame.image, frame.others[0]), parts, strict=True):
        middle = part[16:32, 24:40].astype(float).mean((0, 1))
        assert np.abs(image.astype(float).mean((0, 1)) - middle).max() < 20


def test_a_baseline_lies_along_its_axis(tmp_path):
    folder = images(tmp_path / "x", 64, 64)
    for axis, place in (("x", [0.3, 0, 0]), ("y", [0, 0.3, 0]), ("z", [0, 0, 0.3])):
        rig = RigConfig(layout="top_bottom", baseline=0.3, axis=axis)
        found = open_input(RunConfig(input=folder, rig=rig)).sequence.rig
        assert found is not None
        assert found.T_body_cam[1, :3, 3].tolist() == place
    rig = RigConfig(layout="top_bottom", T_first_second=se3_inverse(T_1_0).tolist())
    found = open_input(RunConfig(input=folder, rig=rig)).sequence.rig
    assert found is not None
    torch.testing.assert_close(found.T_other_first(1), T_1_0)


def test_two_poses_for_one_camera_are_refused(tmp_path, chain):
    config = RunConfig(
        input=images(tmp_path / "x", 128, 48),
        camera=CameraConfig(calibration=chain),
        rig=RigConfig(layout="left_right", baseline=0.1),
    )
    with pytest.raises(InputError, match=r"^rig: expected no pose beside a calibration of two cameras, got both\.$"):
        open_input(config)


def test_an_imus_pose_and_offset_come_from_the_settings_or_the_calibration(tmp_path, chain, samples):
    config = RunConfig(input=images(tmp_path / "x", 64, 48), camera=CameraConfig(calibration=chain), imu=samples)
    found = open_input(config).imu
    assert found is not None
    torch.testing.assert_close(found.T_cam_imu, T_CAM_IMU)
    assert (found.offset_s, len(found.samples)) == (-0.5, 30)
    config.imu_sensor = ImuConfig(T_cam_imu=[1, 2, 3, 0, 0, 0, 1], offset_s=0.25, gyro=1e-3)
    found = open_input(config).imu
    assert found is not None
    assert found.T_cam_imu[:3, 3].tolist() == [1, 2, 3]
    assert (found.offset_s, found.noise.gyro) == (0.25, 1e-3)
    config.imu = None
    assert open_input(config).imu is None


def test_a_folder_of_rgbd_data_is_recognised_and_its_camera_may_be_given(tmp_path):
    images(tmp_path / "rgb", 64, 48)
    (tmp_path / "rgb.txt").write_text("".join(f"{k / 30:.6f} rgb/{k}.png\n" for k in range(3)))
    camera = CameraConfig(model="pinhole", intrinsics=[60, 60, 31, 23])
    opened = open_input(RunConfig(input=str(tmp_path), camera=camera))
    assert opened.sequence.camera == Pinhole(64, 48, 60, 60, 31.5, 23.5)
    assert [frame.t_ns for frame in opened.sequence] == [0, 33_333_000, 66_667_000]
    small = open_input(RunConfig(input=str(tmp_path), camera=camera, resize="32x24"))
    assert small.sequence.camera == Pinhole(32, 24, 30, 30, 15.75, 11.75)
