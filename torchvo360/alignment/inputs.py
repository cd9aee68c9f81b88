"""What `align` is given: checked, flattened to one batch axis, and what of it can be used."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.alignment.level import MAX_TRANSLATION
from torchvo360.backends import use_numba
from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_same_device, check_shape, is_pose

MAX_RHO = 1e9
"""Inverse ranges above this, 1/m, are no range of anything; their squares would overflow in float32."""

EXACT = 1e-12
"""Rotations whose rows are orthonormal to within this stay as they are."""

Maps = Tensor | Sequence[Tensor]
"""Maps of the camera's size, or a pyramid of one's own, the finest first."""


@dataclass(frozen=True)
class Inputs:
    """A batch of pairs along one axis; maps and weights are finite."""

    ref: list[Float[Tensor, "B C h w"]]
    """One map, or the levels of a pyramid; zero where not finite."""
    tgt: list[Float[Tensor, "B C h w"]]
    ref_finite: list[Bool[Tensor, "B h w"] | None]
    """Where they were; None everywhere."""
    tgt_finite: list[Bool[Tensor, "B h w"] | None]
    weight_ref: list[Float[Tensor, "B h w"]] | None
    """Finite, at least 0, scaled (`_normalised`)."""
    weight_tgt: list[Float[Tensor, "B h w"]] | None
    rho: Float[Tensor, "B H W"]
    """As it was given (`ranges`), with `variance` and `mask`."""
    variance: Float[Tensor, "B H W"] | None
    mask: Bool[Tensor, "B H W"] | None
    usable: Bool[Tensor, "B"]
    """Whether a pair has a start and intrinsics that are some."""
    T_tgt_ref: Float64[Tensor, "B 4 4"]
    started: Bool[Tensor, "B"]
    """Whether the start is one."""
    intrinsics: Float64[Tensor, "B 4"] | None
    batch: torch.Size
    is_pyramid: bool
    """Whether the maps are a pyramid of the caller's."""

    def ranges(self) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"] | None, Bool[Tensor, "B H W"]]:
        """Return inverse ranges, their variances, and where they may be used; zero elsewhere."""
        known, variance = (self.rho >= 0) & (self.rho <= MAX_RHO) & self.usable[:, None, None], None
        if self.mask is not None:
            known = known & self.mask
        if self.variance is not None:
            sound = (self.variance >= 0) & (self.variance <= MAX_RHO**2)
            known, variance = known & sound, torch.where(sound, self.variance, 0.0)
        return torch.where(known, self.rho, 0.0), variance, known


def read_inputs(
    ref: Maps,
    tgt: Maps,
    rho: Tensor,
    camera: Camera,
    T_tgt_ref: Tensor | None,
    mask: Tensor | None,
    weight_ref: Maps | None,
    weight_tgt: Maps | None,
    rho_variance: Tensor | None,
    intrinsics: Tensor | None,
) -> Inputs:
    """Check and flatten what `align` takes.

    Raises:
        ShapeError: The shapes do not fit each other or the camera.
        InputError: As `align` says.
    """
    refs, tgts = _as_list(ref), _as_list(tgt)
    refs_weight, tgts_weight = (None if value is None else _as_list(value) for value in (weight_ref, weight_tgt))
    is_pyramid = isinstance(ref, (list, tuple))
    _check(refs, tgts, rho, camera, refs_weight, tgts_weight, is_pyramid=is_pyramid)
    batch = rho.shape[:-2]
    _check_rest(batch, rho, T_tgt_ref, mask, rho_variance, intrinsics)
    lists = {"ref": refs, "tgt": tgts, "weight_ref": refs_weight or [], "weight_tgt": tgts_weight or []}
    maps = {f"{name}[{k}]" if is_pyramid else name: map for name, each in lists.items() for k, map in enumerate(each)}
    others = {"T_tgt_ref": T_tgt_ref, "rho_variance": rho_variance, "intrinsics": intrinsics}
    check_same_device(**maps, rho=rho, mask=mask, **others)
    for name, value in {**maps, "rho": rho, **others}.items():
        if value is not None and value.dtype not in (torch.float32, torch.float64):
            raise InputError(f"{name}: expected float32 or float64, got {value.dtype}.")
    if mask is not None and mask.dtype != torch.bool:
        raise InputError(f"mask: expected bool, got {mask.dtype}.")

    B, dtype = math.prod(batch), refs[0].dtype
    flat_ref, ref_finite = _finite_maps(refs, B, dtype)
    flat_tgt, tgt_finite = _finite_maps(tgts, B, dtype)
    size = (B, *rho.shape[-2:])
    T, started = _starts(T_tgt_ref, B, rho.device)
    k, calibrated = _calibrations(intrinsics, camera, B)
    return Inputs(
        ref=flat_ref,
        tgt=flat_tgt,
        ref_finite=ref_finite,
        tgt_finite=tgt_finite,
        weight_ref=_weights(refs_weight, B, dtype),
        weight_tgt=_weights(tgts_weight, B, dtype),
        rho=rho.reshape(size).to(dtype),
        variance=None if rho_variance is None else rho_variance.reshape(size).to(dtype),
        mask=None if mask is None else mask.reshape(size),
        usable=started if calibrated is None else started & calibrated,
        T_tgt_ref=T,
        started=started,
        intrinsics=k,
        batch=batch,
        is_pyramid=is_pyramid,
    )


