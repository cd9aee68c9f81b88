"""The world: solids with textures and light, rendered for any central camera.

Light and texture are fixed to surfaces (Lambertian): a point has one colour from everywhere, but for what the pixel's
own footprint averages. The colour of a pixel is one filtered sample, and the mean of eight where two surfaces share it.
"""

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_pose
from torchvo360.data.synthetic.geometry import Solids
from torchvo360.data.synthetic.rays import SUBPIXEL, CameraRays, RayGroups
from torchvo360.data.synthetic.texture import HEIGHT, WIDTH, TextureAtlas

CHUNK = 1 << 14
"""Rays worked on at once: their temporaries stay in the cache."""


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
class Mover:
    """A solid that swings between two places."""

    solid: int
    swing: tuple[float, float, float]
    """Displacement at the far end, metres."""
    period_s: float


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
    faces: Faces
    atlas: TextureAtlas
    lamps: tuple[Lamp, ...]
    ambient: float
    walkway: Walkway
    movers: tuple[Mover, ...] = ()
    panorama_chart: int = -1
    """Chart that is looked up by direction from `panorama_centre`; -1 for none."""
    panorama_centre: tuple[float, float, float] = (0.0, 0.0, 1.5)
    _rays: dict[Camera, CameraRays] = field(default_factory=dict, compare=False, repr=False)

    def render(
        self, camera: Camera, T_world_cam: Float[Tensor, "*batch 4 4"], t: float = 0.0
    ) -> tuple[Float[Tensor, "*batch 3 H W"], Float[Tensor, "*batch H W"]]:
        """Render images and ranges.

        Args:
            camera: Any central camera.
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
        rays = self._rays_of(camera)
        solids = self._solids_at(t)
        with torch.no_grad():
            views = [self._render(rays, solids, pose) for pose in poses]
        batch = T_world_cam.shape[:-2]
        image = torch.stack([view[0] for view in views]) if views else torch.empty(0, 3, camera.height, camera.width)
        reach = torch.stack([view[1] for view in views]) if views else torch.empty(0, camera.height, camera.width)
        return image.view(*batch, *image.shape[1:]), reach.view(*batch, *reach.shape[1:])

    def clearance(self, point: Float[Tensor, "N 3"], t: float = 0.0) -> Float[Tensor, "N"]:
        """Return the distance from points to the nearest surface, metres; negative outside free space."""
        solids = self._solids_at(t)
        to_point = point[:, None] - solids.centre.to(point)
        c, s = solids.heading.to(point).mT
        x, y, z = to_point.unbind(-1)
        half = solids.half.to(point)
        local = torch.stack([c * x + s * y, c * y - s * x], -1).abs() - half[:, :2]
        radial = torch.hypot(x, y) - half[:, 0]
        plan_outside = torch.where(solids.is_round, radial.clamp_min(0), torch.linalg.vector_norm(local.clamp_min(0), dim=-1))
        plan_inside = torch.where(solids.is_round, radial, local.amax(-1)).clamp_max(0)
        over = z.abs() - half[:, 2]
        distance = torch.hypot(plan_outside, over.clamp_min(0)) + torch.maximum(plan_inside, over).clamp_max(0)
        walls = (half[0] - to_point[:, 0].abs())
        if solids.open_above:
            walls[:, 2] = to_point[:, 0, 2] + half[0, 2]
        return torch.cat([distance[:, 1:], walls], -1).amin(-1)

    def _rays_of(self, camera: Camera) -> CameraRays:
        if camera not in self._rays:
            self._rays.clear()
            self._rays[camera] = CameraRays.of(camera)
        return self._rays[camera]

    def _solids_at(self, t: float) -> Solids:
        if not self.movers:
            return self.solids
        offset = torch.zeros_like(self.solids.centre)
        for mover in self.movers:
            phase = torch.tensor(torch.pi * 2 * t / mover.period_s, dtype=torch.float64)
            offset[mover.solid] = ((1 - phase.cos()) / 2 * torch.tensor(mover.swing)).float()
        return self.solids.moved(offset)

    def _render(
        self, rays: CameraRays, solids: Solids, T_world_cam: Float[Tensor, "4 4"]
    ) -> tuple[Float[Tensor, "3 H W"], Float[Tensor, "H W"]]:
        colour, reach, face = self._look(rays.tiles, solids, T_world_cam)
        image, reach, face = rays.image(colour.mT.unflatten(1, rays.tiles.length.shape)), rays.image(reach), rays.image(face)
        image = image.contiguous()
        row, column = _borders(face, rays.camera.wraps).nonzero(as_tuple=True)
        if len(row):
            samples, _, _ = self._look(rays.inside(row, column), solids, T_world_cam)
            image[:, row, column] = samples.view(len(row), len(SUBPIXEL), 3).mean(1).mT
        return image, reach

    def _look(
        self, groups: RayGroups, solids: Solids, T_world_cam: Float[Tensor, "4 4"]
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "G R"], Int[Tensor, "G R"]]:
        """Return the colour, the range and the face of every ray."""
        R, origin = T_world_cam[:3, :3].float(), T_world_cam[:3, 3].float()
        count, lanes = groups.length.shape
        tables = self._tables(solids)
        colours, reaches, faces = [], [], []
        step = max(1, CHUNK // lanes)
        for start in range(0, count, step):
            part = slice(start, start + step)
            ray = torch.einsum("ij,jgr->igr", R, groups.ray[:, part])
            reach, met = solids.cast(origin, ray, R @ groups.axis[:, part], groups.angle[part])
            colour, face = self._shade(
                origin, ray.flatten(1), reach.flatten(), met.flatten(), groups.length[part].flatten(), groups.spread[part].flatten(), tables
            )
            colours.append(colour)
            reaches.append(reach)
            faces.append(face.view_as(reach))
        return torch.cat(colours), torch.cat(reaches), torch.cat(faces)

    def _tables(self, solids: Solids) -> tuple[Float[Tensor, "9 P1"], Float[Tensor, "10 Q"]]:
        """Return the columns that shading reads by solid and by face, the sky last."""
        solid = torch.cat(
            [solids.centre.mT, 1 / solids.half.mT, solids.heading.mT, solids.is_round.float()[None] * solids.half[:, 0]]
        )
        faces = self.faces
        face = torch.cat([faces.chart[None], faces.corner, faces.density[None], faces.tint, faces.normal])
        return F.pad(solid, (0, 1)).contiguous(), face.contiguous()

    def _shade(
        self,
        origin: Float[Tensor, "3"],
        ray: Float[Tensor, "3 N"],
        reach: Float[Tensor, "N"],
        met: Int[Tensor, "N"],
        length: Float[Tensor, "N"],
        spread: Float[Tensor, "N"],
        tables: tuple[Float[Tensor, "9 P1"], Float[Tensor, "10 Q"]],
    ) -> tuple[Float[Tensor, "N 3"], Int[Tensor, "N"]]:
        cx, cy, cz, ihx, ihy, ihz, c, s, radius = tables[0].index_select(1, met)
        is_sky = met == tables[0].shape[1] - 1
        any_sky = bool(is_sky.any())
        depth = reach.masked_fill(is_sky, 1.0) if any_sky else reach
        dx, dy, dz = ray
        px, py, pz = origin[0] + depth * dx, origin[1] + depth * dy, origin[2] + depth * dz
        x, y, z = px - cx, py - cy, pz - cz
        x, y = c * x + s * y, c * y - s * x
        ux, uy = c * dx + s * dy, c * dy - s * dx
        near_x, near_y, near_z = (x * ihx).abs(), (y * ihy).abs(), (z * ihz).abs()
        rounds = (radius > 0).nonzero()[:, 0]
        if len(rounds):
            rx, ry = x[rounds], y[rounds]
            radial = torch.hypot(rx, ry)
            # A cylinder unrolled: u along its circumference, x outward
            arc = torch.atan2(ry, rx) * radial
            near_x[rounds] = radial * ihx[rounds]
            near_y[rounds] = 0.0
            cap = near_z[rounds] > near_x[rounds]
            outward = (rx * ux[rounds] + ry * uy[rounds]) / radial
            x[rounds] = torch.where(cap, rx, radial)
            y[rounds] = torch.where(cap, ry, arc)
            ux[rounds] = outward
        on_z = near_z > torch.maximum(near_x, near_y)
        on_x = (near_x >= near_y) & ~on_z
        on_y = ~(on_x | on_z)
        along = torch.where(on_x, x, torch.where(on_z, z, y))
        slope = torch.where(on_x, ux, torch.where(on_z, dz, uy)).abs()
        face = met * 6 + on_y.int() * 2 + on_z.int() * 4 + (along < 0).int()
        chart, u0, v0, density, r, g, b, nx, ny, nz = tables[1].index_select(1, face)
        if len(rounds):
            nx[rounds] = torch.where(cap, 0.0, rx / radial)
            ny[rounds] = torch.where(cap, 0.0, ry / radial)
        u = torch.where(on_x, y, x) * density + u0
        v = torch.where(on_z, y, z) * density + v0
        # The footprint is spread * depth across and 1 / cos(incidence) times that along; between the two, less blur than
        # the longer and less alias than the shorter.
        slant = (slope / length).clamp_min(0.02)
        width = depth * spread * density * slant**-0.75
        light = self._light(px, py, pz, nx, ny, nz)
        if any_sky:
            rise = 1 / (dz + 0.3 * length)
            u = torch.where(is_sky, dx * rise * density + u0, u)
            v = torch.where(is_sky, dy * rise * density + v0, v)
            width = torch.where(is_sky, spread * rise * density, width)
            light = light.masked_fill_(is_sky, 1.0)
        if self.panorama_chart >= 0:
            self._wear_panorama(chart, is_sky, torch.stack([px, py, pz]), ray, depth * spread, u, v, width, light)
        colour = self.atlas.sample(chart, u, v, width)
        colour *= torch.stack([r * light, g * light, b * light], -1)
        return colour.clamp_(0, 1), face

    def _light(self, px: Tensor, py: Tensor, pz: Tensor, nx: Tensor, ny: Tensor, nz: Tensor) -> Float[Tensor, "N"]:
        light = torch.full_like(px, self.ambient)
        for lamp in self.lamps:
            x, y, z = (at - p for at, p in zip(lamp.position, (px, py, pz), strict=True))
            distance2 = x * x + y * y + z * z
            facing = (x * nx + y * ny + z * nz) * distance2.rsqrt()
            light += lamp.strength * (0.35 + 0.65 * facing.clamp_min(0)) / (1 + distance2 / lamp.reach**2)
        return light

    def _wear_panorama(
        self,
        chart: Tensor,
        is_sky: Bool[Tensor, "N"],
        point: Float[Tensor, "3 N"],
        ray: Float[Tensor, "3 N"],
        across: Tensor,
        u: Tensor,
        v: Tensor,
        width: Tensor,
        light: Tensor,
    ) -> None:
        """Put the panorama's texels, in place, on the faces that wear it: the sky by direction, walls from its centre."""
        wears = (chart == self.panorama_chart).nonzero()[:, 0]
        from_centre = point[:, wears] - torch.tensor(self.panorama_centre)[:, None]
        x, y, z = torch.where(is_sky[wears], ray[:, wears], from_centre)
        distance = (x * x + y * y + z * z).sqrt()
        # the panorama's middle looks along the world's x axis
        u[wears] = (0.5 - torch.atan2(y, x) / torch.pi / 2) * WIDTH
        wide = across[wears] / distance * (HEIGHT / torch.pi)
        edge = wide.clamp_min(1.0) * 2  # the poles do not wrap
        row = (0.5 - torch.asin((z / distance).clamp(-1, 1)) / torch.pi) * HEIGHT
        v[wears] = torch.minimum(torch.maximum(row, edge), HEIGHT - edge)
        width[wears] = wide
        light[wears] = 1.0


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
