"""From the settings of a run to its input: frames, the pixels to use, and inertial measurements."""

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool, Float64
from torch import Tensor

from torchvo360.cameras import Camera, Lens
from torchvo360.checks import InputError, check_finite_number
from torchvo360.data import ImageSequence
from torchvo360.data.calibration import Calibration, pose_of_numbers, read_calibration
from torchvo360.data.dataset import open_dataset, recognise
from torchvo360.data.folder import READABLE_WITHIN, is_image_file
from torchvo360.data.images import Images, View, open_source, plan_fit
from torchvo360.data.imu import read_imu_csv
from torchvo360.data.masks import parse_mask
from torchvo360.data.packed import PackedImages, half_size
from torchvo360.data.recording import first_size
from torchvo360.data.selection import Selection
from torchvo360.data.synthetic import SyntheticSequence
from torchvo360.data.undistort import undistort, undistorted_camera
from torchvo360.inertial import ImuSensor
from torchvo360.lie import se3_inverse
from torchvo360.settings import AUTO, SYNTHETIC, CameraConfig, RigConfig, RunConfig, embedded_clip

AUTO_WIDTH = 1024
"""Width of wider input under `resize=auto`: more pixels cost time and gain little."""

MAX_OFFSET_S = 4e9
"""From one clock's zero to another's: more than the time since 1970, and nanoseconds of it still fit 64 bits."""


@dataclass(frozen=True, eq=False)
class Opened:
    """What a run works on."""

    sequence: ImageSequence
    mask: Bool[Tensor, "H W"] | None
    """The pixels to use: those that show something and that the user's mask leaves; None for all."""
    imu: ImuSensor | None
    notes: list[str]
    """Sentences for the user on what was decided."""


def open_input(config: RunConfig) -> Opened:
    """Open what `input`, `mask` and `imu` name.

    Raises:
        InputError: It is missing, unreadable or not its camera's, or a setting does not go with it.
    """
    calibration = _calibration(config.camera)
    if config.input == SYNTHETIC:
        sequence, notes = _synthetic(config), []
    else:
        sequence, notes = _files(config, calibration)
    return Opened(sequence, _mask(config, sequence), _imu(config, sequence, calibration), notes)


def _calibration(config: CameraConfig) -> Calibration | None:
    if config.calibration is None:
        return None
    try:
        return read_calibration(config.calibration)
    except InputError as error:
        raise InputError(f"camera.calibration: {error}") from None


def _synthetic(config: RunConfig) -> SyntheticSequence:
    usual = RunConfig()
    for name in ("resize", "camera", "rig", "start", "stop", "every", "fps", "stereo", "depth_scale", "truth"):
        value = getattr(config, name)
        if value != getattr(usual, name):
            got = "some" if isinstance(value, CameraConfig | RigConfig) else value
            raise InputError(f"{name}: expected no value for a synthetic input (see synthetic.*), got {got}.")
    if config.imu not in (AUTO, None):
        raise InputError(f"imu: expected auto or null for a synthetic input, got {config.imu}.")
    try:
        return SyntheticSequence(config.synthetic)
    except InputError as error:
        raise InputError(f"synthetic.{error}") from None


def _files(config: RunConfig, calibration: Calibration | None) -> tuple[ImageSequence, list[str]]:
    path = str(embedded_clip(config.input) or config.input)
    kind = recognise(Path(path).expanduser()) if path == config.input else None
    if kind is not None:
        return _data_set(config, kind, calibration)
    usual = RunConfig()
    for name in ("stereo", "depth_scale"):
        if getattr(config, name) != getattr(usual, name):
            raise InputError(
                f"{name}: expected no value but for the folder of a data set, got {getattr(config, name)}."
            )
    selection = Selection(config.start, config.stop, config.every)
    source, size = open_source(path, selection, config.fps)
    if config.rig.layout == "none":
        view, notes = _view(config, calibration, 0, size, config.size)
        return Images(source, view, selection), notes
    part = half_size(config.rig.layout, *size)
    T_first_second = _second_camera(config.rig, calibration)
    try:
        first, notes = _view(config, calibration, 0, part, config.size)
        second, _ = _view(config, calibration, 1, part, (first.camera.width, first.camera.height))
    except InputError as error:
        width, height = size
        raise InputError(f"rig.layout: {config.rig.layout} with frames of {width} x {height}: {error}") from None
    packed = PackedImages(
        source, selection, (first, second), T_first_second, layout=config.rig.layout, swap=config.rig.swap
    )
    return packed, notes


