"""The settings of a run: what contradicts itself is refused before anything is opened."""

import pytest

from torchvo360.checks import InputError
from torchvo360.settings import CameraConfig, ImuConfig, RigConfig, RunConfig

FOCAL = [9, 9.5, 3, 4]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"model": "omni"}, "model: expected one of auto, equirectangular, pinhole, fisheye, got 'omni'"),
        ({"model": "pinhole"}, "intrinsics: expected [fx, fy, cx, cy] of numbers, got None"),
        ({"model": "fisheye", "intrinsics": [1, 2, 3]}, "intrinsics: expected the 4 numbers [fx, fy, cx, cy], got 3"),
        ({"model": "pinhole", "intrinsics": [1, 2, 3, "x"]}, "intrinsics: expected [fx, fy, cx, cy] of numbers, got "),
        ({"model": "pinhole", "intrinsics": 5}, "intrinsics: expected [fx, fy, cx, cy] of numbers, got 5"),
        ({"model": "pinhole", "intrinsics": [0, 9, 3, 4]}, "fx: expected a focal length other than zero, got 0"),
        ({"model": "pinhole", "intrinsics": [9, float("nan"), 3, 4]}, "fy: expected a finite number, got nan"),
        ({"model": "pinhole", "intrinsics": FOCAL, "distortion": [1, 2]}, "distortion: expected 4 or 5 numbers for "),
        ({"model": "fisheye", "intrinsics": FOCAL, "distortion": [1] * 5}, "distortion: expected 4 numbers for equi"),
        ({"model": "pinhole", "intrinsics": FOCAL, "distortion": "k"}, "distortion: expected a list of numbers"),
        ({"model": "pinhole", "intrinsics": FOCAL, "fit": "crop"}, "fit: expected none for a lens, whose images are"),
        ({"model": "pinhole", "intrinsics": FOCAL, "view": "plan"}, "view: expected one of auto, pinhole, panorama"),
        ({"intrinsics": FOCAL}, "intrinsics: expected no value but for camera.model=pinhole or fisheye, got [9"),
        ({"model": "equirectangular", "view": "panorama"}, "view: expected no value but for camera.model=pinhole"),
        ({"calibration": "a.yaml", "model": "pinhole"}, "model: expected no value beside a calibration, got pinhole"),
        ({"calibration": "a.yaml", "intrinsics": FOCAL}, "intrinsics: expected no value beside a calibration, got [9"),
        ({"calibration": ""}, "calibration: expected a file, got an empty name"),
    ],
)
def test_a_camera_that_is_none_is_refused(settings, message):
    with pytest.raises(InputError) as refused:
        CameraConfig(**settings)
    assert str(refused.value).startswith(message)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"layout": "stacked"}, "layout: expected one of none, top_bottom, left_right, got 'stacked'"),
        ({"layout": "top_bottom", "axis": "w"}, "axis: expected one of x, y, z, got 'w'"),
        ({"baseline": 0.2}, "baseline: expected no value without rig.layout, got 0.2"),
        ({"swap": True}, "swap: expected no value without rig.layout, got True"),
        ({"layout": "top_bottom", "baseline": 0.0}, "baseline: expected a finite number above 0, got 0.0"),
        ({"layout": "top_bottom", "baseline": float("inf")}, "baseline: expected a finite number above 0, got inf"),
        (
            {"layout": "top_bottom", "baseline": 1.0, "T_first_second": [0, 1, 0, 0, 0, 0, 1]},
            "baseline: expected no value beside rig.T_first_second, got both",
        ),
        (
            {"layout": "top_bottom", "T_first_second": [1, 2]},
            "T_first_second: expected 16 finite numbers by rows, or 7",
        ),
    ],
)
def test_a_rig_that_is_none_is_refused(settings, message):
    with pytest.raises(InputError) as refused:
        RigConfig(**settings)
    assert str(refused.value).startswith(message)


@pytest.mark.parametrize(
    ("config", "settings", "message"),
    [
        (ImuConfig, {"gyro": -1.0}, "gyro: expected a finite number above 0, got -1.0"),
        (ImuConfig, {"offset_s": float("nan")}, "offset_s: expected a finite number, got nan"),
        (ImuConfig, {"T_cam_imu": [1]}, "T_cam_imu: expected 16 finite numbers by rows, or 7"),
        (RunConfig, {"imu": ""}, "imu: expected a file, auto or null, got an empty name"),
        (RunConfig, {"imu": None, "imu_sensor": ImuConfig(gyro=1.0)}, "imu_sensor: expected no value but for a file"),
        (
            RunConfig,
            {"imu_sensor": ImuConfig(offset_s=0.0)},
            "imu_sensor: expected no value but for a file named by imu",
        ),
        (RunConfig, {"depth_scale": 0.0}, "depth_scale: expected a finite number above 0, got 0.0"),
    ],
)
def test_a_sensor_that_is_none_is_refused(config, settings, message):
    with pytest.raises(InputError) as refused:
        config(**settings)
    assert str(refused.value).startswith(message)


def test_a_lens_counts_pixels_from_the_corner_and_a_fisheye_needs_no_coefficients():
    pinhole = CameraConfig(model="pinhole", intrinsics=FOCAL).lens(8, 6)
    assert (pinhole.model, pinhole.cx, pinhole.cy) == ("none", 3.5, 4.5)
    assert CameraConfig(model="pinhole", intrinsics=FOCAL, distortion=[0.1, 0, 0, 0]).lens(8, 6).model == "radtan"
    fisheye = CameraConfig(model="fisheye", intrinsics=FOCAL).lens(8, 6)
    assert (fisheye.model, fisheye.distortion) == ("equidistant", (0.0,) * 4)
