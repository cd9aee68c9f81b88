"""The direct residual and its Jacobian for any central camera, photometric (C = 1) or feature-metric (C > 1).

    r = I_tgt(project(R r_ref + rho t)) - (e^a I_ref + b)

in the tangent form of mathematics.md, section 3: with the point's ray r2 and inverse range rho2 in the target and the
image gradient as a covector G on that ray, the Jacobian's row by (v, w, a, b) is [rho2 G, r2 x G, -e^a I_ref, -1].
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.cameras import Camera, Intrinsics
from torchvo360.image import Interpolated, interpolate, locate, pad_image

MIN_CONFIDENCE = 0.99
"""Looked-up pixels of less confidence than this touch a masked one."""


@dataclass(frozen=True)
class Reference:
    """Points of the reference frames, ready for warping. Everything here is finite: unknown points weigh 0."""

    ray: Float[Tensor, "B 3 N"]
    """Rays in the reference camera; the batch axis may be 1, shared by all."""
    rho: Float[Tensor, "B N"]
    """Inverse range in the reference camera's measure, 1/m; 0 is at infinity."""
    value: Float[Tensor, "B C N"]
    """Intensities or features."""
    weight: Float[Tensor, "B N"]
    """How much each point counts, for instance its solid angle; 0 where it is not to be used."""
    variance: Float[Tensor, "B N"] | None = None
    """Variance of rho, 1/m^2; None where it is taken as exact."""

    def take(self, index: Tensor | slice) -> "Reference":
        """Return the batch elements of an index or a slice."""
        ray = self.ray if self.ray.shape[0] == 1 else self.ray[index]
        variance = None if self.variance is None else self.variance[index]
        return Reference(ray, self.rho[index], self.value[index], self.weight[index], variance)

    def repeated(self, count: int) -> "Reference":
        """Return one element's points for each of a batch, without copying them."""
        variance = None if self.variance is None else self.variance.expand(count, -1)
        rho, weight = (part.expand(count, -1) for part in (self.rho, self.weight))
        return Reference(self.ray, rho, self.value.expand(count, -1, -1), weight, variance)

    def chunk(self, start: int, stop: int) -> "Reference":
        """Return the points from start to stop of every element."""
        variance = None if self.variance is None else self.variance[:, start:stop]
        return Reference(
            self.ray[..., start:stop],
            self.rho[:, start:stop],
            self.value[..., start:stop],
            self.weight[:, start:stop],
            variance,
        )


@dataclass(frozen=True)
class Target:
    """Target images, padded by one pixel for look-up (`make_target`)."""

    camera: Camera
    padded: Float[Tensor, "B C Hp Wp"]
    confidence: Float[Tensor, "B 1 Hp Wp"] | None = None
    """Weight of each pixel, looked up like the image; None where all count fully."""
    saturation: float | None = None
    """Values at or above this are clipped by the sensor and weigh nothing."""
    intrinsics: Float[Tensor, "B 4"] | None = None
    """(fx, fy, cx, cy) of each image in place of the camera's, in pixels of this level; they carry gradients."""

    def take(self, index: Tensor | slice) -> "Target":
        """Return the batch elements of an index or a slice."""
        confidence = None if self.confidence is None else self.confidence[index]
        intrinsics = None if self.intrinsics is None else self.intrinsics[index]
        return Target(self.camera, self.padded[index], confidence, self.saturation, intrinsics)

    def repeated(self, count: int) -> "Target":
        """Return one image for each of a batch, without copying it."""
        confidence = None if self.confidence is None else self.confidence.expand(count, -1, -1, -1)
        intrinsics = None if self.intrinsics is None else self.intrinsics.expand(count, -1)
        return Target(self.camera, self.padded.expand(count, -1, -1, -1), confidence, self.saturation, intrinsics)


def make_target(
    image: Float[Tensor, "B C H W"],
    camera: Camera,
    confidence: Float[Tensor, "B H W"] | None = None,
    saturation: float | None = None,
    intrinsics: Float[Tensor, "B 4"] | None = None,
) -> Target:
    """Pad target images for look-up; pixels that are not finite must have been replaced, with confidence 0."""
    padded = pad_image(image, camera, 1).contiguous()
    if confidence is not None:
        confidence = pad_image(confidence[:, None], camera, 1).contiguous()
    return Target(camera, padded, confidence, saturation, intrinsics)


def look_up_value(target: Target, ray: Float[Tensor, "3 *points"]) -> Float[Tensor, "*points"]:
    """Return an image's values along rays of its camera; where the camera does not see them, the nearest edge's.

    Args:
        target: One image (batch 1) of one channel.
        ray: Rays in the image's camera.
    """
    x, y, z = (component.reshape(1, -1) for component in ray)
    u, v = target.camera.pixel_of(x, y, z)
    return interpolate(target.padded, locate(u, v, target.camera)).value[0, 0].view(ray.shape[1:])


