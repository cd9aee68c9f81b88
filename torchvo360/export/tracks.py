"""Which images see which points of the map, and where.

A point is claimed for an image where geometry allows it and the picture agrees: the patch about the point's pixel in
its own keyframe, carried over by the point's range, must look like what the image shows there. A point behind a wall
projects onto the wall, whose patch is another one. Where exactly the image shows it is measured by shifting the patch
to its best place (Lucas-Kanade), so that poses and points have something to be judged by.

Source: Baker and Matthews, Lucas-Kanade 20 years on, IJCV 2004, with gain and offset taken out of the residual.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.image.sampling import sample
from torchvo360.lie import se3_inverse

REACH = 3
"""Pixels from the middle of a patch to its edge: 7 x 7."""

LEAST_CORRELATION = 0.9
"""Of a patch with its host's, brightness and contrast taken out. Source: measured against a rendered world's exact
ranges (tests/export/test_tracks.py)."""

LEAST_CONTRAST = 0.4
"""Of a patch, as a share of its host's."""

LEAST_COSINE = 0.5
"""Of the angle between the directions in which host and image look at a point: 60 degrees."""

MOST_RATIO = 2.0
"""Of a point's distances from image and host: beyond, patches differ in scale."""

SHIFTS = 3
"""Steps of Lucas-Kanade."""

MOST_SHIFT = 1.5
"""Pixels: what is farther from where the point projects is something else."""

AT_ONCE = 10_000
"""Points that are matched in one go: 20 MB of pixels for each of the places that the gradient needs."""

DAMPING = 0.05
"""Added to the normal matrix, as a share of its trace: along an edge a patch has no place of its own, and stays."""


@dataclass(frozen=True, eq=False)
class Patches:
    """The looks of the map's points in their own keyframes."""

    xyz: Float[Tensor, "N P 3"]
    """The patch's pixels in the world, at the range of its point, which is the middle one."""
    value: Float[Tensor, "N P"]
    """Their intensities, 0 to 1."""
    host: Float[Tensor, "N 3"]
    """The host's centre in the world."""

    @classmethod
    def empty(cls, count: int) -> "Patches":
        """Return room for the patches of this many points."""
        side = (2 * REACH + 1) ** 2
        return cls(torch.zeros(count, side, 3), torch.zeros(count, side), torch.zeros(count, 3))

    def fill(
        self,
        which: Bool[Tensor, "N"],
        xyz: Float[Tensor, "n 3"],
        image: UInt8[np.ndarray, "H W 3"],
        camera: Camera,
        T_world_cam: Float64[Tensor, "4 4"],
    ) -> None:
        """Take the patches of a keyframe's points from its image.

        Args:
            which: The points that belong to it.
            xyz: Those points in the world.
            image: Its colours.
            camera: Its camera.
            T_world_cam: Its pose.
        """
        p_cam = _moved(xyz, se3_inverse(T_world_cam))
        step = torch.arange(-REACH, REACH + 1, dtype=torch.float64)
        offsets = torch.cartesian_prod(step, step)
        uv = camera.pixel(p_cam)[:, None] + offsets
        rays = camera.ray(uv) * camera.scale(p_cam)[:, None, None]
        self.xyz[which] = _moved(rays, T_world_cam).float()
        self.value[which] = sample(grey(image), uv[None].float(), camera)[0, 0]
        self.host[which] = T_world_cam[:3, 3].float()

    def seen(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        camera: Camera,
        T_world_cam: Float64[Tensor, "4 4"],
        usable: Bool[Tensor, "H W"] | None,
    ) -> tuple[Bool[Tensor, "N"], Float64[Tensor, "N 2"]]:
        """Return which points an image sees, and at which pixels.

        Args:
            image: Its colours.
            camera: Its camera.
            T_world_cam: Its pose.
            usable: The pixels that may be used; None for all.

        Returns:
            seen: The points it sees.
            uv: Where the point projects, and for the points it sees the best place of the patch.
        """
        middle = self.xyz[:, self.xyz.shape[1] // 2].double()
        here, there = middle - T_world_cam[:3, 3], middle - self.host.double()
        reach, usual = here.norm(dim=-1).clamp(min=1e-9), there.norm(dim=-1).clamp(min=1e-9)
        cosine = (here * there).sum(-1) / (reach * usual)
        ratio = reach / usual
        T_cam_world = se3_inverse(T_world_cam)
        uv, seen = camera.project(_moved(middle, T_cam_world))
        seen &= (cosine > LEAST_COSINE) & (ratio < MOST_RATIO) & (ratio > 1 / MOST_RATIO)
        if usable is not None:
            column = uv[:, 0].long().clamp(0, camera.width - 1)
            row = uv[:, 1].long().clamp(0, camera.height - 1)
            seen &= usable[row, column]
        brightness = grey(image)
        for part in seen.nonzero()[:, 0].split(AT_ONCE):
            at = camera.pixel(_moved(self.xyz[part], T_cam_world.float()))
            seen[part], shift = _matched(self.value[part], brightness, at, camera)
            uv[part] += shift
        return seen, uv


def grey(image: UInt8[np.ndarray, "H W 3"]) -> Float[Tensor, "1 1 H W"]:
    """Return an image's brightness, 0 to 1."""
    return torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))[None, None].float() / 255


def _matched(
    host: Float[Tensor, "n P"], image: Float[Tensor, "1 1 H W"], at: Float[Tensor, "n P 2"], camera: Camera
) -> tuple[Bool[Tensor, "n"], Float[Tensor, "n 2"]]:
    """Return which patches an image shows, and by how many pixels each is beside where it should be."""
    a = host - host.mean(-1, keepdim=True)
    shift = torch.zeros(len(host), 2)
    places = 0.5 * torch.tensor([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])[:, None, None]
    images = image.expand(len(places), -1, -1, -1)
    for _ in range(SHIFTS):
        here = at + shift[:, None]
        b, *sides = sample(images, here + places, camera).flatten(0, 1)
        b = b - b.mean(-1, keepdim=True)
        J = torch.stack([sides[0] - sides[1], sides[2] - sides[3]], 1)
        J = J - J.mean(-1, keepdim=True)
        gain = (a * b).sum(-1, keepdim=True) / (a * a).sum(-1, keepdim=True).clamp(min=1e-9)
        H = J @ J.mT
        trace = H.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        H = H + (DAMPING * trace + 1e-9) * torch.eye(2)
        step = torch.linalg.solve(H, (J @ (gain * a - b)[..., None])[..., 0])
        shift = (shift + step).clamp(-MOST_SHIFT, MOST_SHIFT)
    value = sample(image, (at + shift[:, None])[None], camera)[0, 0]
    b = value - value.mean(-1, keepdim=True)
    length_a, length_b = a.norm(dim=-1), b.norm(dim=-1)
    alike = (a * b).sum(-1) > LEAST_CORRELATION * length_a * length_b
    inside = shift.abs().amax(-1) < MOST_SHIFT
    return alike & (length_b > LEAST_CONTRAST * length_a) & inside, shift


def _moved(p: Float[Tensor, "*batch 3"], T: Float[Tensor, "4 4"]) -> Float[Tensor, "*batch 3"]:
    return p.to(T.dtype) @ T[:3, :3].mT + T[:3, 3]
