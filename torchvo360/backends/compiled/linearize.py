"""`linearize` as what `torch.compile` makes of the eager formulas: one pass with 47 sums, for images of every size.

Sizes are symbols in what is compiled, so that it is compiled twice at most: for one pair and for several. Another kind
of problem (the camera's model, the loss, one channel or several, a variance or none) is compiled for itself.
"""

import functools
import math
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from torchvo360.backends.numba.linearize import UPPER
from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.residuals.direct import Reference, Target, look_up, nine_rows, six_slopes
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig, weigh

NO_COMPILER = "backend: expected a C++ compiler (g++, or what the variable CXX names) for compiled, got none."

FEW_POINTS = 4096
"""Up to here torch.compile divides sums otherwise, and compiles once more; there calls cost more than what they do."""


@functools.cache
def has_compiler() -> bool:
    """Return whether the C++ compiler that `torch.compile` calls is there."""
    return shutil.which(os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++")) is not None


def serves(reference: Reference, target: Target, T_tgt_ref: Tensor, affine: Tensor) -> bool:
    """Return whether `linearize` takes these: many points, a known camera, float32 on the CPU, and no gradient."""
    inputs = (reference.ray, reference.rho, reference.value, reference.weight, reference.variance)
    images = (target.padded, target.confidence, target.intrinsics)
    tensors = [value for value in (*inputs, *images) if value is not None]
    if torch.is_grad_enabled() and any(value.requires_grad for value in (*tensors, T_tgt_ref, affine)):
        return False
    if reference.rho.shape[1] <= FEW_POINTS:
        return False
    camera = target.camera
    known = type(camera) is Pinhole or (
        type(camera) is Equirectangular
        and target.intrinsics is None
        and camera.wraps
        and camera.intrinsics[2] == camera.width / 2
    )
    return known and all(value.dtype == torch.float32 and value.device.type == "cpu" for value in tensors)


def linearize(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    loss: LossConfig,
    *,
    noise: float = 4 / 255,
) -> NormalEquations:
    """Linearise as `backends.eager.linearize` does, in what `torch.compile` made of it.

    Raises:
        InputError: There is no C++ compiler, or the arguments are not what `serves` says.
    """
    if not has_compiler():
        raise InputError(NO_COMPILER)
    if not serves(reference, target, T_tgt_ref, affine):
        raise InputError(
            f"linearize: expected more than {FEW_POINTS} points of a full panorama or a pinhole, float32 on the CPU "
            "without gradients, for torch.compile, got others."
        )
    camera = target.camera
    _, fy, _, _ = camera.intrinsics
    intrinsics, least = target.intrinsics, torch.tensor(math.sin(0.5 / fy) ** 2)
    if intrinsics is None and isinstance(camera, Pinhole):
        intrinsics = torch.tensor([camera.intrinsics]).expand(len(T_tgt_ref), -1).contiguous()
    with torch.no_grad():
        sums = _compiled()(
            reference,
            target.padded,
            target.confidence,
            target.saturation,
            intrinsics,
            least if camera.wraps else None,
            T_tgt_ref.float(),
            affine.float(),
            loss,
            noise,
        ).double()
    M = sums[:, torch.from_numpy(UPPER)]
    cost, weight = sums[:, 45:].unbind(1)
    return NormalEquations(M[:, :8, :8], M[:, :8, 8], cost, weight, M[:, 8, 8])


@dataclass(frozen=True)
class _Panorama(Equirectangular):
    """A full panorama whose size may be a symbol."""

    least: Tensor | None = None
    """`_least_horizontal2`, whose sine is no operation on symbols."""

    def __post_init__(self) -> None:
        """Take symbols; the camera that they are of has been checked."""

    @property
    def _least_horizontal2(self) -> Tensor:
        assert self.least is not None
        return self.least


@dataclass(frozen=True)
class _Plane(Pinhole):
    """A pinhole whose size may be a symbol; its intrinsics are given with each call."""

    def __post_init__(self) -> None:
        """Take symbols; the camera that they are of has been checked."""


@functools.cache
def _compiled() -> Callable[..., Tensor]:
    # Indices are held inside by `locate`; checking each again keeps look-ups from being vectorised.
    return torch.compile(_sums, dynamic=True, options={"assert_indirect_indexing": False})


def _sums(
    reference: Reference,
    padded: Float32[Tensor, "B C Hp Wp"],
    confidence: Float32[Tensor, "B 1 Hp Wp"] | None,
    saturation: float | None,
    intrinsics: Float32[Tensor, "B 4"] | None,
    least_horizontal2: Float32[Tensor, ""] | None,
    T_tgt_ref: Float32[Tensor, "B 4 4"],
    affine: Float32[Tensor, "B 2"],
    loss: LossConfig,
    noise: float,
) -> Float32[Tensor, "B 47"]:
    """Return the upper triangle of `S W S^T` by rows, the cost and the weight."""
    height, width = padded.shape[-2] - 2, padded.shape[-1] - 2
    camera: Camera = (
        _Plane(width, height, 1.0, 1.0, 0.0, 0.0)
        if least_horizontal2 is None
        else _Panorama(width, height, full=True, least=least_horizontal2)
    )
    samples = look_up(reference, Target(camera, padded, confidence, saturation, intrinsics), T_tgt_ref, affine)
    weighed = weigh(samples, reference, T_tgt_ref[:, :3, 3], loss, noise)
    root = (samples.weight * weighed.weight).sqrt()
    rows = list(nine_rows(samples, root))
    if weighed.slope is not None:
        slopes = six_slopes(samples, weighed.slope * samples.residual * root, T_tgt_ref[:, :3, 3])
        rows[:6] = [row + slope for row, slope in zip(rows, slopes, strict=False)]
    products = [rows[p] * rows[q] for p in range(9) for q in range(p, 9)]
    each = samples.weight.expand_as(samples.residual)
    return torch.stack([part.sum((1, 2)) for part in (*products, samples.weight * weighed.cost, each)], 1)