def look_up_usable(target: Target, ray: Float[Tensor, "3 *points"]) -> Float[Tensor, "*points"]:
    """Return an image's values along rays of its camera; NaN where they are unseen, masked or clipped.

    Args:
        target: One image (batch 1) of one channel.
        ray: Rays in the image's camera.
    """
    return _look_up_usable(target, ray)[0].value[0, 0].view(ray.shape[1:])


def look_up_gradient(
    target: Target, ray: Float[Tensor, "3 *points"]
) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points"]]:
    """Return what `look_up_usable` does, and the squares of the gradients, per pixel of the image's middle.

    Args:
        target: One image (batch 1) of one channel.
        ray: Unit rays in the image's camera.
    """
    (value, g_u, g_v), Y = _look_up_usable(target, ray)
    x, y, z = Y.unsqueeze(1).unbind(2)
    inv_scale = target.camera.scale_of(x, y, z).reciprocal()
    G = target.camera.covector_of((x * inv_scale, y * inv_scale, z * inv_scale), g_u, g_v)
    slope2 = sum((part.square() for part in G), start=torch.zeros_like(g_u)) * target.camera.pixel_angle**2
    return value[0, 0].view(ray.shape[1:]), slope2[0, 0].view(ray.shape[1:])


def _look_up_usable(target: Target, ray: Float[Tensor, "3 *points"]) -> tuple[Interpolated, Float[Tensor, "1 3 N"]]:
    """Interpolate along rays, with NaN where nothing usable is seen, and return the rays as [1, 3, N]."""
    x, y, z = (component.reshape(1, -1) for component in ray)
    camera = target.camera
    u, v = camera.pixel_of(x, y, z)
    taps = locate(u, v, camera)
    found = interpolate(target.padded, taps)
    value = found.value
    if target.confidence is not None:
        unsure = interpolate(target.confidence, taps).value < MIN_CONFIDENCE
        value = value.masked_fill(unsure, torch.nan)
    if target.saturation is not None:
        value = value.masked_fill(value >= target.saturation, torch.nan)
    seen = camera.sees(torch.stack([x, y, z], -1), torch.stack([u, v], -1), margin=0.5)
    if seen is not None:
        value = value.masked_fill(~seen[:, None], torch.nan)
    return found._replace(value=value), torch.stack([x, y, z], 1)


class Samples(NamedTuple):
    """Warped points and what they meet in the target; each tensor is [B, C, N] or broadcasts to it."""

    ray: tuple[Tensor, Tensor, Tensor]
    """Components of the rays in the target camera."""
    rho: Tensor
    """Inverse range in the target."""
    inv_scale: Tensor
    """1 / s of mathematics.md, section 3."""
    G: tuple[Tensor, Tensor, Tensor]
    """Components of the target's gradient as a covector."""
    gained: Tensor
    """e^a I_ref."""
    residual: Tensor
    weight: Tensor
    """The points' weights times the target's confidence; 0 out of view."""


def look_up(
    reference: Reference, target: Target, T_tgt_ref: Float[Tensor, "B 4 4"], affine: Float[Tensor, "B 2"]
) -> Samples:
    """Warp the reference points into the targets and compare.

    Args:
        reference: Points.
        target: Images.
        T_tgt_ref: Poses, in the dtype of the points.
        affine: (a, b) of each pair.
    """
    # Aliases: gradients of the several uses are summed here first, in one order whatever part of a batch this is.
    rho, T_tgt_ref = reference.rho.view_as(reference.rho), T_tgt_ref.view_as(T_tgt_ref)
    k, k_of_channels = broadcast_intrinsics(target.intrinsics)
    R, t = T_tgt_ref[:, :3, :3], T_tgt_ref[:, :3, 3:]
    if T_tgt_ref.requires_grad:
        # The derivative of a matrix product depends on where in memory an element of a batch begins.
        x, y, z = reference.ray[:, None].unbind(2)
        Y = t * rho[:, None] + R[:, :, :1] * x + R[:, :, 1:2] * y + R[:, :, 2:] * z
    else:
        Y = torch.baddbmm(t * rho[:, None], R, reference.ray.expand(R.shape[0], -1, -1))
    camera = target.camera
    weight = reference.weight
    if not camera.wraps:
        seen = camera.sees(Y.mT, torch.stack(camera.pixel_of(Y[:, 0], Y[:, 1], Y[:, 2], k), -1), margin=0.5)
        if seen is not None:
            # Points out of view stand in as one ahead: behind a pinhole their rays would be of any size.
            Y = torch.where(seen[:, None], Y, Y.new_tensor([0.0, 0.0, 1.0])[:, None])
            weight = weight * seen
    x, y, z = Y.unbind(1)
    u, v, inv_scale = camera.pixel_and_inverse_scale_of(x, y, z, k)
    taps = locate(u, v, camera)
    value, g_u, g_v = interpolate(target.padded, taps)
    if target.confidence is not None:
        weight = weight * interpolate(target.confidence, taps).value[:, 0]
    each = weight[:, None]
    if target.saturation is not None:
        each = each * (value < target.saturation)

    rays = Y * inv_scale[:, None]
    ray = (rays[:, :1], rays[:, 1:2], rays[:, 2:])
    gained = affine[:, :1, None].exp() * reference.value
    return Samples(
        ray=ray,
        rho=(rho * inv_scale)[:, None],
        inv_scale=inv_scale[:, None],
        G=camera.covector_of(ray, g_u, g_v, k_of_channels),
        gained=gained,
        residual=value - gained - affine[:, 1:, None],
        weight=each,
    )


