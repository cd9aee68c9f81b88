"""Sequences of the EuRoC MAV data set, or others in its ASL layout: stereo pairs and inertial measurements.

    mav0/cam0/data.csv, mav0/cam1/data.csv    lines `timestamp [ns],filename`, the images in data/ beside them
    mav0/imu0/data.csv                        lines `timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z`
    mav0/state_groundtruth_estimate0/data.csv lines `timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z,...` of T_world_body
    */sensor.yaml                             calibrations; T_BS maps a sensor's points into the body

Only cam0 has to be there.

Source: Burri and others, The EuRoC micro aerial vehicle datasets, IJRR 2016, and the data's own sensor.yaml.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.cameras import Lens
from torchvo360.cameras.rig import MIN_BASELINE
from torchvo360.checks import InputError
from torchvo360.data.calibration import LEAST_QUATERNION, pose_of_numbers, read_calibration, read_yaml
from torchvo360.data.imu import read_imu_csv
from torchvo360.data.recording import Recording, Stream, rig_poses
from torchvo360.data.selection import Selection
from torchvo360.data.table import Table
from torchvo360.data.trajectory import Trajectory
from torchvo360.inertial import ImuNoise, ImuSensor
from torchvo360.lie import matrix_from_quaternion, se3, se3_inverse

NOISE = {
    "gyro": "gyroscope_noise_density",
    "accel": "accelerometer_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accel_walk": "accelerometer_random_walk",
}


def open_euroc(
    folder: Path,
    *,
    selection: Selection,
    resize: tuple[int, int] | None = None,
    stereo: bool = True,
    use_imu: bool = True,
) -> Recording:
    """Open a sequence in EuRoC's layout; images are undistorted, not rectified.

    Args:
        folder: `mav0`, or the folder around it.
        selection: Which images of cam0 are used.
        resize: Width and height to bring the images to.
        stereo: Whether cam1 is used, where it is there; its images belong to those of cam0 with equal times.
        use_imu: Whether imu0 is used, where it is there.

    Returns:
        The frames of cam0. The true poses are cam0's too.

    Raises:
        InputError: A file of what is used is missing or damaged or names files outside the folder, a calibration is
            impossible, the cameras' images differ in size or have no time in common.
    """
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    first = _Camera.read(root / "cam0")
    streams = [Stream(f"{root / 'cam0'}", first.lens, first.paths)]
    T_first_cam = None
    if stereo and (root / "cam1" / "data.csv").is_file():
        second = _Camera.read(root / "cam1")
        streams.append(Stream(f"{root / 'cam1'}", second.lens, second.at(first.t_ns)))
        T_first_cam = rig_poses(se3_inverse(first.T_body_cam) @ second.T_body_cam)
        if float(torch.linalg.vector_norm(T_first_cam[1, :3, 3])) < MIN_BASELINE:
            raise InputError(f"{root / 'cam1' / 'sensor.yaml'}: expected T_BS apart from cam0's, got the same place.")
    notes: list[str] = []
    imu = _read_imu(root / "imu0", first.T_body_cam, notes) if use_imu else None
    place = folder.resolve()
    return Recording(
        place.parent.name if place.name == "mav0" else place.name,
        first.t_ns.tolist(),
        streams,
        selection=selection,
        resize=resize,
        T_first_cam=T_first_cam,
        truth=_read_truth(root / "state_groundtruth_estimate0" / "data.csv", first.T_body_cam),
        imu=imu,
        notes=notes,
    )


@dataclass(frozen=True, eq=False)
class _Camera:
    folder: Path
    lens: Lens
    T_body_cam: Float64[Tensor, "4 4"]
    t_ns: Int64[np.ndarray, "N"]
    paths: list[Path]

    @classmethod
    def read(cls, folder: Path) -> "_Camera":
        table = Table.read(folder / "data.csv", "timestamp [ns],filename", separator=",")
        table.check_width(2)
        file = folder / "sensor.yaml"
        calibration = read_calibration(file)
        if calibration.T_cam_imu is None:
            raise InputError(f"{file}: expected T_BS, the camera's pose on the body, got none.")
        lens, T_body_cam = calibration.lenses[0], calibration.T_body_cam[0]
        return cls(folder, lens, T_body_cam, table.nanoseconds(), table.paths(1, folder / "data"))

    def at(self, t_ns: Int64[np.ndarray, "N"]) -> list[Path | None]:
        """Return the images of these times, None where there is none at exactly that time."""
        paths: list[Path | None] = [None] * len(t_ns)
        _, here, there = np.intersect1d(self.t_ns, t_ns, assume_unique=True, return_indices=True)
        if not len(here):
            raise InputError(f"{self.folder / 'data.csv'}: expected images at the times of cam0's, got none.")
        for source, target in zip(here, there, strict=True):
            paths[target] = self.paths[source]
        return paths


def _read_imu(folder: Path, T_body_cam: Float64[Tensor, "4 4"], notes: list[str]) -> ImuSensor | None:
    if not (folder / "data.csv").is_file():
        return None
    samples = read_imu_csv(folder / "data.csv")
    file = folder / "sensor.yaml"
    if not file.is_file():
        notes.append(
            "imu: there is no sensor.yaml for imu0: it is taken for the body, with the noise of EuRoC's sensor."
        )
        return ImuSensor(samples, T_cam_imu=se3_inverse(T_body_cam))
    settings = read_yaml(file)
    missing = [key for key in ("T_BS", *NOISE.values()) if key not in settings]
    if missing:
        raise InputError(f"{file}: expected {missing[0]}, got none.")
    pose = settings["T_BS"]
    T_body_imu = pose_of_numbers(f"{file}, T_BS", pose.get("data") if isinstance(pose, Mapping) else pose)
    try:
        # YAML takes 1e-3, without a point, for a word
        noise = ImuNoise(**{name: float(settings[key]) for name, key in NOISE.items()})
    except (TypeError, ValueError):
        keys = ", ".join(NOISE.values())
        raise InputError(f"{file}: expected finite numbers above 0 in {keys}, got others.") from None
    return ImuSensor(samples, noise, se3_inverse(T_body_cam) @ T_body_imu)


def _read_truth(file: Path, T_body_cam: Float64[Tensor, "4 4"]) -> Trajectory | None:
    if not file.is_file():
        return None
    table = Table.read(file, "timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z", separator=",")
    table.check_width(8, math.inf)
    values = torch.from_numpy(table.values(1, 8))
    quaternion = values[:, [4, 5, 6, 3]]
    zero = (torch.linalg.vector_norm(quaternion, dim=-1) < LEAST_QUATERNION).nonzero()
    if len(zero):
        raise table.complaint(int(zero[0]), "a unit quaternion q_w,q_x,q_y,q_z", "zero")
    T_world_body = se3(matrix_from_quaternion(quaternion), values[:, :3])
    return Trajectory(torch.from_numpy(table.nanoseconds()), T_world_body @ T_body_cam)
