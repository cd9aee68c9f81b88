"""The settings of one run, each with its default and what it means."""

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360.backends import BACKENDS
from torchvo360.cameras import Lens
from torchvo360.checks import InputError, check_choice, check_finite_number
from torchvo360.data.calibration import pose_of_numbers
from torchvo360.data.packed import LAYOUTS
from torchvo360.data.synthetic import SyntheticConfig
from torchvo360.data.undistort import TARGETS
from torchvo360.inertial import ImuNoise
from torchvo360.vo import OdometryConfig

AUTO = "auto"

SYNTHETIC = "synthetic"
"""The input that is rendered, with the settings `synthetic`."""

SHIPPED = "shipped"
"""The depth network that comes with the package."""

CLIPS = Path(__file__).parent / "data" / "clips"

MAX_SEED = 2**63 - 1

EQUIRECTANGULAR = "equirectangular"

DISTORTIONS = {"pinhole": "radtan", "fisheye": "equidistant"}
"""Models of `camera.model` that are lenses, and the distortion that its numbers belong to."""

AXES = ("x", "y", "z")

VIEWERS = ("none", "rerun", "rerun_viewer")
"""Of `viz`."""


@dataclass(kw_only=True)
class CameraConfig:
    """What took the images of a file, and how they become those of a camera."""

    model: str = AUTO
    """equirectangular, pinhole or fisheye; auto is what `calibration` says, and without one equirectangular."""
    intrinsics: Any = None
    """[fx, fy, cx, cy] of a pinhole or a fisheye in pixels of the images as they are stored, centres at integers as in
    OpenCV."""
    distortion: Any = None
    """OpenCV's coefficients: [k1, k2, p1, p2] or with k3 for a pinhole, [k1, k2, k3, k4] for a fisheye."""
    calibration: str | None = None
    """A file with it all, for images of its resolution or in proportion: Kalibr's camchain or EuRoC's sensor.yaml."""
    view: str = AUTO
    """What a lens's images become: pinhole, panorama, or auto, a panorama for fisheyes beyond 120 degrees."""
    fit: str = "none"
    """What happens to panoramas that are not 2:1: none refuses them, stretch resamples rows, crop cuts rows off."""

    def __post_init__(self) -> None:
        check_choice("model", self.model, (AUTO, EQUIRECTANGULAR, *DISTORTIONS))
        check_choice("view", self.view, TARGETS)
        check_choice("fit", self.fit, ("none", "stretch", "crop"))
        if self.calibration == "":
            raise InputError("calibration: expected a file, got an empty name.")
        if self.calibration is not None:
            for name, usual in (("model", AUTO), ("intrinsics", None), ("distortion", None)):
                if getattr(self, name) != usual:
                    raise InputError(f"{name}: expected no value beside a calibration, got {getattr(self, name)}.")
        if self.is_panorama:
            for name, usual in (("intrinsics", None), ("distortion", None), ("view", AUTO)):
                if getattr(self, name) != usual:
                    expected = "no value but for camera.model=pinhole or fisheye"
                    raise InputError(f"{name}: expected {expected}, got {getattr(self, name)}.")
            return
        if self.calibration is None:
            self.lens(1, 1)
        if self.fit != "none":
            raise InputError(f"fit: expected none for a lens, whose images are undistorted instead, got {self.fit}.")

    @property
    def is_panorama(self) -> bool:
        """Whether the images are equirectangular already."""
        return self.calibration is None and self.model in (AUTO, EQUIRECTANGULAR)

    def lens(self, width: int, height: int) -> Lens:
        """Return the lens that model, intrinsics and distortion describe, for images of this size.

        Raises:
            InputError: They are none.
        """
        intrinsics = _number_list("intrinsics", self.intrinsics, "[fx, fy, cx, cy]")
        if len(intrinsics) != 4:
            raise InputError(f"intrinsics: expected the 4 numbers [fx, fy, cx, cy], got {len(intrinsics)}.")
        fx, fy, cx, cy = intrinsics
        distortion = [] if self.distortion is None else _number_list("distortion", self.distortion, "a list")
        if self.model == "fisheye" and not distortion:
            distortion = [0.0] * 4  # the angle itself is the fisheye's first term
        model = DISTORTIONS[self.model] if distortion else "none"
        return Lens.of_opencv(width, height, (fx, fy, cx, cy), model, tuple(distortion))


