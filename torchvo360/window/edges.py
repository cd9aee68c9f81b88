"""Edges in eager torch: every point against every keyframe but its host, one look-up a keyframe.

`R_i^T ray + rho c_i`, a point of host i in the world, knows no target: all points of all hosts are one set of rays for
`look_up`. The world's origin is moved to the newest keyframe, where float32 is most exact.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.residuals.direct import Reference, Samples, Target, by_intrinsics, look_up, system_rows
from torchvo360.residuals.weights import robust
from torchvo360.window.calibration import INTRINSICS, at_intrinsics, unit_ray_slopes, unit_rays
from torchvo360.window.config import WindowConfig
from torchvo360.window.points import WindowPoints
from torchvo360.window.state import PER_FRAME, Estimate
from torchvo360.window.system import columns
from torchvo360.window.thresholds import judge


class KeyframeSums(NamedTuple):
    """What edges say of the keyframes' unknowns."""

    H: Float64[Tensor, "D D"]
    g: Float64[Tensor, "D"]
    cross: Float64[Tensor, "N D"]


class PointSums(NamedTuple):
    """What edges say of the points; each sum is over the images that see the point."""

    curvature: Float[Tensor, "N"]
    slope: Float[Tensor, "N"]
    energy: Float[Tensor, "N"]
    inliers: Float[Tensor, "N"]
    edges: int
    """How many there were."""
    thresholds: list[Float[Tensor, ""]]


class _Warp(NamedTuple):
    """Samples as rays in the window's world, with what it takes to see them from a keyframe; M = N P."""

    T_cam_world: Float64[Tensor, "K 4 4"]
    """The world's axes are those of the newest keyframe."""
    ray: Float[Tensor, "3 M"]
    centre: Float[Tensor, "3 N"]
    """Of the points' hosts."""
    slopes: Float[Tensor, "3 4 M"] | None
    """Derivatives of the rays by the intrinsics, where these are estimated."""


def _warp(
    targets: Sequence[Target],
    points: WindowPoints,
    rho: Tensor,
    T_cam_world: Float64[Tensor, "K 4 4"],
    k: Float64[Tensor, "4"] | None,
) -> _Warp:
    N, P = points.value.shape
    T = T_cam_world @ lie.se3_inverse(T_cam_world[-1])
    T_world_cam = lie.se3_inverse(T).to(rho.dtype)
    centre = T_world_cam[:, :3, 3].T[:, points.host]
    rays, slopes = points.ray, None
    counts = [count * P for count in torch.bincount(points.host, minlength=len(T)).tolist()]
    if k is not None:
        camera = at_intrinsics(targets[0].camera, k)
        rays = unit_rays(camera, points.uv)
        slopes = _turned(T_world_cam, unit_ray_slopes(camera, points.uv).flatten(2), counts)
    ray = _turned(T_world_cam, rays.flatten(1)[:, None], counts)[:, 0]
    ray.view(3, N, P).add_((rho * centre)[..., None])
    return _Warp(T, ray, centre, slopes)


def _turned(T_world_cam: Tensor, vectors: Float[Tensor, "3 C M"], counts: list[int]) -> Float[Tensor, "3 C M"]:
    """Turn vectors in their hosts' cameras into the world: one product for each host."""
    parts = zip(T_world_cam[:, :3, :3], vectors.split(counts, 2), strict=True)
    return torch.cat([(R @ part.flatten(1)).view(part.shape) for R, part in parts], 2)


def _but(part: Tensor, start: int, stop: int) -> Tensor:
    """Return all but one stretch of the last axis: the samples that do not belong to a target itself."""
    return torch.cat([part[..., :start], part[..., stop:]], -1)


def _geometry(T: Float64[Tensor, "4 4"], ray: Tensor, rho: Tensor, samples: Samples, target: Target) -> Samples:
    """Return samples whose Jacobian is taken elsewhere than their residual."""
    T = T.to(rho.dtype)
    Y = torch.addmm(T[:3, 3:] * rho, T[:3, :3], ray)
    inv_scale = target.camera.scale_of(*Y).reciprocal()
    x, y, z = (Y * inv_scale)[:, None, None]
    return samples._replace(ray=(x, y, z), rho=(rho * inv_scale)[None, None], inv_scale=inv_scale[None, None])


def _rows(samples: Samples, root: Tensor, target: Target, R: Tensor, slopes: Tensor | None) -> Float[Tensor, "L+1 m"]:
    """Return the weighted rows of (v, w, a, b) and, where rays have slopes, of the intrinsics; the residual's last."""
    rows = system_rows(samples, root)[0]
    if slopes is None:
        return rows
    by_k = by_intrinsics(samples, target)[0]
    # The host's ray turns, too: G R_j d(ray)/dk, with G turned back instead of all rays forth.
    G = torch.stack([part[0, 0] for part in samples.G]) * samples.inv_scale[0]
    by_k = by_k + ((R.mT @ G)[:, None] * slopes).sum(0)
    return torch.cat([rows[:PER_FRAME], by_k * root[0], rows[PER_FRAME:]])