def _as_list(maps: Maps) -> list[Tensor]:
    return list(maps) if isinstance(maps, (list, tuple)) else [maps]  # pyright: ignore[reportReturnType]


def _check(
    ref: list[Tensor],
    tgt: list[Tensor],
    rho: Tensor,
    camera: Camera,
    weight_ref: list[Tensor] | None,
    weight_tgt: list[Tensor] | None,
    *,
    is_pyramid: bool,
) -> None:
    """Hold maps and weights to one batch and to their levels' sizes."""
    if not ref:
        raise InputError("ref: expected at least one level, got none.")
    last = (camera.height, camera.width)
    own = "C h w" if is_pyramid else f"C {last[0]} {last[1]}"
    check_shape("ref[0]" if is_pyramid else "ref", ref[0], f"... {own}")
    batch = " ".join(str(size) for size in ref[0].shape[:-3])
    check_shape("rho", rho, f"{batch} {last[0]} {last[1]}")
    for level, image in enumerate(ref):
        name = f"ref[{level}]" if is_pyramid else "ref"
        sizes = check_shape(name, image, f"{batch} {own}")
        size = (sizes["h"], sizes["w"]) if is_pyramid else last
        if sizes["C"] < 1:
            raise InputError(f"{name}: expected at least one channel, got none.")
        if min(size) < 1 or size[0] > last[0] or size[1] > last[1]:
            raise InputError(f"{name}: expected a size of at most {last[0]} x {last[1]}, got {size[0]} x {size[1]}.")
        if camera.wraps and size[1] % 2:
            what = name if is_pyramid else "camera"
            raise InputError(f"{what}: expected an even width for a full panorama, got {size[1]}.")
        last = size
    for name, maps in (("tgt", tgt), ("weight_ref", weight_ref), ("weight_tgt", weight_tgt)):
        if maps is None:
            continue
        if len(maps) != len(ref):
            raise InputError(f"{name}: expected {len(ref)} levels, as ref has, got {len(maps)}.")
        for level, (value, like) in enumerate(zip(maps, ref, strict=True)):
            shape = like.shape if name == "tgt" else (*like.shape[:-3], *like.shape[-2:])
            check_shape(f"{name}[{level}]" if is_pyramid else name, value, " ".join(str(size) for size in shape))


def _check_rest(
    batch: torch.Size,
    rho: Tensor,
    T_tgt_ref: Tensor | None,
    mask: Tensor | None,
    rho_variance: Tensor | None,
    intrinsics: Tensor | None,
) -> None:
    for name, value, shape in (
        ("mask", mask, rho.shape),
        ("rho_variance", rho_variance, rho.shape),
        ("T_tgt_ref", T_tgt_ref, (*batch, 4, 4)),
        ("intrinsics", intrinsics, (*batch, 4)),
    ):
        if value is not None:
            check_shape(name, value, " ".join(str(size) for size in shape))


