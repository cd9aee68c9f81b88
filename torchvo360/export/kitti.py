"""Trajectories as KITTI poses: one line a frame with the 12 numbers of the upper rows of T_first_cam.

The format has no times: line k is frame k. Where a trajectory has no pose for a frame, one is put between its
neighbours.

Source: the odometry benchmark's development kit, readme.txt.
"""

from pathlib import Path

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_pose, check_shape
from torchvo360.data.trajectory import Trajectory
from torchvo360.files import atomic_path
from torchvo360.lie import se3_exp, se3_inverse, se3_log


def write_kitti(path: str | Path, T_world_cam: Float64[Tensor, "N 4 4"]) -> None:
    """Write the poses of all frames, relative to the first one.

    Args:
        path: The file; it appears only when it is complete.
        T_world_cam: One pose a frame, metres.

    Raises:
        InputError: There is none, or one is not a rigid motion.
        OSError: The file cannot be written.
    """
    check_shape("T_world_cam", T_world_cam, "N 4 4")
    check_pose("T_world_cam", T_world_cam)
    if not len(T_world_cam):
        raise InputError("T_world_cam: expected at least one pose, got none.")
    T_first_cam = se3_inverse(T_world_cam[0]) @ T_world_cam
    lines = [" ".join(f"{value:.12g}" for value in row) for row in T_first_cam[:, :3].flatten(1).tolist()]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def poses_at(trajectory: Trajectory, t_ns: Int64[Tensor, "N"]) -> Float64[Tensor, "N 4 4"]:
    """Return T_world_cam at any times: on the screw motion between the poses before and after, or the nearest one's.

    Args:
        trajectory: At least one pose.
        t_ns: Times in nanoseconds; those beyond the trajectory get its first or last pose.

    Raises:
        InputError: The trajectory is empty.
    """
    if not len(trajectory):
        raise InputError("trajectory: expected at least one pose, got none.")
    known = trajectory.t_ns
    after = torch.searchsorted(known, t_ns.contiguous()).clamp(max=len(known) - 1)
    before = torch.where(known[after] > t_ns, after - 1, after).clamp(min=0)
    gap = (known[after] - known[before]).clamp(min=1)
    share = ((t_ns - known[before]).double() / gap).clamp(0.0, 1.0)
    T_world_before = trajectory.T_world_cam[before]
    xi = se3_log(se3_inverse(T_world_before) @ trajectory.T_world_cam[after])
    return T_world_before @ se3_exp(share[:, None] * xi)
