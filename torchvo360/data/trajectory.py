"""A trajectory: times and poses T_world_cam."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_pose, check_shape


@dataclass(frozen=True)
class Trajectory:
    """Poses T_world_cam in time order, metres; times are integer nanoseconds and strictly increase."""

    t_ns: Int64[Tensor, "N"]
    T_world_cam: Float64[Tensor, "N 4 4"]

    def __post_init__(self) -> None:
        check_shape("t_ns", self.t_ns, "N")
        check_shape("T_world_cam", self.T_world_cam, f"{self.t_ns.shape[0]} 4 4")
        if self.t_ns.dtype != torch.int64:
            raise InputError(f"t_ns: expected int64, got {self.t_ns.dtype}.")
        check_pose("T_world_cam", self.T_world_cam)
        if not bool((self.t_ns.diff() > 0).all()):
            raise InputError("t_ns: expected strictly increasing times, got repeated or unordered ones.")

    def __len__(self) -> int:
        return self.t_ns.shape[0]

    @property
    def positions(self) -> Float64[Tensor, "N 3"]:
        """Camera centres in the world, metres."""
        return self.T_world_cam[:, :3, 3]

    @property
    def path_length(self) -> float:
        """Length of the path through all camera centres, metres."""
        return float(torch.linalg.vector_norm(self.positions.diff(dim=0), dim=-1).sum())
