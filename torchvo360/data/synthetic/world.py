"""The world: textured solids in a shell, rendered for any central camera.

The colour of a pixel is one sample, filtered to the pixel's footprint, and the mean of eight where faces meet in it.
Its range is that of the pixel's centre.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_pose
from torchvo360.data.synthetic.geometry import Solids
from torchvo360.data.synthetic.rays import CameraRays, RayGroups
from torchvo360.data.synthetic.surfaces import Surfaces

CHUNK = 1 << 17
"""Rays worked on at once: more is no faster, and memory stays bounded at any image size."""


@dataclass(frozen=True)
class Mover:
    """A solid that swings between two places."""

    solid: int
    swing: tuple[float, float, float]
    """Displacement at the far end, metres."""
    period_s: float

    def offset(self, t: float) -> Float[Tensor, "3"]:
        """Return how far it is from its place at a time, metres."""
        return (1 - math.cos(math.tau * t / self.period_s)) / 2 * torch.tensor(self.swing)


@dataclass(frozen=True)
class Traveller:
    """A solid that goes along a path, in straight lines between its places, and stays at the last one."""

    solid: int
    path: Float[Tensor, "N 3"]
    """Displacement at each of the times k / fps, metres."""
    fps: float

    def offset(self, t: float) -> Float[Tensor, "3"]:
        """Return how far it is from its place at a time, metres."""
        at = min(max(t * self.fps, 0.0), len(self.path) - 1.0)
        k = min(int(at), len(self.path) - 2) if len(self.path) > 1 else 0
        return torch.lerp(self.path[k], self.path[min(k + 1, len(self.path) - 1)], at - k)


@dataclass(frozen=True)
class Walkway:
    """A closed curve in free space around `centre`: an ellipse, metres."""

    centre: tuple[float, float]
    radii: tuple[float, float]
    eye_height: float


@dataclass(frozen=True)
class World:
    """A static world, but for its movers; z is up and the floor lies at z = 0."""

    name: str
    solids: Solids
    surfaces: Surfaces
    walkway: Walkway
    movers: tuple[Mover | Traveller, ...] = ()

    def render(
        self, camera: Camera | CameraRays, T_world_cam: Float[Tensor, "*batch 4 4"], t: float = 0.0
    ) -> tuple[Float[Tensor, "*batch 3 H W"], Float[Tensor, "*batch H W"]]:
        """Render images and ranges.

        Args:
            camera: Any central camera, or its rays made once for many calls.
            T_world_cam: Poses of the camera in the world, inside the shell.
            t: Time in seconds, which only movers depend on.

        Returns:
            image: Colours in [0, 1].
            range: Exact range of each pixel's centre in the camera's measure; inf for the sky.

        Raises:
            ShapeError: The poses are not 4 x 4.
            InputError: They are not rigid, or one of them lies outside the world.
        """
        check_pose("T_world_cam", T_world_cam)
        poses = T_world_cam.reshape(-1, 4, 4).double()
        apart = (poses[:, :3, 3] - self.solids.centre[0]).abs()
        if bool((apart >= self.solids.half[0]).any()):
            raise InputError(f"T_world_cam: expected a position inside the world {self.name}, got one outside.")
        rays = camera if isinstance(camera, CameraRays) else CameraRays.of(camera)
        solids = self._solids_at(t)
        image = torch.empty(len(poses), 3, rays.camera.height, rays.camera.width)
        reach = torch.empty(len(poses), rays.camera.height, rays.camera.width)
        with torch.no_grad():
            for k, pose in enumerate(poses):
                image[k], reach[k] = self._render(rays, solids, pose)
        batch = T_world_cam.shape[:-2]
        return image.view(*batch, *image.shape[1:]), reach.view(*batch, *reach.shape[1:])

    def clearance(self, point: Float[Tensor, "N 3"], t: float = 0.0) -> Float[Tensor, "N"]:
        """Return the distance from points to the nearest surface at time t, metres; negative outside free space."""
        return self._solids_at(t).clearance(point)

    def _solids_at(self, t: float) -> Solids:
        if not self.movers:
            return self.solids
        offset = torch.zeros_like(self.solids.centre)
        for mover in self.movers:
            offset[mover.solid] = mover.offset(t)
        return self.solids.moved(offset)

    def _render(
        self, rays: CameraRays, solids: Solids, T_world_cam: Float[Tensor, "4 4"]
    ) -> tuple[Float[Tensor, "3 H W"], Float[Tensor, "H W"]]:
        colour, reach, face = self._look(rays.tiles, solids, T_world_cam)
        image, reach, face = rays.image(colour).contiguous(), rays.image(reach), rays.image(face)
        row, column = _borders(face, rays.camera.wraps).nonzero(as_tuple=True)
        if len(row):
            samples, _, _ = self._look(rays.inside(row, column), solids, T_world_cam)
            image[:, row, column] = samples.mean(-1)
        return image, reach

    def _look(
        self, groups: RayGroups, solids: Solids, T_world_cam: Float[Tensor, "4 4"]
    ) -> tuple[Float[Tensor, "3 G R"], Float[Tensor, "G R"], Int[Tensor, "G R"]]:
        """Return the colour, the range and the face of every ray."""
        R, origin = T_world_cam[:3, :3].float(), T_world_cam[:3, 3].float()
        count, lanes = groups.length.shape
        looks = []
        step = max(1, CHUNK // lanes)
        for start in range(0, count, step):
            part = groups[start : start + step]
            ray = (R @ part.ray.flatten(1)).view_as(part.ray)
            reach, met = solids.cast(origin, ray, R @ part.axis, part.angle)
            colour, face = self.surfaces.shade(solids, origin, ray, reach, met, part.length, part.spread)
            looks.append((colour, reach, face))
        colours, reaches, faces = zip(*looks, strict=True)
        return torch.cat(colours, 1), torch.cat(reaches), torch.cat(faces)


def _borders(face: Int[Tensor, "H W"], wraps: bool) -> Bool[Tensor, "H W"]:
    """Return the pixels with a neighbour on another face."""
    border = torch.zeros_like(face, dtype=torch.bool)
    for differs, first, second in (
        (face[:, 1:] != face[:, :-1], border[:, 1:], border[:, :-1]),
        (face[1:] != face[:-1], border[1:], border[:-1]),
    ):
        first |= differs
        second |= differs
    if wraps:
        seam = face[:, 0] != face[:, -1]
        border[:, 0] |= seam
        border[:, -1] |= seam
    return border
