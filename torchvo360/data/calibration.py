"""Calibration files: Kalibr's camera chains (camchain.yaml) and EuRoC's sensor.yaml.

    cam0:                                    # Kalibr: one mapping a camera
      camera_model: pinhole
      intrinsics: [fx, fy, cx, cy]           # pixel centres at integers
      distortion_model: radtan               # or equidistant, none
      distortion_coeffs: [k1, k2, p1, p2]
      resolution: [752, 480]
      T_cam_imu: [[...], ...]                # optional
      timeshift_cam_imu: 0.01                # optional: t_imu = t_cam + shift
    cam1:
      T_cn_cnm1: [[...], ...]                # maps points of the camera before into this one

A sensor.yaml holds one camera with `T_BS`, its pose on the body, which is the IMU, and `distortion_coefficients`.

Source: Kalibr's wiki, "Yaml formats"; the EuRoC data set's sensor.yaml.
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from jaxtyping import Float64
from torch import Tensor

from torchvo360.cameras import Lens
from torchvo360.checks import InputError, is_pose
from torchvo360.data.table import read_text
from torchvo360.lie import matrix_from_quaternion, se3, se3_inverse

MODELS = {
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "equi": "equidistant",
    "none": "none",
}
"""Names of distortions in such files."""

LEAST_QUATERNION = 1e-6

SAME_SHAPE_PX = 1.0
"""Two sizes are one in proportion when the heights differ by no more at equal widths."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a calibration file says of its cameras."""

    path: str
    lenses: tuple[Lens, ...]
    T_body_cam: Float64[Tensor, "n 4 4"]
    """Pose of each camera on the body, metres; the body is the first camera, or what the file takes for it."""
    T_cam_imu: Float64[Tensor, "4 4"] | None = None
    """Pose of the IMU in the first camera, metres; None where the file does not say."""
    offset_s: float = 0.0
    """Add it to the IMU's times to get the camera's."""

    def lens(self, number: int, width: int, height: int) -> Lens:
        """Return a camera's lens for images of this size.

        Raises:
            InputError: It was calibrated for images of another shape.
        """
        lens = self.lenses[number]
        if abs(lens.height * width / lens.width - height) > SAME_SHAPE_PX:
            raise InputError(
                f"camera.calibration: expected images of {lens.width} x {lens.height} or in proportion, as in "
                f"{self.path}, got {width} x {height}."
            )
        return lens if (width, height) == (lens.width, lens.height) else lens.resized(width, height)


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file.

    Raises:
        InputError: It is missing or no YAML, or a number in it is missing or impossible.
    """
    settings = _Node.read(Path(path).expanduser())
    names = list(itertools.takewhile(settings.values.__contains__, (f"cam{number}" for number in itertools.count())))
    if not names:
        return _sensor(settings)
    cameras = [settings.child(name) for name in names]
    T_cam_first = torch.eye(4, dtype=torch.float64)
    chain = [T_cam_first]
    for camera in cameras[1:]:
        T_cam_first = camera.pose("T_cn_cnm1") @ T_cam_first
        chain.append(T_cam_first)
    first = cameras[0]
    return Calibration(
        str(path),
        tuple(camera.lens("distortion_coeffs") for camera in cameras),
        se3_inverse(torch.stack(chain)),
        first.pose("T_cam_imu") if "T_cam_imu" in first.values else None,
        -first.number("timeshift_cam_imu") if "timeshift_cam_imu" in first.values else 0.0,
    )


def _sensor(settings: "_Node") -> Calibration:
    lens = settings.lens("distortion_coefficients")
    if "T_BS" not in settings.values:
        return Calibration(str(settings.place), (lens,), torch.eye(4, dtype=torch.float64)[None])
    T_body_cam = settings.pose("T_BS")
    return Calibration(str(settings.place), (lens,), T_body_cam[None], se3_inverse(T_body_cam))


def read_yaml(file: Path) -> Mapping[str, Any]:
    """Return the keys and values of a calibration in YAML.

    Raises:
        InputError: The file is missing or holds something else.
    """
    text = read_text(file, "a calibration file")
    # OpenCV's first line, %YAML:1.0, is no YAML
    lines = [line for line in text.splitlines() if not line.startswith("%YAML")]
    try:
        values = yaml.safe_load("\n".join(lines))
    except (yaml.YAMLError, ValueError, RecursionError):  # no such grammar, an impossible date, too deep
        raise InputError(f"{file}: expected a calibration in YAML, got another text.") from None
    if not isinstance(values, Mapping):
        raise InputError(f"{file}: expected a calibration in YAML with the keys of a sensor, got none.")
    return values


def pose_of_numbers(name: str, values: Any) -> Float64[Tensor, "4 4"]:
    """Return the rigid motion that numbers stand for.

    Args:
        name: What they are, for the message.
        values: 16 numbers by rows, also in lists of rows, or 7: x y z qx qy qz qw.

    Raises:
        InputError: There are more or fewer, or they are no rigid motion.
    """
    numbers = list(_numbers(values))
    if len(numbers) not in (7, 16) or not all(map(math.isfinite, numbers)):
        raise InputError(f"{name}: expected 16 finite numbers by rows, or 7 (x y z qx qy qz qw), got {values!r}.")
    flat = torch.tensor(numbers, dtype=torch.float64)
    if len(numbers) == 7:
        length = float(torch.linalg.vector_norm(flat[3:]))
        if length < LEAST_QUATERNION:
            raise InputError(f"{name}: expected a quaternion other than zero, got {values!r}.")
        return se3(matrix_from_quaternion(flat[3:]), flat[:3])
    T = flat.view(4, 4)
    if not bool(is_pose(T)):
        raise InputError(f"{name}: expected a rigid motion (orthonormal R, last row 0 0 0 1), got another matrix.")
    U, _, Vh = torch.linalg.svd(T[:3, :3])
    return se3(U @ Vh, T[:3, 3])  # the nearest rotation: numbers in files are rounded


def _numbers(values: Any) -> Iterator[float]:
    """Yield the numbers of nested lists in order, NaN for what is none; to YAML 1e-3, without a point, is a word."""
    if isinstance(values, list | tuple):
        for value in values:
            yield from _numbers(value)
        return
    try:
        yield math.nan if isinstance(values, bool) else float(values)
    except (TypeError, ValueError):
        yield math.nan


@dataclass(frozen=True)
class _Node:
    """A mapping of a YAML file and where it stands, for messages."""

    place: str
    values: Mapping[str, Any]

    @classmethod
    def read(cls, file: Path) -> "_Node":
        return cls(str(file), read_yaml(file))

    def child(self, name: str) -> "_Node":
        values = self.values[name]
        if not isinstance(values, Mapping):
            raise InputError(f"{self.place}: expected the keys of a camera in {name}, got none.")
        return _Node(f"{self.place}, {name}", values)

    def numbers(self, key: str, *counts: int) -> list[float]:
        if key not in self.values:
            raise InputError(f"{self.place}: expected {key}, got none.")
        numbers = list(_numbers(self.values[key]))
        if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
            expected = " or ".join(map(str, counts))
            raise InputError(f"{self.place}: expected {expected} finite numbers in {key}, got {self.values[key]!r}.")
        return numbers

    def number(self, key: str) -> float:
        return self.numbers(key, 1)[0]

    def word(self, key: str, known: Mapping[str, str]) -> str:
        value = self.values.get(key)
        if str(value).lower() not in known:
            raise InputError(f"{self.place}: expected {key} to be one of {', '.join(known)}, got {value!r}.")
        return known[str(value).lower()]

    def pose(self, key: str) -> Float64[Tensor, "4 4"]:
        if key not in self.values:
            raise InputError(f"{self.place}: expected {key}, got none.")
        value = self.values[key]
        return pose_of_numbers(f"{self.place}, {key}", value.get("data") if isinstance(value, Mapping) else value)

    def lens(self, coefficients: str) -> Lens:
        self.word("camera_model", {"pinhole": "pinhole"})
        model = self.word("distortion_model", MODELS)
        width, height = self.numbers("resolution", 2)
        fx, fy, cx, cy = self.numbers("intrinsics", 4)
        distortion = [] if model == "none" else self.numbers(coefficients, *((4, 5) if model == "radtan" else (4,)))
        try:
            return Lens.of_opencv(round(width), round(height), (fx, fy, cx, cy), model, tuple(distortion))
        except InputError as error:
            raise InputError(f"{self.place}: {error}") from None
