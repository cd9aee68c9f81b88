"""The eager kernel's chunk where no derivative is asked: looked up and built into rows in buffers that a thread keeps.

What is written is overwritten as soon as it has been read, so that it is still in the cache, and rows are made where
their product finds them: three quarters of the time of fresh tensors. The cameras', the losses' and the rows' formulas
are the same functions.
"""

import threading
from collections import OrderedDict
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torchvo360.backends.transforms import in_transform
from torchvo360.cameras import Camera
from torchvo360.image import Interpolated, Taps, interpolate
from torchvo360.image.sampling import MAX_EXACT_FLOAT32
from torchvo360.residuals.direct import Reference, Samples, Target, broadcast_intrinsics

ROOMS = 4
"""Sizes of chunks that a thread keeps buffers for, 6 MB for each that is full: the levels of a pyramid."""

ALIGNED = 16
"""Numbers of samples are brought to a multiple of this, by zeros: an element's rows begin at a multiple of 64 bytes
wherever it stands in a batch, as products depend on that."""


class Room(NamedTuple):
    """A thread's buffers, cut for one size of chunks. What they hold means nothing; S is zero behind its rows."""

    Y: Float[Tensor, "B 3 N"]
    points: tuple[Tensor, ...]
    """Three [B, 1, N]."""
    samples: tuple[Tensor, ...]
    """Five [B, C, N]."""
    corner: Int64[Tensor, "B 1 N"]
    taken: Int64[Tensor, "B C N"]
    S: Float[Tensor, "B 9 M"]
    rows: tuple[Tensor, ...]
    """S as nine tensors [B, C, N]."""

    @classmethod
    def of(cls, B: int, C: int, N: int, dtype: torch.dtype) -> "Room":
        """Make room for chunks of B pairs with N points of C channels."""
        with torch.inference_mode(False):  # what is made in inference mode cannot be written to outside of it
            S = torch.zeros(B, 9, C * N + -C * N % ALIGNED, dtype=dtype)
            corner = torch.empty(B, 1, N, dtype=torch.int64)
            return cls(
                Y=torch.empty(B, 3, N, dtype=dtype),
                points=torch.empty(3, B, 1, N, dtype=dtype).unbind(),
                samples=torch.empty(5, B, C, N, dtype=dtype).unbind(),
                corner=corner,
                taken=corner if C == 1 else torch.empty(B, C, N, dtype=torch.int64),
                S=S,
                rows=S[..., : C * N].unflatten(2, (C, N)).unbind(1),
            )


class _Kept(threading.local):
    """The rooms of one thread, the last used last."""

    def __init__(self) -> None:
        self.rooms: OrderedDict[tuple[int, int, int, torch.dtype], Room] = OrderedDict()


_kept = _Kept()


def serves(reference: Reference, target: Target, T_tgt_ref: Tensor, affine: Tensor) -> bool:
    """Return whether buffers may be written to: on the CPU, of one type, where nobody asks for a derivative."""
    if in_transform() or reference.rho.device.type != "cpu":
        return False
    numbers = (reference.ray, reference.rho, reference.weight, reference.variance, target.padded, target.confidence)
    if any(x is not None and x.dtype != reference.value.dtype for x in numbers):
        return False
    inputs = (reference.ray, reference.rho, reference.value, reference.weight, reference.variance, T_tgt_ref, affine)
    images = (target.padded, target.confidence, target.intrinsics)
    return not torch.is_grad_enabled() or not any(x is not None and x.requires_grad for x in (*inputs, *images))


def room_for(reference: Reference) -> Room:
    """Return this thread's buffers for points."""
    B, C, N = reference.value.shape
    key = (B, C, N, reference.value.dtype)
    room = _kept.rooms.pop(key, None)
    if room is None:
        room = Room.of(*key)
        while len(_kept.rooms) >= ROOMS:
            _kept.rooms.popitem(last=False)
    _kept.rooms[key] = room
    return room


