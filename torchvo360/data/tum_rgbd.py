"""Folders of the TUM RGB-D benchmark: colour and depth images with times, registered to each other pixel by pixel.

    rgb.txt, depth.txt     lines `timestamp filename`, seconds
    rgb/, depth/           the images; depth in 16 bits, 5000 a metre, 0 where it is not known
    groundtruth.txt        lines `timestamp tx ty tz qx qy qz qw`, poses T_world_cam; need not be there

Other files, such as accelerometer.txt, are ignored.

Source: the benchmark's pages "File Formats" and "Intrinsic Camera Calibration of the Kinect"; the further digits of its
rounded numbers are those of ORB-SLAM2's settings (TUM1.yaml, TUM2.yaml, TUM3.yaml).
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from torchvo360.cameras import Lens, Pinhole
from torchvo360.checks import InputError
from torchvo360.data.depth_images import DepthImages
from torchvo360.data.recording import Recording, Stream
from torchvo360.data.selection import Selection
from torchvo360.data.table import Table
from torchvo360.data.tum import read_tum

INTRINSICS = {
    "1": (517.306408, 516.469215, 318.643040, 255.313989),
    "2": (520.908620, 521.007327, 325.141442, 249.701764),
    "3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy of the colour cameras of freiburg1 to freiburg3, pixels, with pixel centres at integers."""

DISTORTION = {
    "1": (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    "2": (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    "3": (),
}
"""k1, k2, p1, p2, k3; the images of freiburg3 are undistorted already."""

WIDTH, HEIGHT = 640, 480

TOLERANCE_NS = 20_000_000
"""Longest time between a colour image and its depth; the sensor gives both every 33 ms. Source: the benchmark's
associate.py."""


def open_tum_rgbd(
    folder: Path,
    *,
    selection: Selection,
    resize: tuple[int, int] | None = None,
    depth_scale: float = 5000.0,
    camera: Pinhole | Lens | None = None,
) -> Recording:
    """Open a folder of the TUM RGB-D benchmark, or one in its layout.

    Every colour image is a frame; its depth is the nearest in time within 20 ms, and each is used once.

    Args:
        folder: Where rgb.txt is.
        selection: Which colour images are used.
        resize: Width and height to bring the images to.
        depth_scale: Stored integers of the depth images per metre.
        camera: The camera, its principal point from the image's corner; None for the published one, which `freiburg1`,
            `freiburg2` or `freiburg3` in the folder's name tells.

    Raises:
        InputError: The folder's name tells no camera, a list is missing or damaged or leads out of the folder, no image
            is readable or has the camera's size, or the depth images hold no depth in a plausible range.
    """
    lens = _lens(folder, camera)
    t_ns, images = _read_list(folder, "rgb.txt")
    depth, notes = None, []
    if (folder / "depth.txt").is_file():
        depth_t_ns, files = _read_list(folder, "depth.txt")
        nearest = associate(t_ns, depth_t_ns, TOLERANCE_NS)
        paired = int((nearest >= 0).sum())
        if not paired:
            raise InputError(f"{folder / 'depth.txt'}: expected times within 20 ms of those in rgb.txt, got none.")
        if paired < len(t_ns):
            notes.append(f"depth: {len(t_ns) - paired} of {len(t_ns)} colour images have none within 20 ms.")
        depth = DepthImages(f"{folder / 'depth.txt'}", [files[k] if k >= 0 else None for k in nearest], depth_scale)
    else:
        notes.append("depth: there is no depth.txt, so that only the colour images are used.")
    truth = folder / "groundtruth.txt"
    return Recording(
        folder.resolve().name,
        t_ns.tolist(),
        [Stream(f"{folder / 'rgb.txt'}", lens, images)],
        selection=selection,
        resize=resize,
        depth=depth,
        truth=read_tum(truth) if truth.is_file() else None,
        notes=notes,
    )


def associate(
    t_ns: Int64[np.ndarray, "N"], other_t_ns: Int64[np.ndarray, "M"], tolerance_ns: int
) -> Int64[np.ndarray, "N"]:
    """Return for each time the index of the other one that belongs to it, -1 for none.

    Pairs within the tolerance are made nearest first, each time in one at most. Both arrays increase.

    Source: the benchmark's associate.py.
    """
    first = np.searchsorted(other_t_ns, t_ns - tolerance_ns, side="left")
    last = np.searchsorted(other_t_ns, t_ns + tolerance_ns, side="right")
    candidates = [(abs(int(other_t_ns[k] - t_ns[n])), n, k) for n in range(len(t_ns)) for k in range(first[n], last[n])]
    partner = np.full(len(t_ns), -1, dtype=np.int64)
    free = np.ones(len(other_t_ns), dtype=bool)
    for _, n, k in sorted(candidates):
        if partner[n] < 0 and free[k]:
            partner[n], free[k] = k, False
    return partner


def _lens(folder: Path, camera: Pinhole | Lens | None) -> Lens:
    if isinstance(camera, Lens):
        return camera
    if camera is not None:
        return Lens(camera.width, camera.height, *camera.intrinsics)
    found = re.search(r"freiburg([123])", folder.resolve().name)
    if found is None:
        raise InputError(
            f"camera: expected a calibration for {folder}, whose name holds none of freiburg1, freiburg2 and freiburg3."
        )
    number = found[1]
    distortion = DISTORTION[number]
    return Lens.of_opencv(WIDTH, HEIGHT, INTRINSICS[number], "radtan" if distortion else "none", distortion)


def _read_list(folder: Path, name: str) -> tuple[Int64[np.ndarray, "N"], list[Path]]:
    table = Table.read(folder / name, "timestamp filename")
    table.check_width(2)
    return table.seconds(), table.paths(1, folder)