@dataclass(kw_only=True)
class RigConfig:
    """Two cameras whose images of one moment share each frame of a file; the poses are the first one's."""

    layout: str = "none"
    """Where their images are in a frame: none (a single camera), top_bottom or left_right."""
    swap: bool = False
    """Whether the second camera's image comes first, above or to the left."""
    baseline: float | None = None
    """Distance of the second camera from the first, metres, along `axis`; both look in the same direction."""
    axis: str = "x"
    """Where the second camera is: x, to the right of the first one, y, below it, or z, in front of it."""
    T_first_second: Any = None
    """Pose of the second camera in the first, in place of both: 16 numbers by rows, or x y z qx qy qz qw."""

    def __post_init__(self) -> None:
        check_choice("layout", self.layout, ("none", *LAYOUTS))
        check_choice("axis", self.axis, AXES)
        if self.layout == "none":
            usual = {"swap": False, "baseline": None, "axis": "x", "T_first_second": None}
            for name, value in usual.items():
                if getattr(self, name) != value:
                    raise InputError(f"{name}: expected no value without rig.layout, got {getattr(self, name)}.")
        if self.baseline is not None:
            check_finite_number("baseline", self.baseline, above=0.0)
            if self.T_first_second is not None:
                raise InputError("baseline: expected no value beside rig.T_first_second, got both.")
        _ = self.pose

    @property
    def pose(self) -> Float64[Tensor, "4 4"] | None:
        """T_first_second as a matrix, by the baseline or by itself; None where neither is given.

        Raises:
            InputError: It is no rigid motion.
        """
        if self.T_first_second is not None:
            return pose_of_numbers("T_first_second", self.T_first_second)
        if self.baseline is None:
            return None
        T_first_second = torch.eye(4, dtype=torch.float64)
        T_first_second[AXES.index(self.axis), 3] = self.baseline
        return T_first_second


@dataclass(kw_only=True)
class ImuConfig:
    """The sensor whose samples `imu` names, beside the first camera."""

    T_cam_imu: Any = None
    """Its pose in the first camera: 16 numbers by rows, or x y z qx qy qz qw; null takes `camera.calibration`'s."""
    offset_s: float | None = None
    """Add it to the samples' times to get the frames'; null takes `camera.calibration`'s, else 0."""
    gyro: float = ImuNoise.gyro
    """White noise of the angular rate, rad / s / sqrt(Hz)."""
    accel: float = ImuNoise.accel
    """White noise of the specific force, m / s^2 / sqrt(Hz)."""
    gyro_walk: float = ImuNoise.gyro_walk
    """Random walk of the gyroscope's bias, rad / s^2 / sqrt(Hz)."""
    accel_walk: float = ImuNoise.accel_walk
    """Random walk of the accelerometer's bias, m / s^3 / sqrt(Hz)."""

    def __post_init__(self) -> None:
        _ = self.noise
        if self.T_cam_imu is not None:
            pose_of_numbers("T_cam_imu", self.T_cam_imu)
        if self.offset_s is not None:
            check_finite_number("offset_s", self.offset_s)

    @property
    def noise(self) -> ImuNoise:
        """The densities.

        Raises:
            InputError: One is not above 0.
        """
        return ImuNoise(gyro=self.gyro, accel=self.accel, gyro_walk=self.gyro_walk, accel_walk=self.accel_walk)


@dataclass(kw_only=True)
class DepthConfig:
    """The network that gives inverse ranges in metres, from which the odometry begins at once; none by default."""

    checkpoint: str | None = None
    """Its file, NAME.safetensors with NAME.json beside it; `shipped` for the package's own."""
    _target_: str | None = None
    """The dotted name of a class of one's own that fulfils `DepthEstimator`: in place of `shipped`, or for the tensors
    of the checkpoint."""
    arguments: Any = None
    """Arguments of that class, such as {width: 128}, where no checkpoint holds them."""

    def __post_init__(self) -> None:
        if self.checkpoint == "":
            raise InputError("checkpoint: expected a file, got an empty name.")
        if self.arguments is None:
            return
        if not isinstance(self.arguments, dict):
            raise InputError(f"arguments: expected a mapping such as {{width: 128}}, got {self.arguments!r}.")
        if self._target_ is None or self.checkpoint not in (None, SHIPPED):
            raise InputError(f"arguments: expected none but for a _target_ without a checkpoint, got {self.arguments}.")