def look_up(
    reference: Reference, target: Target, T_tgt_ref: Float[Tensor, "B 4 4"], affine: Float[Tensor, "B 2"], room: Room
) -> Samples:
    """Return what `residuals.direct.look_up` does, in buffers that hold it until they are used again."""
    k, k_of_channels = broadcast_intrinsics(target.intrinsics)
    camera, weight = target.camera, reference.weight
    Y = torch.mul(T_tgt_ref[:, :3, 3:], reference.rho[:, None], out=room.Y)
    Y.baddbmm_(T_tgt_ref[:, :3, :3], reference.ray.expand(Y.shape[0], -1, -1))
    if not camera.wraps:
        seen = camera.sees(Y.mT, torch.stack(camera.pixel_of(Y[:, 0], Y[:, 1], Y[:, 2], k), -1), margin=0.5)
        if seen is not None:
            Y = torch.where(seen[:, None], Y, Y.new_tensor([0.0, 0.0, 1.0])[:, None])
            weight = weight * seen
    x, y, z = Y.unbind(1)
    u, v, inv_scale = camera.pixel_and_inverse_scale_of(x, y, z, k)
    inv_scale = inv_scale[:, None]
    taps = _locate(u, v, camera, room)
    value, g_u, g_v = _interpolate(target.padded, taps, room)
    if target.confidence is not None:
        weight = weight * interpolate(target.confidence, taps).value[:, 0]
    each = weight[:, None]
    if target.saturation is not None:
        each = each * (value < target.saturation)
    rays = Y.mul_(inv_scale)
    ray = (rays[:, :1], rays[:, 1:2], rays[:, 2:])
    gained = torch.mul(affine[:, :1, None].exp(), reference.value, out=room.samples[4])
    return Samples(
        ray=ray,
        rho=torch.mul(reference.rho[:, None], inv_scale, out=room.points[2]),
        inv_scale=inv_scale,
        G=camera.covector_of(ray, g_u, g_v, k_of_channels),
        gained=gained,
        residual=value.sub_(gained).sub_(affine[:, 1:, None]),
        weight=each,
    )


def _locate(u: Float[Tensor, "B N"], v: Float[Tensor, "B N"], camera: Camera, room: Room) -> Taps:
    """Return what `image.locate` does."""
    pitch, rows = camera.width + 2, camera.height + 2
    across, down, left = room.points
    torch.add(u[:, None], 0.5, out=across).clamp_(0.0, camera.width + 0.5)
    torch.add(v[:, None], 0.5, out=down).clamp_(0.0, camera.height + 0.5)
    top = down.floor()
    torch.floor(across, out=left)
    across.sub_(left)
    down.sub_(top)
    if pitch * rows < MAX_EXACT_FLOAT32:
        room.corner.copy_(left.add_(top, alpha=float(pitch)))
    else:
        room.corner.copy_(left).add_(top.long(), alpha=pitch)
    if len(u) > 1:
        room.corner.add_(torch.arange(len(u))[:, None, None] * (pitch * rows))
    return Taps(room.corner[:, 0], across[:, 0], down[:, 0], pitch)


def _interpolate(padded: Float[Tensor, "B C Hp Wp"], taps: Taps, room: Room) -> Interpolated:
    """Return what `image.interpolate` does."""
    B, C, height, _ = padded.shape
    index = room.corner
    if C > 1:
        images = torch.arange(B)[:, None] * (C - 1) + torch.arange(C)
        index = torch.add(index, images[..., None], alpha=height * taps.pitch, out=room.taken)
    index, flat = index.reshape(-1), padded.reshape(-1)
    upper_left, upper_right, lower_left, lower_right = room.samples[:4]
    for shift, corner in zip((0, 1, taps.pitch, taps.pitch + 1), room.samples, strict=False):
        torch.index_select(flat[shift:], 0, index, out=corner.view(-1))
    across, down = taps.across[:, None], taps.down[:, None]
    upper_slope, lower_slope = upper_right.sub_(upper_left), lower_right.sub_(lower_left)
    upper, lower = upper_left.addcmul_(across, upper_slope), lower_left.addcmul_(across, lower_slope)
    g_v = lower.sub_(upper)
    return Interpolated(upper.addcmul_(down, g_v), upper_slope.lerp_(lower_slope, down), g_v)