def _data_set(config: RunConfig, kind: str, calibration: Calibration | None) -> tuple[ImageSequence, list[str]]:
    usual, camera = RunConfig(), None
    for name, value, default in (
        ("fps", config.fps, usual.fps),
        ("rig.layout", config.rig.layout, usual.rig.layout),
        ("camera.fit", config.camera.fit, usual.camera.fit),
        ("camera.view", config.camera.view, usual.camera.view),
    ):
        if value != default:
            raise InputError(f"{name}: expected no value for the data set in {config.input}, got {value}.")
    if not config.camera.is_panorama:
        if kind != "tum_rgbd":
            raise InputError(f"camera: expected no value for {config.input}, which has its own calibration, got some.")
        images = filter(is_image_file, sorted(Path(config.input).expanduser().glob("rgb/*")))
        size = first_size(list(images)[:READABLE_WITHIN])
        if size is None:
            raise InputError(f"input: expected readable images, got none among the first of {config.input}.")
        camera = _lens(config.camera, calibration, 0, size)

    def opened(size: tuple[int, int] | None) -> ImageSequence:
        sequence = open_dataset(
            config.input,
            resize=size,
            start=config.start,
            stop=config.stop,
            every=config.every,
            kind=kind,
            stereo=config.stereo,
            use_imu=config.imu == AUTO,
            depth_scale=config.depth_scale,
            camera=camera,
        )
        if sequence is None:
            raise InputError(f"input: expected the folder of a data set, got {config.input}.")
        return sequence

    sequence = opened(config.size)
    size, notes = _size(config, sequence.camera)
    return (sequence if size == config.size else opened(size)), notes


def _view(
    config: RunConfig,
    calibration: Calibration | None,
    number: int,
    size: tuple[int, int],
    wanted: tuple[int, int] | None,
) -> tuple[View, list[str]]:
    """Return how images of this size become those of a camera, of the wanted size where there is one."""
    if config.camera.is_panorama:

        def made(resize: tuple[int, int] | None) -> View:
            return plan_fit(*size, config.camera.fit, resize)

        native = made(None).camera
    else:
        lens, target = _lens(config.camera, calibration, number, size), config.camera.view

        def made(resize: tuple[int, int] | None) -> View:
            return undistort(lens, target=target, size=resize)

        native = undistorted_camera(lens, target=target)
    if wanted is not None:
        return made(wanted), []
    resize, notes = _size(config, native)
    return made(resize), notes


def _size(config: RunConfig, camera: Camera) -> tuple[tuple[int, int] | None, list[str]]:
    """Return the size that `resize` makes of a camera's, None for its own, and what to tell the user."""
    if config.resize != AUTO or camera.width <= AUTO_WIDTH:
        return config.size, []
    height = max(2, 2 * round(camera.height * AUTO_WIDTH / camera.width / 2))
    change = f"{camera.width} x {camera.height} were brought down to {AUTO_WIDTH} x {height}"
    note = f"frames of {change}; resize=WxH chooses a size, resize=null keeps theirs."
    return (AUTO_WIDTH, height), [note]


def _lens(config: CameraConfig, calibration: Calibration | None, number: int, size: tuple[int, int]) -> Lens:
    if calibration is None:
        return config.lens(*size)
    return calibration.lens(min(number, len(calibration.lenses) - 1), *size)


def _second_camera(config: RigConfig, calibration: Calibration | None) -> Float64[Tensor, "4 4"]:
    """Return T_first_second, by the settings or by the calibration."""
    given = config.pose
    if calibration is None or len(calibration.lenses) < 2:
        if given is None:
            raise InputError(
                "rig: expected rig.baseline, rig.T_first_second or a calibration of two cameras, got none."
            )
        return given
    if given is not None:
        raise InputError("rig: expected no pose beside a calibration of two cameras, got both.")
    return se3_inverse(calibration.T_body_cam[0]) @ calibration.T_body_cam[1]


def _mask(config: RunConfig, sequence: ImageSequence) -> Bool[Tensor, "H W"] | None:
    if config.mask is None:
        return sequence.mask
    mask = parse_mask(config.mask, sequence.camera)
    if sequence.mask is None:
        return mask
    if not bool((mask & sequence.mask).any()):
        raise InputError("mask: expected some of what the lens sees to be left, got none of it.")
    return mask & sequence.mask


def _imu(config: RunConfig, sequence: ImageSequence, calibration: Calibration | None) -> ImuSensor | None:
    if config.imu is None:
        return None
    if config.imu == AUTO:
        return sequence.imu
    settings = config.imu_sensor
    if settings.T_cam_imu is not None:
        T_cam_imu = pose_of_numbers("imu_sensor.T_cam_imu", settings.T_cam_imu)
    elif calibration is not None and calibration.T_cam_imu is not None:
        T_cam_imu = calibration.T_cam_imu
    else:
        raise InputError("imu_sensor.T_cam_imu: expected the sensor's pose, here or in camera.calibration, got none.")
    offset_s = settings.offset_s
    if offset_s is None:
        offset_s = 0.0 if calibration is None else calibration.offset_s
    check_finite_number("imu_sensor.offset_s", offset_s, above=-MAX_OFFSET_S, at_most=MAX_OFFSET_S)
    try:
        samples = read_imu_csv(config.imu)
    except InputError as error:
        raise InputError(f"imu: {error}") from None
    return ImuSensor(samples, settings.noise, T_cam_imu, offset_s)
