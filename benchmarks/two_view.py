"""Compare a trajectory with independent two-view estimates: rotations and directions of motion over 10 frames.

    python benchmarks/two_view.py runs/<...>/trajectory.txt reference_two_view.json [stella_vslam.txt]

The reference holds `pairs` with frame numbers `i`, `j`, the rotation `R_ji` and the direction `cam_j_center_dir_in_i`.
With a whole reference trajectory (TUM) the scale of each quarter against it is printed too, relative to the first.
"""

import json
import sys
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.data.registration import associate, similarity_from_points
from torchvo360.data.trajectory import Trajectory
from torchvo360.data.tum import read_tum


def read_pairs(path: str | Path) -> list[dict[str, Any]]:
    """Return the two-view estimates of a reference."""
    return json.loads(Path(path).read_text(encoding="utf-8"))["pairs"]


def two_view_errors_deg(
    trajectory: Trajectory, pairs: list[dict[str, Any]]
) -> tuple[Float64[Tensor, "P"], Float64[Tensor, "P"]]:
    """Return the errors of rotations and of directions, degrees, for the pairs that the trajectory reaches."""
    pairs = [pair for pair in pairs if pair["j"] < len(trajectory)]
    i, j = (torch.tensor([pair[name] for pair in pairs]) for name in ("i", "j"))
    T_j_i = lie.se3_inverse(trajectory.T_world_cam[j]) @ trajectory.T_world_cam[i]
    R_ref = torch.tensor([pair["R_ji"] for pair in pairs], dtype=torch.float64)
    rotation = lie.so3_angle(T_j_i[:, :3, :3] @ R_ref.mT).rad2deg()
    centre = lie.se3_inverse(T_j_i)[:, :3, 3]
    wanted = torch.tensor([pair["cam_j_center_dir_in_i"] for pair in pairs], dtype=torch.float64)
    cosine = torch.nn.functional.cosine_similarity(centre, wanted)
    return rotation, cosine.clamp(-1, 1).acos().rad2deg()


def main() -> None:
    """Print the medians, and the scales of the quarters."""
    trajectory = read_tum(sys.argv[1])
    rotation, direction = two_view_errors_deg(trajectory, read_pairs(sys.argv[2]))
    medians = f"rotation {rotation.median():.3f} deg, direction {direction.median():.2f} deg (medians)"
    print(f"{len(rotation)} pairs: {medians}")
    if len(sys.argv) > 3:
        reference = read_tum(sys.argv[3])
        ours, theirs = associate(trajectory, reference)
        scales = []
        for mine, its in zip(ours.tensor_split(4), theirs.tensor_split(4), strict=True):
            S = similarity_from_points(trajectory.positions[mine], reference.positions[its])
            if S is None:
                raise SystemExit("a quarter of the trajectory stands still: it has no scale.")
            scales.append(float(torch.linalg.det(S[:3, :3]) ** (1 / 3)))
        print("scale by quarter:", ", ".join(f"{scale / scales[0]:.3f}" for scale in scales))


if __name__ == "__main__":
    main()
