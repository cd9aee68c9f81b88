"""Recognise the folder of a published data set by its files, and open it."""

from pathlib import Path

from torchvo360.cameras import Lens, Pinhole
from torchvo360.checks import InputError, check_choice
from torchvo360.data.euroc import open_euroc
from torchvo360.data.frame import ImageSequence
from torchvo360.data.kitti import open_kitti
from torchvo360.data.selection import Selection
from torchvo360.data.tum_rgbd import open_tum_rgbd

AUTO = "auto"

KINDS = (AUTO, "tum_rgbd", "kitti", "euroc")


def open_dataset(
    path: str | Path,
    *,
    resize: tuple[int, int] | None = None,
    start: int = 0,
    stop: int | None = None,
    every: int = 1,
    kind: str = AUTO,
    stereo: bool = True,
    use_imu: bool = True,
    depth_scale: float = 5000.0,
    camera: Pinhole | Lens | None = None,
) -> ImageSequence | None:
    """Open a folder of the TUM RGB-D, KITTI odometry or EuRoC data, or one in their layouts.

    Args:
        path: The folder: with rgb.txt; with calib.txt and image_0 or image_2; mav0, or the folder around it.
        resize: Width and height to bring the images to.
        start: First frame of the source to use.
        stop: Frame before which to stop; None for the end.
        every: Use one frame out of this many.
        kind: What it is: tum_rgbd, kitti, euroc, or auto to find out.
        stereo: Whether a second camera is used, where there is one.
        use_imu: Whether inertial measurements are used, where there are any.
        depth_scale: Stored integers of the depth images per metre, TUM RGB-D only.
        camera: The camera of a TUM RGB-D folder, in place of the published one that its name tells.

    Returns:
        The sequence; None for `auto` where the path is none of these.

    Raises:
        InputError: What the folder holds cannot be used, or an argument is not valid.
    """
    check_choice("kind", kind, KINDS)
    selection = Selection(start, stop, every)
    folder = Path(path).expanduser()
    if kind == AUTO:
        found = recognise(folder)
        if found is None:
            return None
        kind = found
    elif not folder.is_dir():
        raise InputError(f"input: expected a folder of the kind {kind}, got {path}, which is none.")
    if kind == "tum_rgbd":
        return open_tum_rgbd(folder, selection=selection, resize=resize, depth_scale=depth_scale, camera=camera)
    if camera is not None:
        raise InputError(f"camera: expected none for {path}, which has its own calibration, got one.")
    if kind == "kitti":
        return open_kitti(folder, selection=selection, resize=resize, stereo=stereo)
    return open_euroc(folder, selection=selection, resize=resize, stereo=stereo, use_imu=use_imu)


def recognise(folder: Path) -> str | None:
    """Return which kind of data a folder holds, by the files that no other has; None for none of the known."""
    if (folder / "rgb.txt").is_file():
        return "tum_rgbd"
    if any((folder / f"image_{camera}").is_dir() for camera in (0, 2)) and any(
        (folder / name).is_file() for name in ("calib.txt", "times.txt")
    ):
        return "kitti"
    if (folder / "mav0").is_dir() or any((folder / "cam0" / name).is_file() for name in ("data.csv", "sensor.yaml")):
        return "euroc"
    return None