@dataclass(kw_only=True)
class RunConfig:
    """Settings of one run; conf/config.yaml composes them."""

    input: str = "theta_walk"
    """A video, a folder of images or of a data set (TUM RGB-D, KITTI odometry, EuRoC), a glob pattern, `synthetic`, or
    the name of an embedded clip."""
    mask: Any = None
    """Pixels not to use: an image (white = use), `below:LAT`, `above:LAT`, `box:LON0:LAT0:LON1:LAT1`, or a list."""
    resize: str | None = "auto"
    """WIDTHxHEIGHT to resample to; auto brings wider input down to a width of 1024; null keeps the input's size."""
    camera: CameraConfig = field(default_factory=CameraConfig)
    rig: RigConfig = field(default_factory=RigConfig)
    stereo: bool = True
    """Use the second camera of a data set."""
    depth_scale: float = 5000.0
    """Stored integers of a data set's depth images per metre."""
    imu: str | None = AUTO
    """Inertial measurements: a file in EuRoC's format, in the frames' time; auto is a data set's own, null none."""
    imu_sensor: ImuConfig = field(default_factory=ImuConfig)
    start: int = 0
    """First frame to use."""
    stop: int | None = None
    """Frame before which to stop; null for the end."""
    every: int = 1
    """Use one frame out of this many."""
    fps: float | None = None
    """Frame rate: replaces a video's own time stamps; 30 for images where it is null."""
    truth: str | None = None
    """A TUM file with true poses at the frames' times, in seconds."""
    seed: int = 0
    """Of the odometry's random samples."""
    threads: int | None = 1
    """Threads to compute with: small operations gain little from more; null leaves it to PyTorch and OpenCV."""
    backend: str = "auto"
    """What computes on the CPU: numba where it is installed (auto), eager torch alone, numba or else nothing, or
    compiled, which is eager with `linearize` by torch.compile: it needs a C++ compiler and half a minute."""
    device: str = "cpu"
    """cpu or cuda."""
    out: str | None = None
    """Folder of the results; null for runs/<input>/<date_time>."""
    overwrite: bool = False
    """Replace the run that `out` holds."""
    plot: str = "auto"
    """Draw trajectory.png and errors.png: auto draws them where matplotlib is installed."""
    report: bool = True
    """Write report.html, a page that shows the whole run in a browser."""
    report_mb: float = 12.0
    """Size up to which that page is filled with pictures of the frames, megabytes."""
    viz: str = "none"
    """rerun records the run into run.rrd for the Rerun viewer, rerun_viewer opens that as well, none does neither."""
    progress: bool = True
    """Show a progress bar where standard error is a terminal."""
    synthetic: SyntheticConfig = field(default_factory=SyntheticConfig)
    vo: OdometryConfig = field(default_factory=OdometryConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)

    def __post_init__(self) -> None:
        self.plot = str(self.plot).lower()  # true and false are no words to YAML
        check_choice("plot", self.plot, ("auto", "true", "false"))
        check_choice("viz", self.viz, VIEWERS)
        check_finite_number("report_mb", self.report_mb, above=0.0)
        check_choice("backend", self.backend, BACKENDS)
        check_choice("device", self.device, ("cpu", "cuda"))
        if not self.input:
            raise InputError("input: expected a video, a folder of images or a glob pattern, got an empty name.")
        if self.out == "":
            raise InputError("out: expected a folder, got an empty name.")
        if self.truth == "":
            raise InputError("truth: expected a TUM file, got an empty name.")
        if self.imu == "":
            raise InputError("imu: expected a file, auto or null, got an empty name.")
        if self.imu in (AUTO, None) and self.imu_sensor != ImuConfig():
            raise InputError(f"imu_sensor: expected no value but for a file named by imu, got imu={self.imu}.")
        check_finite_number("depth_scale", self.depth_scale, above=0.0)
        items = self.mask if isinstance(self.mask, list) else [self.mask]
        if self.mask is not None and not all(isinstance(item, str) and item for item in items):
            raise InputError(f"mask: expected an image file, a sector or a list of them, got {self.mask!r}.")
        if not 0 <= self.seed <= MAX_SEED:
            raise InputError(f"seed: expected 0 to {MAX_SEED}, got {self.seed}.")
        most = 4 * (os.cpu_count() or 1)
        if self.threads is not None and self.threads < 1:
            raise InputError(f"threads: expected at least 1, got {self.threads}.")
        if self.threads is not None and self.threads > most:
            raise InputError(f"threads: expected at most {most} on this machine, got {self.threads}.")
        _ = self.size

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height that `resize` asks for; None for `auto` and where it asks for none.

        Raises:
            InputError: It is something else.
        """
        if self.resize is None or self.resize == AUTO:
            return None
        if not (match := re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", self.resize)):
            raise InputError(f"resize: expected WIDTHxHEIGHT such as 1024x512, auto or null, got {self.resize!r}.")
        return int(match[1]), int(match[2])


def _number_list(name: str, value: Any, expected: str) -> list[float]:
    numbers = value if isinstance(value, list | tuple) else []
    if not numbers or not all(isinstance(number, int | float) and not isinstance(number, bool) for number in numbers):
        raise InputError(f"{name}: expected {expected} of numbers, got {value!r}.")
    return [float(number) for number in numbers]


def embedded_clip(name: str) -> Path | None:
    """Return the file of an embedded clip, None where there is none of that name."""
    path = CLIPS / f"{name}.mp4"
    return path if name.isidentifier() and path.is_file() else None