def broadcast_intrinsics(intrinsics: Tensor | None) -> tuple[Intrinsics | None, Intrinsics | None]:
    """Return intrinsics as they broadcast with [B, N] and with [B, C, N]."""
    if intrinsics is None:
        return None, None
    fx, fy, cx, cy = intrinsics[:, :, None].unbind(1)
    return (fx, fy, cx, cy), (fx[:, None], fy[:, None], cx[:, None], cy[:, None])


def by_rho(samples: Samples, t_tgt_ref: Float[Tensor, "B 3"]) -> Float[Tensor, "B C N"]:
    """Return the derivative of the residual by the reference's inverse range: G . t / s."""
    tx, ty, tz = t_tgt_ref[..., None, None].unbind(1)
    Gx, Gy, Gz = samples.G
    return (Gx * tx + Gy * ty + Gz * tz) * samples.inv_scale


def by_intrinsics(
    samples: Samples, target: Target, dray_tgt: Float[Tensor, "B 3 4 N"] | None = None
) -> Float[Tensor, "B 4 M"]:
    """Return the derivative of the residual by the intrinsics k = (fx, fy, cx, cy); M = C N.

        dI/dk = (g_u a_u, g_v a_v, g_u, g_v) + G . d(R r1)/dk / s          (mathematics.md, section 3)

    The first part is the target's projection at a fixed point, the second the host's ray, which turns when its pixel
    stays: with one k for both images the two nearly cancel. The inverse range and the host's value are held.

    k is what `Camera` says of it: it stands in for projection and rays, while the wrap stays the camera's. A full
    panorama has fx tied to its width, and only cx, cy and fy are free: by fx the derivative is that of the longitude in
    (-pi, pi] about cx, and jumps by 2 pi g_u where that interval ends. There a host's pixel and its projection may
    also lie on two sides of the jump.

    It is exact where G is. Nearer to a pole than the first row's centre both parts are held back like the rows by pose,
    and they are 0 on the pole.

    Args:
        samples: From `look_up` in this target.
        target: The images, with their camera and intrinsics.
        dray_tgt: Derivatives of the reference rays that `look_up` was given by k, rotated into the target:
            `R_tgt_host @ camera.ray_jacobian_intrinsics(uv_host, k)`, of unit rays `unit_ray_jacobian_intrinsics`.
            None where the rays do not depend on this k.
    """
    camera = target.camera
    _, k_of_channels = broadcast_intrinsics(target.intrinsics)
    g_u, g_v = camera.gradient_of(samples.ray, samples.G, k_of_channels)
    a_u, a_v = camera.normalized_of(*samples.ray)
    rows = torch.stack([g_u * a_u, g_v * a_v, g_u, g_v], 1)
    if dray_tgt is not None:
        for G, moved in zip(samples.G, dray_tgt[..., None, :].unbind(1), strict=True):
            rows = torch.addcmul(rows, (G * samples.inv_scale)[:, None], moved)
    return rows.flatten(2)


def system_rows(samples: Samples, root_weight: Float[Tensor, "B C N"]) -> Float[Tensor, "B 9 M"]:
    """Return the Jacobian's eight columns by (v, w, a, b) and the residual, all times a root of a weight; M = C N."""
    return torch.stack(nine_rows(samples, root_weight), 1).flatten(2)


