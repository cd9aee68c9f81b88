"""Coarse-to-fine direct alignment of image pairs, batched: the layer that models and the odometry share.

A reference image with inverse range is warped into a target image; pose and affine brightness are found by
Levenberg-Marquardt from the coarsest pyramid level to the finest. A pair is called CONVERGED only if its solve
converged on the finest level and the images agree there (`agreement`): a wrong minimum is a failure, and says so.
"""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.agreement import agreeing_share
from torchvo360.backends import linearize
from torchvo360.cameras import Camera
from torchvo360.checks import (
    InputError,
    check_finite_number,
    check_pose,
    check_same_device,
    check_shape,
)
from torchvo360.image import blur, level_camera, masked_pyramid, resample
from torchvo360.residuals.direct import Reference, Target, make_target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import LMConfig, Solution, Status, inverse_ldl, minimize

MAX_TRANSLATION = 1e6
"""Starts farther away than this, m, are no start of anything."""

MAX_RHO = 1e9
"""Inverse ranges above this, 1/m, are no range of anything; their squares would overflow in float32."""


@dataclass(kw_only=True)
class AlignConfig:
    """Settings of `align`."""

    levels: int = 0
    """Pyramid levels; 0 takes as many as `coarsest_width` asks for."""
    coarsest_width: int = 64
    """Least width of a panorama's coarsest level: rotation-only alignment at 64 x 32 pixels converges from 40 deg, at
    128 x 64 from 15 (measured). Other cameras go on to pixels of the same angle, while the level is 16 pixels wide."""
    finest: int = 0
    """Level at which to stop: 0 is the image's own resolution; stopping at half of it is three times less accurate."""
    blur_px: float = 0.5
    """Smoothing of both images before all else; with the exact derivative it gains about a quarter in accuracy."""
    affine: bool = True
    """Whether brightness gain and offset are estimated."""
    saturation: float | None = 252 / 255
    """Single-channel values at or above this are clipped and not used; None for features, which have no white."""
    min_agreement: float = 0.5
    """A solve that converged with less agreement than this ended in a false minimum: DIVERGED."""
    min_pixels: int = 64
    """Fewer usable pixels at a level are too few."""
    noise: float = 4 / 255
    """Standard deviation of an intensity, against which the variance of inverse ranges is weighed."""
    loss: LossConfig = field(default_factory=LossConfig)
    solver: LMConfig = field(default_factory=LMConfig)
    steps_by_level: list[int] = field(default_factory=lambda: [15, 20, 30, 50, 50])
    """Most steps at each level, the finest first; the last entry serves all coarser ones."""

    def __post_init__(self) -> None:
        if self.levels < 0 or self.finest < 0 or (self.levels and self.finest >= self.levels):
            raise InputError(f"levels, finest: expected 0 <= finest < levels, got {self.levels} and {self.finest}.")
        if not self.steps_by_level or min(self.steps_by_level) < 1:
            raise InputError(f"steps_by_level: expected positive numbers of steps, got {self.steps_by_level}.")
        check_finite_number("blur_px", self.blur_px, above=-1e-9)
        check_finite_number("noise", self.noise, above=0)
        check_finite_number("min_agreement", self.min_agreement, above=-1e-9, at_most=1)
        if self.saturation is not None:
            check_finite_number("saturation", self.saturation)
        if self.coarsest_width < 1 or self.min_pixels < 1:
            sizes = f"{self.coarsest_width} and {self.min_pixels}"
            raise InputError(f"coarsest_width, min_pixels: expected at least 1, got {sizes}.")

    def level_count(self, camera: Camera) -> int:
        """Return the number of pyramid levels for a camera.

        Raises:
            InputError: The finest level is not one of them.
        """
        around = min(math.tau / camera.pixel_angle / self.coarsest_width, camera.width / 16)
        count = self.levels or 1 + math.floor(math.log2(max(1.0, around * (1 + 1e-9))))
        if self.finest >= count:
            raise InputError(f"finest: expected a level below {count}, the number of levels, got {self.finest}.")
        return count


