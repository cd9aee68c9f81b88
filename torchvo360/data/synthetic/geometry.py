"""Exact ray casting against upright solids inside a shell.

A solid is a rectangle or a disc in plan, extruded between two heights: a ray meets it where the intervals inside its
plan and between its heights overlap. The shell is the box all cameras are in, open above or closed. The world is z up,
metres. All groups of rays meet all solids they might hit at once: a group is a cone, and a solid is looked at only if
its intervals of azimuth and elevation overlap the cone's.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

NEAR = 1e-4
"""Hits nearer than this are the surface the camera is on, metres."""
TINY = 1e-15
"""Added to a ray's components: it changes none but zero, whose slab then is met at +-1e15 instead of at 0 * inf."""


@dataclass(frozen=True)
class Solids:
    """Boxes and upright cylinders, turned about the vertical; row 0 is the shell, seen from inside."""

    centre: Float[Tensor, "P 3"]
    half: Float[Tensor, "P 3"]
    """Half sizes along the solid's own axes; a cylinder has its radius twice."""
    heading: Float[Tensor, "P 2"]
    """Cosine and sine of the angle from the world's x axis to the solid's."""
    is_round: Bool[Tensor, "P"]
    open_above: bool
    """Whether there is sky instead of a ceiling."""

    def moved(self, offset: Float[Tensor, "P 3"]) -> "Solids":
        """Return the solids displaced by `offset`, metres."""
        return Solids(self.centre + offset, self.half, self.heading, self.is_round, self.open_above)

    def cast(
        self,
        origin: Float[Tensor, "3"],
        ray: Float[Tensor, "3 G R"],
        axis: Float[Tensor, "3 G"],
        angle: Float[Tensor, "G"],
    ) -> tuple[Float[Tensor, "G R"], Int[Tensor, "G R"]]:
        """Find what each ray meets first.

        Args:
            origin: Camera centre in the world, inside the shell.
            ray: Rays in the world; their length is the unit of the result.
            axis: Unit axes of the cones that hold each group, in the world.
            angle: Half openings of the cones, radians.

        Returns:
            range: How often the ray fits between the camera and what it meets; inf for the sky.
            solid: Row of what it meets: 0 for the shell, P for the sky.
        """
        inverse = 1 / (ray + TINY)
        reach = self._leave_shell(origin, ray, inverse)
        met = torch.zeros_like(reach, dtype=torch.int32)
        met.masked_fill_(reach.isinf(), len(self.centre))
        group, solid = self._might_hit(origin, axis, angle).nonzero(as_tuple=True)
        is_round = self.is_round[solid]
        for rounds in (False, True):
            chosen = (is_round == rounds).nonzero()[:, 0]
            if len(chosen):
                g, p = group[chosen], solid[chosen]
                hit = self._enter(origin, ray[:, g], inverse[2, g], p, rounds)
                reach_before = reach.index_select(0, g)
                reach.scatter_reduce_(0, g[:, None].expand_as(hit), hit, "amin")
                first = (hit == reach.index_select(0, g)) & (hit < reach_before)
                pair, lane = first.nonzero(as_tuple=True)
                met[g[pair], lane] = p[pair].int()
        return reach, met

    def clearance(self, point: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """Return the distance from points to the nearest surface, metres; negative outside free space."""
        x, y, z = (point[:, None] - self.centre.to(point)).unbind(-1)
        c, s = self.heading.to(point).mT
        half = self.half.to(point)
        sides = torch.stack([c * x + s * y, c * y - s * x], -1).abs() - half[:, :2]
        radial = torch.hypot(x, y) - half[:, 0]
        beside = torch.where(self.is_round, radial, torch.linalg.vector_norm(sides.clamp_min(0), dim=-1)).clamp_min(0)
        within = torch.where(self.is_round, radial, sides.amax(-1))
        over = z.abs() - half[:, 2]
        distance = torch.hypot(beside, over.clamp_min(0)) + torch.maximum(within, over).clamp_max(0)
        walls = [half[0, 0] - x[:, 0].abs(), half[0, 1] - y[:, 0].abs(), half[0, 2] + z[:, 0]]
        if not self.open_above:
            walls.append(half[0, 2] - z[:, 0])
        return torch.stack([*distance[:, 1:].unbind(1), *walls]).amin(0)

    def _leave_shell(
        self, origin: Float[Tensor, "3"], ray: Float[Tensor, "3 G R"], inverse: Float[Tensor, "3 G R"]
    ) -> Float[Tensor, "G R"]:
        leave = ((self.half[0, :, None, None] * inverse).abs()) - (origin - self.centre[0])[:, None, None] * inverse
        if not self.open_above:
            return leave.amin(0)
        sides = torch.minimum(leave[0], leave[1])
        down = torch.where(ray[2] < 0, leave[2], torch.inf)
        over = origin[2] + sides * ray[2] > self.centre[0, 2] + self.half[0, 2]
        return torch.minimum(sides.masked_fill_(over, torch.inf), down)

    def _might_hit(
        self, origin: Float[Tensor, "3"], axis: Float[Tensor, "3 G"], angle: Float[Tensor, "G"]
    ) -> Bool[Tensor, "G P"]:
        to_solid = self.centre - origin
        distance = torch.linalg.vector_norm(to_solid[:, :2], dim=-1)
        radius = torch.where(self.is_round, self.half[:, 0], torch.linalg.vector_norm(self.half[:, :2], dim=-1))
        azimuth = torch.atan2(to_solid[:, 1], to_solid[:, 0])
        azimuth_half = torch.where(distance > radius, torch.asin((radius / distance).clamp_max(1.0)), math.pi)
        nearest, farthest = (distance - radius).clamp_min(0), distance + radius
        bottom, top = to_solid[:, 2] - self.half[:, 2], to_solid[:, 2] + self.half[:, 2]
        highest = torch.atan2(top, torch.where(top > 0, nearest, farthest))
        lowest = torch.atan2(bottom, torch.where(bottom < 0, nearest, farthest))
        elevation = torch.asin(axis[2].clamp(-1, 1))
        over_pole = elevation.abs() + angle >= math.pi / 2 - 1e-3
        slack = torch.asin((angle.sin() / elevation.cos().clamp_min(1e-6)).clamp_max(1.0))
        slack = torch.where(over_pole, math.pi, slack)
        apart = (torch.atan2(axis[1], axis[0])[:, None] - azimuth).abs()
        apart = torch.minimum(apart, math.tau - apart)
        may = apart <= slack[:, None] + azimuth_half + 1e-3
        may &= (elevation + angle)[:, None] >= lowest - 1e-3
        may &= (elevation - angle)[:, None] <= highest + 1e-3
        may[:, 0] = False  # the shell is met by every ray
        return may

    def _enter(
        self,
        origin: Float[Tensor, "3"],
        ray: Float[Tensor, "3 K R"],
        inverse_z: Float[Tensor, "K R"],
        solid: Int[Tensor, "K"],
        rounds: bool,
    ) -> Float[Tensor, "K R"]:
        """Return where rays enter solids, inf where they do not."""
        x, y, z = (origin - self.centre[solid]).mT[..., None]
        half_x, half_y, half_z = self.half[solid].mT[..., None]
        c, s = self.heading[solid].mT[..., None]
        middle, extent = -z * inverse_z, (half_z * inverse_z).abs()
        enter, leave = middle - extent, middle + extent
        dx, dy = c * ray[0] + s * ray[1] + TINY, c * ray[1] - s * ray[0] + TINY
        x, y = c * x + s * y, c * y - s * x
        if rounds:
            # |o + t d| = r in plan; the discriminant as a r^2 - (o x d)^2 keeps its digits far away
            a = dx * dx + dy * dy
            b = x * dx + y * dy
            cross = x * dy - y * dx
            root = (a * (half_x * half_x) - cross * cross).sqrt()  # NaN for a miss, and every comparison below is False
            enter = torch.maximum(enter, (-b - root) / a)
            leave = torch.minimum(leave, (root - b) / a)
        else:
            for o, d, h in ((x, dx, half_x), (y, dy, half_y)):
                inverse = 1 / d
                middle, extent = -o * inverse, (h * inverse).abs()
                enter = torch.maximum(enter, middle - extent)
                leave = torch.minimum(leave, middle + extent)
        hit = (enter < leave) & (enter > NEAR)
        return torch.where(hit, enter, torch.inf)
