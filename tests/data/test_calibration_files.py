"""Calibration files: what Kalibr and EuRoC write is read, and what is impossible is refused in a sentence."""

import math

import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.data.calibration import pose_of_numbers, read_calibration
from torchvo360.lie import se3_exp, se3_inverse

CAM0 = """cam0:
  camera_model: pinhole
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  distortion_model: radtan
  distortion_coeffs: [-0.27695497, 6.712e-2, 0.00087538, 0.00011556]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""
CAM1 = """cam1:
  camera_model: pinhole
  intrinsics: [190.97, 190.97, 254.93, 256.89]
  distortion_model: equidistant
  distortion_coeffs: [0.0034, 0.0007, -0.0020, 2e-4]
  resolution: [512, 512]
"""
SENSOR = """%YAML:1.0
#Default settings
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


def rows(T: torch.Tensor) -> str:
    return str(T.tolist())


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a calibration file and gives its path."""

    def written(text: str):
        path = tmp_path / "calibration.yaml"
        path.write_text(text)
        return path

    return written


def test_a_single_camera_of_kalibr_is_read_with_centres_half_a_pixel_on(write):
    found = read_calibration(write(CAM0))
    (lens,) = found.lenses
    assert (lens.width, lens.height, lens.model) == (752, 480, "radtan")
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (461.629, 460.152, 363.18, 246.549)
    assert lens.distortion == (-0.27695497, 0.06712, 0.00087538, 0.00011556)
    assert found.T_cam_imu is None
    torch.testing.assert_close(found.T_body_cam, torch.eye(4, dtype=torch.float64)[None])


def test_a_chain_of_two_cameras_gives_their_poses_and_the_imus(write):
    T_1_0, T_cam_imu = se3_exp(
        torch.tensor([[-0.11, 0.002, 0.003, 0.01, -0.02, 0.03], [0.1, 0.2, 0, 1, 2, 0.5]]).double()
    )
    extra = f"  T_cam_imu: {rows(T_cam_imu)}\n  timeshift_cam_imu: 0.0125\n"
    found = read_calibration(write(CAM0 + extra + CAM1 + f"  T_cn_cnm1: {rows(T_1_0)}\n"))
    assert [lens.model for lens in found.lenses] == ["radtan", "equidistant"]
    assert found.lenses[1].distortion == (0.0034, 0.0007, -0.0020, 0.0002), "2e-4 is a word to YAML, and a number to us"
    torch.testing.assert_close(found.T_body_cam[1], se3_inverse(T_1_0))
    assert found.T_cam_imu is not None
    torch.testing.assert_close(found.T_cam_imu, T_cam_imu)
    assert found.offset_s == -0.0125, "t_cam = t_imu - shift"


def test_a_third_camera_hangs_on_the_second(write):
    T_1_0, T_2_1 = se3_exp(torch.tensor([[-0.1, 0, 0, 0, 0.1, 0], [0, -0.2, 0, 0.3, 0, 0]]).double())
    third = CAM1.replace("cam1", "cam2") + f"  T_cn_cnm1: {rows(T_2_1)}\n"
    found = read_calibration(write(CAM0 + CAM1 + f"  T_cn_cnm1: {rows(T_1_0)}\n" + third))
    torch.testing.assert_close(se3_inverse(found.T_body_cam[2]), T_2_1 @ T_1_0)


def test_a_sensor_file_of_euroc_gives_the_pose_on_its_imu(write):
    found = read_calibration(write(SENSOR))
    assert (found.lenses[0].cx, found.lenses[0].model) == (367.715, "radtan")
    assert found.T_cam_imu is not None
    torch.testing.assert_close(found.T_body_cam[0] @ found.T_cam_imu, torch.eye(4, dtype=torch.float64))
    assert found.T_body_cam[0, 0, 3] == -0.0216401454975


def test_a_lens_is_scaled_to_proportional_images_alone(write):
    found = read_calibration(write(CAM0))
    assert found.lens(0, 752, 480) is found.lenses[0]
    half = found.lens(0, 376, 240)
    assert (half.fx, half.cx) == pytest.approx((461.629 / 2, 363.18 / 2))
    with pytest.raises(InputError, match=r"^camera\.calibration: expected images of 752 x 480 .* got 640 x 480\.$"):
        found.lens(0, 640, 480)


@pytest.mark.parametrize("shape", [(7,), (16,), (4, 4)])
def test_poses_are_16_numbers_or_7(shape):
    T = se3_exp(torch.tensor([0.1, -0.2, 0.3, 0.0, 0.0, math.pi / 2]).double())
    root = math.sqrt(0.5)
    seven = [*T[:3, 3].tolist(), 0.0, 0.0, 3 * root, 3 * root]
    torch.testing.assert_close(pose_of_numbers("T", seven if shape == (7,) else T.reshape(shape).tolist()), T)


def test_a_rounded_rotation_becomes_a_rotation():
    T = se3_exp(torch.tensor([0.1, -0.2, 0.3, 0.4, 0.5, -0.6]).double())
    R = pose_of_numbers("T", (T * 1e4).round().div(1e4).tolist())[:3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(R, T[:3, :3], atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([1.0] * 6, "expected 16 finite numbers by rows, or 7"),
        ([0, 0, 0, 0, 0, 0, 0], "expected a quaternion other than zero"),
        ([math.nan] * 7, "expected 16 finite numbers"),
        ("somewhere", "expected 16 finite numbers"),
        ({"x": 1}, "expected 16 finite numbers"),
        ([[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]], "expected a rigid motion"),
        ([[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "expected a rigid motion"),
    ],
)
def test_what_is_no_pose_is_refused(values, message):
    with pytest.raises(InputError, match=f"^T: {message}"):
        pose_of_numbers("T", values)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("intrinsics", "intrinsic", "cam0: expected intrinsics, got none"),
        ("[461.629,", "[0.0,", "cam0: fx: expected a focal length other than zero, got 0"),
        ("[461.629,", "[.nan,", "cam0: expected 4 finite numbers in intrinsics, got "),
        ("[461.629,", "[", "cam0: expected 4 finite numbers in intrinsics, got "),
        ("[752, 480]", "[0, 480]", "cam0: width: expected a positive integer, got 0"),
        ("[752, 480]", "large", "cam0: expected 2 finite numbers in resolution, got 'large'"),
        ("model: pinhole", "model: omni", "cam0: expected camera_model to be one of pinhole, got 'omni'"),
        ("radtan", "fov", "cam0: expected distortion_model to be one of radtan, .* got 'fov'"),
        ("radtan", "equidistant\n  T_cam_imu: [1, 2]", "cam0, T_cam_imu: expected 16 finite numbers"),
        ("[-0.27695497, 6.712e-2", "[1", "cam0: expected 4 or 5 finite numbers in distortion_coeffs, got "),
        (CAM0, "cam0: 3\n", "expected the keys of a camera in cam0, got none"),
        (CAM0, CAM0 + CAM1, "cam1: expected T_cn_cnm1, got none"),
        (CAM0, "just words", "expected a calibration in YAML with the keys of a sensor, got none"),
        (CAM0, "a: [1, 2", "expected a calibration in YAML, got another text"),
        (CAM0, "a: 2026-99-99", "expected a calibration in YAML, got another text"),
        (CAM0, "[" * 5000, "expected a calibration in YAML, got another text"),
        (CAM0, "a: !!python/object/apply:os.getcwd []", "expected a calibration in YAML, got another text"),
        (CAM0, "", "expected a calibration in YAML with the keys of a sensor, got none"),
        (CAM0, "{}", "expected camera_model to be one of pinhole, got None"),
    ],
)
def test_a_bad_calibration_is_refused_in_one_sentence(write, old, new, message):
    with pytest.raises(InputError, match=rf"calibration\.yaml.*({message})") as refused:
        read_calibration(write(CAM0.replace(old, new)))
    assert "\n" not in str(refused.value)


def test_a_missing_or_binary_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"nope\.yaml: expected a calibration file, got No such file or directory\.$"):
        read_calibration(tmp_path / "nope.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(InputError, match=r"binary\.yaml: expected a calibration file, got a binary file\.$"):
        read_calibration(tmp_path / "binary.yaml")