@dataclass(frozen=True)
class AlignResult:
    """What `align` found, for each element of the batch."""

    T_tgt_ref: Float[Tensor, "*batch 4 4"]
    """Poses, float64: points of the reference frame into the target's, metres."""
    a: Float[Tensor, "*batch"]
    """Log gain: the target's brightness is e^a times the reference's, plus b."""
    b: Float[Tensor, "*batch"]
    status: Int64[Tensor, "*batch"]
    """`Status` as integers."""
    cost: Float[Tensor, "*batch"]
    """Mean robust cost of a pixel at the end; infinite where there was none."""
    steps: Int64[Tensor, "*batch"]
    """Steps of the solver over all levels."""
    H: Float[Tensor, "*batch 8 8"]
    """J^T W J by (v, w, a, b) at the end, undamped."""
    variance: Float[Tensor, "*batch"]
    """Variance of a residual at the end."""
    agreement: Float[Tensor, "*batch"]
    """Share of the image gradient that is matched to within half a pixel beyond chance, 0 to 1."""

    def covariance(self) -> Float[Tensor, "*batch 8 8"]:
        """Return the covariance of (v, w, a, b) about the solution, `variance * H^-1`; infinite where H is singular.

        It takes the residuals as independent; those of neighbouring pixels are not, so that it is a lower bound.
        """
        inverse, ok = inverse_ldl(self.H)
        scaled = inverse * self.variance[..., None, None]
        return torch.where(ok[..., None, None] & torch.isfinite(scaled), scaled, torch.inf)


@dataclass(frozen=True)
class _Level:
    camera: Camera
    reference: Reference
    target: Target


