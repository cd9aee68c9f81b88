"""Sequences of the KITTI odometry benchmark: rectified images of a car's two stereo pairs.

    sequences/NN/calib.txt             lines `P0: ` to `P3: ` with the 12 numbers of a 3 x 4 projection, by rows
    sequences/NN/times.txt             one time a frame, seconds
    sequences/NN/image_0/, image_1/    grey images 000000.png, 000001.png ... of the left and the right camera
    sequences/NN/image_2/, image_3/    the same in colour
    poses/NN.txt                       lines of 12 numbers, the upper rows of T_world_cam0; for some sequences only

A projection `P_i = K_i [I | t_i]` maps points of camera 0 to pixels of camera i: `t_i` is the translation of
T_cami_cam0, whose rotation is none.

Source: the benchmark's development kit, readme.txt.
"""

from pathlib import Path

import torch
from jaxtyping import Float64, Int64
from numpy import ndarray
from torch import Tensor

from torchvo360.cameras import Lens
from torchvo360.checks import InputError, is_pose
from torchvo360.data.folder import READABLE_WITHIN, is_image_file
from torchvo360.data.recording import Recording, Stream, first_size, rig_poses
from torchvo360.data.selection import Selection
from torchvo360.data.table import Table
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import se3

PAIRS = ((2, 3), (0, 1))
"""Left and right camera, colour first."""


def open_kitti(
    folder: Path, *, selection: Selection, resize: tuple[int, int] | None = None, stereo: bool = True
) -> Recording:
    """Open a sequence of the KITTI odometry benchmark: in colour where there are such images, else in grey.

    Args:
        folder: Where calib.txt is.
        selection: Which frames are used.
        resize: Width and height to bring the images to.
        stereo: Whether the right camera is used, where its images are there.

    Returns:
        The left camera's frames. The true poses are that camera's too, in the world of camera 0's first frame.

    Raises:
        InputError: The calibration, the times or the images are missing or damaged, the right images differ from the
            left ones in number or size, or there is not one pose for each time.
    """
    left, right = _pair(folder)
    cameras = [left, right] if stereo and _images(folder, right).is_dir() else [left]
    projections = {camera: _read_projection(folder / "calib.txt", camera) for camera in cameras}
    table = Table.read(folder / "times.txt", "time in seconds")
    table.check_width(1)
    t_ns = table.seconds()
    files = {camera: _numbered_images(_images(folder, camera)) for camera in cameras}
    frames = max(files[left]) + 1
    if frames > len(t_ns):
        raise InputError(f"{table.path}: expected a time for each of {frames} images, got {len(t_ns)}.")
    if len(files[cameras[-1]]) != len(files[left]):
        counts = f"{len(files[left])}, got {len(files[right])}"
        raise InputError(f"{_images(folder, right)}: expected as many images as the left camera's {counts}.")
    streams = []
    for camera, (K, _) in projections.items():
        paths = [files[camera].get(number) for number in range(frames)]
        size = first_size([path for path in paths if path is not None][:READABLE_WITHIN])
        if size is None:
            raise InputError(f"{_images(folder, camera)}: expected readable images, got none among the first.")
        lens = Lens.of_opencv(*size, (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])))
        streams.append(Stream(f"{folder / 'calib.txt'}, P{camera}", lens, paths))
    t_left_cam0 = projections[left][1]
    T_left_cam = None
    if len(cameras) == 2:
        t_left_right = t_left_cam0 - projections[right][1]
        if t_left_right[0] <= 0:
            raise InputError(
                f"{folder / 'calib.txt'}: expected camera {right} to the right of camera {left}, "
                f"got a baseline of {float(t_left_right[0]):g} m."
            )
        T_left_cam = rig_poses(_translation(t_left_right))
    return Recording(
        f"kitti_{folder.resolve().name}",
        t_ns[:frames].tolist(),
        streams,
        selection=selection,
        resize=resize,
        T_first_cam=T_left_cam,
        truth=_read_truth(folder, t_ns, _translation(-t_left_cam0)),
        notes=[f"times.txt: of {len(t_ns)} times the first {frames} have images."] if frames < len(t_ns) else [],
    )


def _pair(folder: Path) -> tuple[int, int]:
    for pair in PAIRS:
        if _images(folder, pair[0]).is_dir():
            return pair
    raise InputError(f"{folder}: expected a folder image_0 or image_2 with a left camera's images, got neither.")


def _images(folder: Path, camera: int) -> Path:
    return folder / f"image_{camera}"


def _numbered_images(folder: Path) -> dict[int, Path]:
    files = {int(file.stem): file for file in folder.iterdir() if is_image_file(file) and file.stem.isdecimal()}
    if not files:
        raise InputError(f"{folder}: expected images 000000.png, 000001.png and so on, got none.")
    return files


def _translation(t: Float64[Tensor, "3"]) -> Float64[Tensor, "4 4"]:
    return se3(torch.eye(3, dtype=torch.float64), t)


def _read_projection(file: Path, camera: int) -> tuple[Float64[Tensor, "3 3"], Float64[Tensor, "3"]]:
    """Return K and t of a camera's `P = K [I | t]`."""
    name = f"P{camera}:"
    table = Table.read(file, "P0: and 12 numbers")
    rows = [row for row, words in enumerate(table.words) if words[0] == name]
    if not rows:
        raise InputError(f"{file}: expected a line `{name}` with 12 numbers, got none.")
    line = table.only(rows[0])
    line.check_width(13)
    P = torch.from_numpy(line.values(1, 13)).view(3, 4)
    K = P[:, :3]
    rectified = torch.eye(3, dtype=torch.float64)
    rectified[[0, 1, 0, 1], [0, 1, 2, 2]] = K[[0, 1, 0, 1], [0, 1, 2, 2]]
    if not torch.equal(K, rectified) or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise line.complaint(0, "a projection fx 0 cx * 0 fy cy * 0 0 1 * with fx and fy above 0", "another matrix")
    return K, torch.linalg.solve(K, P[:, 3])


def _read_truth(folder: Path, t_ns: Int64[ndarray, "N"], T_cam0_left: Float64[Tensor, "4 4"]) -> Trajectory | None:
    """Read `poses/NN.txt` beside the folder of sequences, where it is there."""
    place = folder.resolve()
    file = place.parent.parent / "poses" / f"{place.name}.txt"
    if not file.is_file():
        return None
    table = Table.read(file, "12 numbers of T_world_cam0")
    table.check_width(12)
    if len(table) != len(t_ns):
        raise InputError(f"{file}: expected a pose for each of {len(t_ns)} times, got {len(table)}.")
    rows = torch.from_numpy(table.values(0, 12)).view(-1, 3, 4)
    T_world_cam0 = se3(rows[:, :, :3], rows[:, :, 3])
    wrong = (~is_pose(T_world_cam0)).nonzero()
    if len(wrong):
        raise table.complaint(int(wrong[0]), "a rotation and a translation", "another matrix")
    return Trajectory(torch.from_numpy(t_ns), T_world_cam0 @ T_cam0_left)