def sum_edges(
    targets: Sequence[Target],
    points: WindowPoints,
    estimate: Estimate,
    config: WindowConfig,
    *,
    T_first: Float64[Tensor, "K 4 4"] | None,
    k_first: Float64[Tensor, "4"] | None,
    thresholds: Float[Tensor, "K+S"] | None,
    keyframes: bool,
) -> tuple[PointSums, KeyframeSums | None]:
    """Evaluate and linearise all edges, with the arguments of `linearize_window`.

    Args:
        targets: The keyframes' finest levels.
        points: The points.
        estimate: Where to linearise.
        config: Settings.
        T_first: Poses at which Jacobians are taken, where they differ from the estimate's.
        k_first: Intrinsics at which they are taken.
        thresholds: Outlier thresholds of the images.
        keyframes: Whether the sums of the keyframes are asked.
    """
    N, P = points.value.shape
    K, rho, dtype, k = len(targets), estimate.rho, estimate.rho.dtype, estimate.intrinsics
    local = PER_FRAME + (0 if k is None else INTRINSICS)
    warp = _warp(targets, points, rho, estimate.T_cam_world, k)
    first = warp
    if T_first is not None or k_first is not None:
        T_first = estimate.T_cam_world if T_first is None else T_first
        first = _warp(targets, points, rho, T_first, None if k is None else k if k_first is None else k_first)
    if k is not None:
        camera = at_intrinsics(targets[0].camera, k)
        targets = [replace(target, camera=camera) for target in targets]
    a, b = estimate.affine.to(rho.device, dtype).unbind(1)
    value = ((points.value - b[points.host][:, None]) * (-a).exp()[points.host][:, None]).flatten()
    each, weights = rho.repeat_interleave(P), points.weight.flatten()
    own_weight = points.weight.sum(1)

    M = torch.zeros(K, K, local + 1, local + 1, dtype=torch.float64, device=rho.device)
    by_edge = torch.zeros(K, local * keyframes, N, dtype=dtype, device=rho.device)
    curvature, slope, inliers, by_point = (torch.zeros(N, dtype=dtype, device=rho.device) for _ in range(4))
    edges, limits = 0, []
    counts = torch.bincount(points.host, minlength=K).tolist()
    stop = 0
    for j, target in enumerate(targets):
        start, stop = stop, stop + counts[j]
        n = N - counts[j]
        known = None if thresholds is None else thresholds[j]
        if n == 0:
            limits.append(rho.new_zeros(()) if known is None else known)
            continue
        theirs, own = (start * P, stop * P), (start, stop)
        rho_j = _but(each, *theirs)
        reference = Reference(
            ray=_but(warp.ray, *theirs)[None],
            rho=rho_j[None],
            value=_but(value, *theirs)[None, None],
            weight=_but(weights, *theirs)[None],
        )
        T = warp.T_cam_world[j].to(dtype)
        samples = look_up(reference, target, T[None], estimate.affine[j].to(dtype)[None])
        robust_weight, cost = robust(samples.residual, config.loss)
        edge = judge(cost[0, 0].view(n, P), samples.weight[0, 0].view(n, P), _but(own_weight, *own), config, known)
        limits.append(edge.threshold)
        edges += int(edge.seen.sum())

        good = edge.good.to(dtype)
        root = (samples.weight * robust_weight).view(n, P).mul_(good[:, None]).sqrt().view(1, 1, -1)
        t = first.T_cam_world[j].to(dtype)
        if first is not warp:
            samples = _geometry(t, _but(first.ray, *theirs), rho_j, samples, target)
        slopes = None if first.slopes is None else _but(first.slopes, *theirs)
        rows = _rows(samples, root, target, t[:3, :3], slopes) if keyframes else (samples.residual * root)[0]
        towards = torch.addmm(t[:3, 3:], t[:3, :3], _but(first.centre, *own))[..., None]
        Gx, Gy, Gz = (part.view(n, P) for part in samples.G)
        along = torch.addcmul(torch.addcmul(Gx * towards[0], Gy, towards[1]), Gz, towards[2])
        along = along * (samples.inv_scale * root).view(n, P)
        by_rho = (rows.view(-1, n, P) * along).sum(2)
        parts = (
            (by_edge[j], by_rho[:-1]),
            (curvature, along.square().sum(1)),
            (slope, by_rho[-1]),
            (inliers, good),
            (by_point, edge.energy),
        )
        for total, part in parts:
            total[..., :start] += part[..., :start]
            total[..., stop:] += part[..., start:]
        if not keyframes:
            continue
        at = 0
        for i, count in enumerate(counts):
            if i != j and count:
                S = rows[:, at * P : (at + count) * P]
                M[i, j] = (S @ S.T).double()
                at += count

    sums = PointSums(curvature, slope, by_point, inliers, edges, limits)
    if not keyframes:
        return sums, None
    L = columns(estimate, first.T_cam_world)
    H = torch.einsum("ijac,ijab,ijbd->cd", L, M[..., :local, :local], L)
    g = torch.einsum("ijac,ija->c", L, M[..., :local, local])
    cross = torch.cat(
        [part.flatten(0, 1).T.double() @ L[i].flatten(0, 1) for i, part in enumerate(by_edge.split(counts, 2))]
    )
    return sums, KeyframeSums(H, g, cross)