def _finite(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the image with zeros in place of what is not finite, and where all of its channels are."""
    finite = torch.isfinite(image)
    return torch.where(finite, image, torch.zeros_like(image)), finite.all(1)


def _erode(usable: Bool[Tensor, "B H W"], camera: Camera) -> Bool[Tensor, "B H W"]:
    """Drop the pixels beside unusable ones, whose values interpolation and smoothing would mix in."""
    spoiled = blur((~usable).to(torch.float32), camera, 0.5) > 0
    return ~spoiled


def _levels(
    ref: Tensor, tgt: Tensor, rho: Tensor, usable: Tensor, weight: Tensor | None, camera: Camera, config: AlignConfig
) -> list[_Level]:
    """Build every level's points and target, the finest first."""
    ref, ref_finite = _finite(ref)
    tgt, tgt_finite = _finite(tgt)
    known = (
        (rho >= 0) & (rho <= MAX_RHO) & usable & (ref_finite if bool(ref_finite.all()) else _erode(ref_finite, camera))
    )
    confidence = None if bool(tgt_finite.all()) else _erode(tgt_finite, camera).to(tgt.dtype)
    saturation = config.saturation if ref.shape[1] == 1 else None
    if saturation is not None:
        known = known & (ref[:, 0] < saturation)
    ref, tgt = blur(ref, camera, config.blur_px), blur(tgt, camera, config.blur_px)
    count = config.level_count(camera)
    rho_levels = masked_pyramid(torch.where(known, rho, 0.0), known, camera, count)
    levels: list[_Level] = []
    for level in range(count):
        at = level_camera(camera, level)
        if level:
            ref, tgt = resample(ref, at), resample(tgt, at)
            confidence = None if confidence is None else resample(confidence, at)
            weight = None if weight is None else resample(weight, at)
        level_rho, level_known = rho_levels[level]
        area = at.solid_angle(at.pixel_grid(dtype=ref.dtype, device=ref.device))
        each = level_known * (area / area.mean())
        if weight is not None:
            each = each * weight
        reference = Reference(
            ray=at.ray_grid(dtype=ref.dtype, device=ref.device).permute(2, 0, 1).reshape(1, 3, -1).contiguous(),
            rho=level_rho.flatten(1).contiguous(),
            value=ref.flatten(2).contiguous(),
            weight=each.flatten(1).contiguous(),
        )
        levels.append(_Level(at, reference, make_target(tgt, at, confidence, saturation)))
    return levels


def match_brightness(reference: Reference, target: Target) -> Float[Tensor, "B 2"]:
    """Return (a, b) that give the reference's values the target's mean and spread, over all that is usable.

    It needs no pose: where the same scene fills both images it is close, and exposure jumps of several stops are
    bridged before the first step. The gain is held within a factor of five.
    """
    padded = target.padded[..., 1:-1, 1:-1].double()
    ones = torch.ones_like(padded[:, :1])
    confidence = ones if target.confidence is None else target.confidence[..., 1:-1, 1:-1].double()
    camera = target.camera
    area = camera.solid_angle(camera.pixel_grid(dtype=torch.float64, device=padded.device))

    def moments(value: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        total = weight.sum((1, 2)).clamp_min(1e-12)
        mean = (value.mean(1, keepdim=True) * weight).sum((1, 2)) / total
        spread = (((value.mean(1, keepdim=True) - mean[:, None, None]) ** 2) * weight).sum((1, 2)) / total
        return mean, spread.sqrt()

    mean_tgt, spread_tgt = moments(padded.flatten(2), (confidence * area).flatten(2))
    mean_ref, spread_ref = moments(reference.value.double(), reference.weight.double()[:, None])
    a = ((spread_tgt + 1e-4) / (spread_ref + 1e-4)).log().clamp(-math.log(5), math.log(5))
    return torch.stack([a, mean_tgt - a.exp() * mean_ref], -1)


def solve_level(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    config: AlignConfig,
    *,
    max_steps: int,
    free: Bool[Tensor, "8"] | None = None,
) -> Solution:
    """Align at one resolution from given poses and brightness.

    Args:
        reference: Points.
        target: Images of one pyramid level.
        T_tgt_ref: Starts, float64.
        affine: (a, b) to start from, float64.
        config: Settings; of the solver's, `max_steps` is replaced.
        max_steps: Most steps.
        free: Which of (v, w, a, b) are estimated; all, or all but (a, b), by `config.affine` when it is None.
    """
    B = T_tgt_ref.shape[0]

    def evaluate(state: tuple[Tensor, ...], index: Tensor) -> NormalEquations:
        T, ab = state
        whole = index.numel() == B
        points, images = (reference, target) if whole else (reference.take(index), target.take(index))
        return linearize(points, images, T, ab, config.loss, noise=config.noise)

    def retract(state: tuple[Tensor, ...], delta: Tensor) -> tuple[Tensor, ...]:
        T, ab = state
        return lie.se3_exp(delta[:, :6]) @ T, ab + delta[:, 6:]

    if free is None:
        free = torch.tensor([True] * 6 + [config.affine] * 2, device=T_tgt_ref.device)
    per_radian = 1 / target.camera.pixel_angle
    weight = reference.weight.double()
    mean_rho = (reference.rho.double() * weight).sum(1) / weight.sum(1).clamp_min(1e-12)
    scale = torch.cat(
        [
            (mean_rho * per_radian)[:, None].expand(B, 3),
            mean_rho.new_full((B, 3), per_radian),
            mean_rho.new_full((B, 2), 1.0),
        ],
        -1,
    )
    solver = LMConfig(**{**vars(config.solver), "max_steps": max_steps})
    return minimize(
        evaluate, retract, (T_tgt_ref, affine), solver, step_scale=scale, free=free, min_weight=config.min_pixels
    )


@torch.no_grad()
def align(
    ref: Float[Tensor, "*batch C H W"],
    tgt: Float[Tensor, "*batch C H W"],
    rho: Float[Tensor, "*batch H W"],
    camera: Camera,
    *,
    T_tgt_ref: Float[Tensor, "*batch 4 4"] | None = None,
    mask: Bool[Tensor, "*batch H W"] | None = None,
    weight: Float[Tensor, "*batch H W"] | None = None,
    config: AlignConfig | None = None,
) -> AlignResult:
    """Find the motion and brightness change between pairs of images by direct alignment.

    The results are constants: no gradient flows back to the images.

    Args:
        ref: Reference images, values in [0, 1], or feature maps with C > 1 channels.
        tgt: Target images of the same size.
        rho: Inverse range of the reference's pixels, 1/m; 0 is at infinity; NaN, infinite or negative is unknown.
        camera: The camera of both.
        T_tgt_ref: Where to start; the identity by default.
        mask: Pixels of the reference to use; all by default. Pixels of either image that are not finite are never used.
        weight: Relative weight of each reference pixel, finite and at least 0; only ratios within an image count. Solid
            angle always applies.
        config: Settings.

    Returns:
        Poses, brightness, status and more; an element that failed has its status, and leaves the others untouched.

    Raises:
        ShapeError: The shapes do not fit each other or the camera.
        InputError: A tensor is not float32 or float64, a weight is negative or infinite, a start is not a rigid motion,
            or a panorama's width is odd.
    """
    config = AlignConfig() if config is None else config
    _check_inputs(ref, tgt, rho, camera, T_tgt_ref, mask, weight)
    batch = ref.shape[:-3]
    B = math.prod(batch)
    flat = [value.reshape(B, *value.shape[len(batch) :]) for value in (ref, tgt.to(ref.dtype), rho.to(ref.dtype))]
    usable = torch.ones_like(flat[2], dtype=torch.bool) if mask is None else mask.reshape(flat[2].shape).bool()
    each = None
    if weight is not None:
        each = weight.reshape(flat[2].shape).double()
        each = (each / each.amax((1, 2), keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)).to(ref.dtype)
    levels = _levels(flat[0], flat[1], flat[2], usable, each, camera, config)
    if T_tgt_ref is None:
        T = torch.eye(4, dtype=torch.float64, device=ref.device).repeat(B, 1, 1)
    else:
        T = T_tgt_ref.reshape(B, 4, 4).double()
    affine = match_brightness(levels[-1].reference, levels[-1].target) if config.affine else T.new_zeros(B, 2)
    return _coarse_to_fine(levels, T, affine, config, batch)


def _check_inputs(
    ref: Tensor,
    tgt: Tensor,
    rho: Tensor,
    camera: Camera,
    T_tgt_ref: Tensor | None,
    mask: Tensor | None,
    weight: Tensor | None,
) -> None:
    """Refuse what `align` cannot work with, as its docstring says."""
    check_shape("ref", ref, f"... C {camera.height} {camera.width}")
    batch = ref.shape[:-3]
    for name, value, expected in (
        ("tgt", tgt, ref.shape),
        ("rho", rho, (*batch, *ref.shape[-2:])),
        ("mask", mask, (*batch, *ref.shape[-2:])),
        ("weight", weight, (*batch, *ref.shape[-2:])),
        ("T_tgt_ref", T_tgt_ref, (*batch, 4, 4)),
    ):
        if value is not None:
            check_shape(name, value, " ".join(str(size) for size in expected))
    for name, value in (("ref", ref), ("tgt", tgt), ("rho", rho)):
        if value.dtype not in (torch.float32, torch.float64):
            raise InputError(f"{name}: expected float32 or float64, got {value.dtype}.")
    if ref.shape[-3] < 1:
        raise InputError("ref: expected at least one channel, got none.")
    if camera.wraps and camera.width % 2:
        raise InputError(f"camera: expected an even width for a full panorama, got {camera.width}.")
    check_same_device(ref=ref, tgt=tgt, rho=rho, T_tgt_ref=T_tgt_ref, mask=mask, weight=weight)
    if weight is not None and not bool(((weight >= 0) & torch.isfinite(weight)).all()):
        raise InputError("weight: expected finite numbers of at least 0, got a negative, infinite or NaN one.")
    if T_tgt_ref is not None:
        check_pose("T_tgt_ref", T_tgt_ref)
        if not bool((T_tgt_ref[..., :3, 3].abs() < MAX_TRANSLATION).all()):
            raise InputError(f"T_tgt_ref: expected translations below {MAX_TRANSLATION:g} m, got a longer one.")


def _coarse_to_fine(
    levels: list[_Level], T: Tensor, affine: Tensor, config: AlignConfig, batch: torch.Size
) -> AlignResult:
    steps = torch.zeros(T.shape[0], dtype=torch.int64, device=T.device)
    for number in range(len(levels) - 1, config.finest, -1):
        solution = _solve_numbered(levels, number, T, affine, config)
        T, affine = solution.state
        steps = steps + solution.steps
    solution = _solve_numbered(levels, config.finest, T, affine, config)
    T, affine = solution.state
    equations = solution.equations
    agreed = agreeing_share(levels[config.finest].reference, levels[config.finest].target, T, affine).double()
    agreed = agreed.nan_to_num(nan=0.0)
    false_minimum = (solution.status == Status.CONVERGED) & (agreed < config.min_agreement)
    status = torch.where(false_minimum, int(Status.DIVERGED), solution.status)
    fields = {
        "T_tgt_ref": T,
        "a": affine[:, 0],
        "b": affine[:, 1],
        "status": status,
        "cost": torch.where(equations.weight > 0, equations.cost / equations.weight, torch.inf),
        "steps": steps + solution.steps,
        "H": equations.H,
        "variance": equations.square / (equations.weight - 8).clamp_min(1),
        "agreement": agreed,
    }
    return AlignResult(**{name: value.reshape((*batch, *value.shape[1:])) for name, value in fields.items()})


def _solve_numbered(levels: list[_Level], number: int, T: Tensor, affine: Tensor, config: AlignConfig) -> Solution:
    most = config.steps_by_level[min(number, len(config.steps_by_level) - 1)]
    return solve_level(levels[number].reference, levels[number].target, T, affine, config, max_steps=most)
