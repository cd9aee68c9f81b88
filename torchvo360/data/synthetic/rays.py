"""The rays of a camera, grouped so that a group is tested against few solids."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchvo360.cameras import Camera

TILE = 8
"""Side of a tile, pixels."""
SUBPIXEL = (
    (-0.4375, 0.0625), (-0.3125, -0.3125), (-0.1875, 0.3125), (-0.0625, -0.0625),
    (0.0625, 0.4375), (0.1875, -0.4375), (0.3125, 0.1875), (0.4375, -0.1875),
)  # fmt: skip
"""Eight samples inside a pixel, each alone in its row and its column of an 8 x 8 grid."""


@dataclass(frozen=True)
class RayGroups:
    """Groups of R neighbouring rays in the camera frame, each inside a cone."""

    ray: Float[Tensor, "3 G R"]
    """Rays with range 1 in the camera's measure."""
    length: Float[Tensor, "G R"]
    """Euclidean length of each ray."""
    spread: Float[Tensor, "G R"]
    """Width that one pixel covers at range 1, across the ray, metres."""
    axis: Float[Tensor, "3 G"]
    """Unit axis of each group's cone."""
    angle: Float[Tensor, "G"]
    """Half opening of each group's cone, radians."""

    def __getitem__(self, part: slice) -> "RayGroups":
        """Return some of the groups."""
        return RayGroups(self.ray[:, part], self.length[part], self.spread[part], self.axis[:, part], self.angle[part])

    @classmethod
    def of(cls, ray: Float[Tensor, "G R 3"], pixel: Float[Tensor, "G R"]) -> "RayGroups":
        """Group rays [G, R, 3] whose pixels have the angular size `pixel`, radians."""
        length = torch.linalg.vector_norm(ray, dim=-1)
        unit = ray / length[..., None]
        axis = F.normalize(unit.mean(1), dim=-1)
        # the angle by its chord, which keeps its digits at small angles; 1e-4 for the rounding
        half_chord = torch.linalg.vector_norm(unit - axis[:, None], dim=-1).amax(1) / 2
        angle = 2 * torch.asin(half_chord.clamp_max(1.0)) + 1e-4
        return cls(ray.permute(2, 0, 1).contiguous(), length, pixel * length, axis.mT.contiguous(), angle)


@dataclass(frozen=True)
class CameraRays:
    """A camera's image cut into tiles of rays; made once for many frames."""

    camera: Camera
    tiles: RayGroups
    pixel: Float[Tensor, "Hp Wp"]
    """Angular size of each pixel, radians, on the image padded to whole tiles."""

    @classmethod
    def of(cls, camera: Camera) -> "CameraRays":
        """Cut the image of a camera into tiles."""
        rows, columns = -(-camera.height // TILE), -(-camera.width // TILE)
        u = torch.arange(columns * TILE + 1, dtype=torch.float64) + 0.5
        v = torch.arange(rows * TILE + 1, dtype=torch.float64) + 0.5
        # Pixels beyond the border complete the last tiles, and are cut off at the end.
        ray = camera.ray(torch.stack([u.expand(len(v), -1), v[:, None].expand(-1, len(u))], -1))
        unit = F.normalize(ray, dim=-1)
        by_u = torch.linalg.vector_norm(unit[:-1, 1:] - unit[:-1, :-1], dim=-1)
        by_v = torch.linalg.vector_norm(unit[1:, :-1] - unit[:-1, :-1], dim=-1)
        pixel = torch.maximum(by_u, by_v)
        tiled = ray[:-1, :-1].unflatten(0, (rows, TILE)).unflatten(2, (columns, TILE)).transpose(1, 2)
        tiled = tiled.reshape(rows * columns, TILE * TILE, 3)
        tiled_pixel = pixel.unflatten(0, (rows, TILE)).unflatten(2, (columns, TILE)).transpose(1, 2)
        groups = RayGroups.of(tiled.float(), tiled_pixel.reshape(rows * columns, TILE * TILE).float())
        return cls(camera, groups, pixel.float())

    def image(self, tiled: Float[Tensor, "... G R"]) -> Float[Tensor, "... H W"]:
        """Put values given by tile back into the image."""
        rows, columns = self.pixel.shape[0] // TILE, self.pixel.shape[1] // TILE
        grid = tiled.unflatten(-1, (TILE, TILE)).unflatten(-3, (rows, columns)).transpose(-3, -2)
        return grid.flatten(-4, -3).flatten(-2, -1)[..., : self.camera.height, : self.camera.width]

    def inside(self, row: Tensor, column: Tensor) -> RayGroups:
        """Return eight rays inside each of the given pixels, a group for each pixel."""
        offset = torch.tensor(SUBPIXEL)
        uv = torch.stack([column, row], -1).to(torch.float32)[:, None] + 0.5 + offset
        # Each sample answers for an eighth of the pixel; half its width joins the eight without a gap.
        return RayGroups.of(self.camera.ray(uv), 0.5 * self.pixel[row, column][:, None].expand(-1, len(SUBPIXEL)))
