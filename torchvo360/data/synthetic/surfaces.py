"""What surfaces look like: texture, light, and the colour each ray sees.

Texture and light are fixed to surfaces (Lambertian): a point has one colour from everywhere, but for what the pixel's
own footprint averages.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchvo360.data.synthetic.geometry import Solids
from torchvo360.data.synthetic.texture import HEIGHT, WIDTH, TextureAtlas


@dataclass(frozen=True)
class Faces:
    """How each face of each solid looks; rows 6 p + (0 .. 5) for +x, -x, +y, -y, +z, -z of solid p, the sky last."""

    chart: Float[Tensor, "Q"]
    corner: Float[Tensor, "2 Q"]
    """Texels of the face's middle."""
    density: Float[Tensor, "Q"]
    """Texels a metre; for the sky, texels a radian at its zenith."""
    tint: Float[Tensor, "3 Q"]
    normal: Float[Tensor, "3 Q"]
    """Outward unit normal in the world; of the shell, inward."""


@dataclass(frozen=True)
class Lamp:
    """A lamp at a point; its light falls with distance as 1 / (1 + (d / reach)^2)."""

    position: tuple[float, float, float]
    strength: float
    reach: float


@dataclass(frozen=True)
class Surfaces:
    """The looks of all faces and the light on them."""

    faces: Faces
    atlas: TextureAtlas
    lamps: tuple[Lamp, ...]
    ambient: float
    """Light that reaches every surface, as a factor on its colour."""
    panorama_chart: int = -1
    """Chart that is looked up by direction from `panorama_centre`; -1 for none."""
    panorama_centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def shade(
        self,
        solids: Solids,
        origin: Float[Tensor, "3"],
        ray: Float[Tensor, "3 *rays"],
        reach: Float[Tensor, "*rays"],
        met: Int[Tensor, "*rays"],
        length: Float[Tensor, "*rays"],
        spread: Float[Tensor, "*rays"],
    ) -> tuple[Float[Tensor, "3 *rays"], Int[Tensor, "*rays"]]:
        """Return the colour that each ray sees and the face it ends on.

        Args:
            solids: Where the solids are now.
            origin: Camera centre in the world.
            ray: Rays in the world.
            reach: How often each ray fits before its surface; inf for the sky.
            met: The solid it ends on, as `Solids.cast` tells.
            length: Euclidean length of the rays.
            spread: Width of a pixel across the ray at `reach` 1, metres.
        """
        shape = reach.shape
        ray, reach, met, length, spread = ray.flatten(1), *(x.flatten() for x in (reach, met, length, spread))
        by_solid, by_face = self._tables(solids)
        cx, cy, cz, inv_x, inv_y, inv_z, c, s, radius = by_solid.index_select(1, met)
        is_sky = reach.isinf() if solids.open_above else None
        depth = reach if is_sky is None else reach.masked_fill(is_sky, 1.0)
        point = torch.addcmul(origin[:, None], ray, depth)
        dx, dy, dz = ray
        px, py, pz = point
        # the point and the ray along the solid's own axes
        x, y, z = px - cx, py - cy, pz - cz
        x, y = c * x + s * y, c * y - s * x
        ux, uy = c * dx + s * dy, c * dy - s * dx
        near_x, near_y, near_z = inv_x.mul_(x).abs_(), inv_y.mul_(y).abs_(), inv_z.mul_(z).abs_()
        rounds = radius.nonzero()[:, 0]
        rx, ry = x[rounds], y[rounds]
        radial = torch.hypot(rx, ry)
        cap = near_z[rounds] * radius[rounds] > radial
        if len(rounds):
            # A cylinder unrolled is a face +x: u along the circumference, x outward.
            near_x[rounds], near_y[rounds] = radial / radius[rounds], 0.0
            ux[rounds] = (rx * ux[rounds] + ry * uy[rounds]) / radial
            x[rounds] = torch.where(cap, rx, radial)
            y[rounds] = torch.where(cap, ry, torch.atan2(ry, rx) * radial)
        on_z = near_z > torch.maximum(near_x, near_y)
        on_y = (near_y > near_x) & ~on_z
        along = torch.where(on_z, z, torch.where(on_y, y, x))
        slope = torch.where(on_z, dz, torch.where(on_y, uy, ux)).abs_()
        face = met * 6 + on_y.int() * 2 + on_z.int() * 4 + (along < 0).int()
        chart, u0, v0, density, red, green, blue, *normal = by_face.index_select(1, face)
        if len(rounds):
            normal[0][rounds], normal[1][rounds] = torch.where(cap, 0.0, torch.stack([rx, ry]) / radial)
        u = torch.where(on_z | on_y, x, y).mul_(density).add_(u0)
        v = torch.where(on_z, y, z).mul_(density).add_(v0)
        # The footprint is `across` wide and 1 / slant times as long. A round filter in between: less blur than the
        # longer side asks, less alias than the shorter.
        across = depth * spread
        slant = slope.div_(length).clamp_min_(0.02)
        width = across * density * slant.pow_(-0.75)
        light = self._light(point, normal)
        if is_sky is not None:
            # the sky is a plane seen through a bent lens: smooth down to the horizon
            rise = 1 / (dz + 0.3 * length)
            u = torch.where(is_sky, dx * rise * density + u0, u)
            v = torch.where(is_sky, dy * rise * density + v0, v)
            width = torch.where(is_sky, spread * rise * density, width)
            light = light.masked_fill_(is_sky, 1.0)
        if self.panorama_chart >= 0:
            self._wear_panorama(chart, is_sky, point, ray, across, u, v, width, light)
        colour = self.atlas.sample(chart, u, v, width)
        tinted = torch.stack([red * light, green * light, blue * light]).mul_(colour.mT).clamp_(0, 1)
        return tinted.view(3, *shape), face.view(shape)

    def _tables(self, solids: Solids) -> tuple[Float[Tensor, "9 P1"], Float[Tensor, "10 Q"]]:
        """Return the columns that shading reads by solid and by face; the sky is the last solid, of size 0."""
        radius = solids.is_round * solids.half[:, 0]
        by_solid = torch.cat([solids.centre.mT, 1 / solids.half.mT, solids.heading.mT, radius[None]])
        faces = self.faces
        by_face = torch.cat([faces.chart[None], faces.corner, faces.density[None], faces.tint, faces.normal])
        return F.pad(by_solid, (0, 1)), by_face

    def _light(self, point: Float[Tensor, "3 N"], normal: list[Float[Tensor, "N"]]) -> Float[Tensor, "N"]:
        light = torch.full_like(point[0], self.ambient)
        for lamp in self.lamps:
            x, y, z = (at - p for at, p in zip(lamp.position, point, strict=True))
            distance2 = x * x + y * y + z * z
            facing = (x * normal[0] + y * normal[1] + z * normal[2]) * distance2.rsqrt()
            # a third of the light comes by way of the other surfaces, so that no side is black
            light += lamp.strength * facing.clamp_min_(0).mul_(0.65).add_(0.35) / distance2.div_(lamp.reach**2).add_(1)
        return light

    def _wear_panorama(
        self,
        chart: Float[Tensor, "N"],
        is_sky: Bool[Tensor, "N"] | None,
        point: Float[Tensor, "3 N"],
        ray: Float[Tensor, "3 N"],
        across: Float[Tensor, "N"],
        u: Float[Tensor, "N"],
        v: Float[Tensor, "N"],
        width: Float[Tensor, "N"],
        light: Float[Tensor, "N"],
    ) -> None:
        """Put the panorama's texels, in place, on the faces that wear it: sky by direction, walls from its centre."""
        wears = (chart == self.panorama_chart).nonzero()[:, 0]
        from_centre = point[:, wears] - torch.tensor(self.panorama_centre)[:, None]
        if is_sky is not None:
            from_centre = torch.where(is_sky[wears], ray[:, wears], from_centre)
        x, y, z = from_centre
        distance = (x * x + y * y + z * z).sqrt()
        # the panorama's middle looks along the world's x axis
        u[wears] = (0.5 - torch.atan2(y, x) / torch.pi / 2) * WIDTH
        wide = across[wears] / distance * (HEIGHT / torch.pi)
        edge = wide.clamp_min(1.0) * 2  # the poles do not wrap
        row = (0.5 - torch.asin((z / distance).clamp(-1, 1)) / torch.pi) * HEIGHT
        v[wears] = torch.minimum(torch.maximum(row, edge), HEIGHT - edge)
        width[wears] = wide
        light[wears] = 1.0
