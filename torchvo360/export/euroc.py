"""Trajectories as EuRoC's ground truth: lines `timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z`.

Source: Burri and others, The EuRoC micro aerial vehicle datasets, IJRR 2016.
"""

from pathlib import Path

from torchvo360.data.trajectory import Trajectory
from torchvo360.files import atomic_path
from torchvo360.lie import quaternion_from_matrix

HEADER = "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []"


def write_euroc(path: str | Path, trajectory: Trajectory) -> None:
    """Write one line a pose T_world_cam: the camera stands where EuRoC's own files have the body.

    Raises:
        OSError: The file cannot be written.
    """
    quaternions = quaternion_from_matrix(trajectory.T_world_cam[:, :3, :3])[:, [3, 0, 1, 2]]
    lines = [HEADER]
    for t_ns, t, q in zip(trajectory.t_ns.tolist(), trajectory.positions.tolist(), quaternions.tolist(), strict=True):
        lines.append(",".join([str(t_ns), *(f"{value:.12g}" for value in (*t, *q))]))
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")