def _finite_maps(maps: list[Tensor], B: int, dtype: torch.dtype) -> tuple[list[Tensor], list[Tensor | None]]:
    """Return the maps with zeros in place of what is not finite, and where all of their channels are."""
    cleaned: list[tuple[Tensor, Tensor | None]] = []
    for value in maps:
        flat = value.reshape(B, *value.shape[-3:]).to(dtype)
        if use_numba(flat) and bool(torch.isfinite(flat.sum())):  # each summand is finite, too
            cleaned.append((flat, None))
        else:
            finite = torch.isfinite(flat)
            cleaned.append((torch.where(finite, flat, 0.0), finite.all(1)))
    return [clean for clean, _ in cleaned], [finite for _, finite in cleaned]


def _weights(maps: list[Tensor] | None, B: int, dtype: torch.dtype) -> list[Tensor] | None:
    """Return weights whose sum is the number of pixels that they amount to, `(sum w)^2 / sum w^2`: ratios count."""
    return (
        None
        if maps is None
        else [_normalised(value.reshape(B, *value.shape[-2:]).double()).to(dtype) for value in maps]
    )


def _normalised(value: Float64[Tensor, "B h w"]) -> Float64[Tensor, "B h w"]:
    clean = torch.where((value >= 0) & torch.isfinite(value), value, 0.0)
    largest = clean.detach().amax((1, 2), keepdim=True)
    scaled = clean / torch.where(largest > 0, largest, 1.0)  # so that no square overflows; it cancels below
    square = scaled.square().sum((1, 2), keepdim=True)
    return scaled * (scaled.sum((1, 2), keepdim=True) / torch.where(square > 0, square, 1.0))


def _starts(T_tgt_ref: Tensor | None, B: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return starts, with the identity in place of what is none, and which are some."""
    eye = torch.eye(4, dtype=torch.float64, device=device).repeat(B, 1, 1)
    if T_tgt_ref is None:
        return eye, torch.ones(B, dtype=torch.bool, device=device)
    T = T_tgt_ref.reshape(B, 4, 4).double()
    plain = use_numba() and T.device.type == "cpu"
    exact = torch.from_numpy(_are_exact(T.detach().numpy())) if plain else None
    if exact is not None and bool(exact.all()) and not T.requires_grad:
        return T, exact
    started = is_pose(T) & (T[:, :3, 3].abs() < MAX_TRANSLATION).all(-1)
    normal = lie.se3_normalized(torch.where(started[:, None, None], T, eye))
    if exact is None:
        return normal, started
    # The value is the same whether a gradient is asked or not, which is that of the normalised start.
    return normal + torch.where(exact[:, None, None], T - normal, 0.0).detach(), started


def _are_exact(T: Float64[np.ndarray, "B 4 4"]) -> Bool[np.ndarray, "B"]:
    """Return which starts need not be normalised: forty small operations of torch cost half a millisecond."""
    R, last = T[:, :3, :3], np.array([0.0, 0.0, 0.0, 1.0])
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0.0)
        turned = np.linalg.det(R) > 0
    near = (np.abs(T[:, :3, 3]) < MAX_TRANSLATION).all(1)
    return (apart < EXACT) & near & (T[:, 3] == last).all(1) & turned


def _calibrations(intrinsics: Tensor | None, camera: Camera, B: int) -> tuple[Tensor | None, Tensor | None]:
    """Return intrinsics, with the camera's own in place of impossible ones, and which are possible."""
    if intrinsics is None:
        return None, None
    k = intrinsics.reshape(B, 4).double()
    sound = torch.isfinite(k).all(-1) & (k[:, :2] != 0).all(-1)
    own = torch.tensor(camera.intrinsics, dtype=torch.float64, device=k.device)
    return torch.where(sound[:, None], k, own), sound