def nine_rows(
    samples: Samples, root_weight: Float[Tensor, "B C N"], out: tuple[Tensor, ...] | None = None
) -> tuple[Tensor, ...]:
    """Return the rows of `system_rows` as nine tensors [B, C, N]: in `out`, or new ones."""
    to = (None,) * 9 if out is None else out
    rx, ry, rz = samples.ray
    # The last three rows are made last: until then they hold the gradient.
    Gx, Gy, Gz = (torch.mul(part, root_weight, out=row) for part, row in zip(samples.G, to[6:], strict=True))
    motion = (
        torch.mul(samples.rho, Gx, out=to[0]),
        torch.mul(samples.rho, Gy, out=to[1]),
        torch.mul(samples.rho, Gz, out=to[2]),
        torch.addcmul(torch.mul(ry, Gz, out=to[3]), rz, Gy, value=-1, out=to[3]),
        torch.addcmul(torch.mul(rz, Gx, out=to[4]), rx, Gz, value=-1, out=to[4]),
        torch.addcmul(torch.mul(rx, Gy, out=to[5]), ry, Gx, value=-1, out=to[5]),
    )
    minus = torch.neg(root_weight, out=to[7])
    gained = torch.mul(samples.gained, minus, out=to[6])
    return *motion, gained, minus, torch.mul(samples.residual, root_weight, out=to[8])


def weight_slope_rows(
    samples: Samples, factor: Float[Tensor, "B C N"], t_tgt_ref: Float[Tensor, "B 3"]
) -> Float[Tensor, "B 6 M"]:
    """Return `-factor * d(dI/drho) / d(v, w)` with G and s held: what a weight by dI/drho adds to the rows.

    dI/drho = G . t / s, and a step moves t by v + w x t.
    """
    return torch.stack(six_slopes(samples, factor, t_tgt_ref), 1).flatten(2)


def six_slopes(samples: Samples, factor: Float[Tensor, "B C N"], t_tgt_ref: Float[Tensor, "B 3"]) -> tuple[Tensor, ...]:
    """Return the rows of `weight_slope_rows` as six tensors [B, C, N]."""
    tx, ty, tz = t_tgt_ref[..., None, None].unbind(1)
    Gx, Gy, Gz = (component * (samples.inv_scale * -factor) for component in samples.G)
    return Gx, Gy, Gz, ty * Gz - tz * Gy, tz * Gx - tx * Gz, tx * Gy - ty * Gx


def row_sums(samples: Samples, pull: Float[Tensor, "B C N"]) -> Float64[Tensor, "B 8"]:
    """Return the Jacobian's eight columns, each times `pull` and summed over all samples, without building them."""
    rx, ry, rz = samples.ray
    Px, Py, Pz = (component * pull for component in samples.G)
    columns = (
        samples.rho * Px,
        samples.rho * Py,
        samples.rho * Pz,
        ry * Pz - rz * Py,
        rz * Px - rx * Pz,
        rx * Py - ry * Px,
        -samples.gained * pull,
        -pull,
    )
    return torch.stack([column.sum((1, 2), dtype=torch.float64) for column in columns], -1)


def weight_slope_sums(
    samples: Samples, factor: Float[Tensor, "B C N"], t_tgt_ref: Float[Tensor, "B 3"]
) -> Float64[Tensor, "B 6"]:
    """Return the rows of `weight_slope_rows` summed over all samples, without building them."""
    by_v = torch.stack([(G * (samples.inv_scale * -factor)).sum((1, 2), dtype=torch.float64) for G in samples.G], -1)
    return torch.cat([by_v, torch.linalg.cross(t_tgt_ref.double(), by_v)], -1)


def along(samples: Samples, direction: Float[Tensor, "B 8"]) -> Float[Tensor, "B C N"]:
    """Return the residuals' derivative along a direction (v, w, a, b), without building rows."""
    v1, v2, v3, w1, w2, w3, a, b = direction[..., None, None].unbind(1)
    rx, ry, rz = samples.ray
    Gx, Gy, Gz = samples.G
    moved_x = samples.rho * v1 + (w2 * rz - w3 * ry)
    moved_y = samples.rho * v2 + (w3 * rx - w1 * rz)
    moved_z = samples.rho * v3 + (w1 * ry - w2 * rx)
    return Gx * moved_x + Gy * moved_y + Gz * moved_z - samples.gained * a - b


def slope_along(
    samples: Samples, direction: Float[Tensor, "B 8"], t_tgt_ref: Float[Tensor, "B 3"]
) -> Float[Tensor, "B C N"]:
    """Return the derivative of dI/drho along a direction, with G and s held, as `weight_slope_rows` does."""
    moved = direction[:, :3] + torch.linalg.cross(direction[:, 3:6], t_tgt_ref)
    return by_rho(samples, moved)
