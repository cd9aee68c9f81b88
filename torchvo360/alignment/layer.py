"""Coarse-to-fine direct alignment of image pairs, batched and differentiable: the layer that models embed.

A reference image with inverse range is warped into a target image; pose and affine brightness are found by
Levenberg-Marquardt from the coarsest pyramid level to the finest. A pair is called CONVERGED only if its solve
converged on the finest level and the images agree there (`agreement`): a wrong minimum is a failure, and says so.
The forward pass keeps no graph; gradients are attached to its result in the way that `AlignConfig.backward` names.
"""

from collections.abc import Collection
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchvo360.agreement import agreeing_share
from torchvo360.alignment import compiled_pyramid, pyramid
from torchvo360.alignment.backward import attach_solution, attach_steps, has_gradient
from torchvo360.alignment.brightness import match_brightness
from torchvo360.alignment.config import BACKWARD, AlignConfig
from torchvo360.alignment.inputs import Inputs, Maps, read_inputs
from torchvo360.alignment.level import free_parameters, solve_level
from torchvo360.alignment.pyramid import Level
from torchvo360.alignment.result import AlignMaps, AlignResult, LevelHistory
from torchvo360.backends import linearize
from torchvo360.cameras import Camera
from torchvo360.checks import InputError, check_choice
from torchvo360.residuals.direct import look_up
from torchvo360.residuals.weights import weigh
from torchvo360.solve import Solution, State, Status, choose, inverse_ldl

OUTPUTS = ("history", "maps", "information")


def align(
    ref: Maps,
    tgt: Maps,
    rho: Float[Tensor, "*batch H W"],
    camera: Camera,
    *,
    T_tgt_ref: Float[Tensor, "*batch 4 4"] | None = None,
    mask: Bool[Tensor, "*batch H W"] | None = None,
    weight_ref: Maps | None = None,
    weight_tgt: Maps | None = None,
    rho_variance: Float[Tensor, "*batch H W"] | None = None,
    intrinsics: Float[Tensor, "*batch 4"] | None = None,
    config: AlignConfig | None = None,
    outputs: Collection[str] = (),
) -> AlignResult:
    """Find the motion and brightness change between pairs of images by direct alignment.

    Gradients of poses and brightness reach `ref`, `tgt`, both weights, `rho`, `rho_variance` and `intrinsics`, and the
    start where all steps are unrolled. What cannot be used is left out pixel by pixel: images, ranges and variances
    that are not finite, weights that are negative or not finite.

    Args:
        ref: Reference images [*batch, C, H, W], values in [0, 1], or feature maps with C > 1 channels; or a pyramid of
            one's own: a list of maps [*batch, C, h, w], the finest first, which is neither smoothed nor tested for
            clipped values. C may differ from level to level.
        tgt: Target images or pyramids of the same sizes.
        rho: Inverse range of the reference's pixels, 1/m, at the camera's size; 0 is at infinity; NaN, infinite or
            negative is unknown.
        camera: The camera of both.
        T_tgt_ref: Where to start; the identity by default.
        mask: Pixels of the reference to use; all by default.
        weight_ref: Relative weight of each reference pixel, at least 0; only ratios within an image count. For a
            pyramid of one's own a list of maps [*batch, h, w]. Solid angle always applies.
        weight_tgt: The same for the target's pixels, looked up where the reference's come to lie.
        rho_variance: Variance of `rho`, 1/m^2; pixels count less the more it moves their residuals.
        intrinsics: (fx, fy, cx, cy) of each pair in place of the camera's own, in pixels of the camera's size.
        config: Settings.
        outputs: What else is wanted: any of "history", "maps" and "information" (H, variance and cost at the very
            solution, with gradients).

    Returns:
        Poses, brightness, status and more; an element that failed has its status, and leaves the others untouched.

    Raises:
        ShapeError: The shapes do not fit each other or the camera.
        InputError: A tensor is not float32 or float64, lies on another device, a panorama's width is odd, or an output
            is none of ours.
    """
    config = AlignConfig() if config is None else config
    check_choice("backward", config.backward, BACKWARD)
    outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    for name in outputs:
        check_choice("outputs", name, OUTPUTS)
    inputs = read_inputs(ref, tgt, rho, camera, T_tgt_ref, mask, weight_ref, weight_tgt, rho_variance, intrinsics)
    # Half precision is for networks: sums of a hundred thousand products lose all digits in it.
    device = inputs.rho.device.type
    followed = torch.is_grad_enabled() and config.backward != "none"
    with torch.set_grad_enabled(followed), torch.autocast(device, enabled=False):
        compiled = compiled_pyramid.serves(inputs, camera, config)
        levels = (compiled_pyramid if compiled else pyramid).build_levels(inputs, camera, config)
        return _coarse_to_fine(levels, inputs, config, outputs)


class Align(nn.Module):
    """`align` as a module: one camera and one set of settings for all calls; it has no parameters."""

    def __init__(self, camera: Camera, config: AlignConfig | None = None) -> None:
        """Keep the camera of all images and the settings of all alignments."""
        super().__init__()
        for name, value, kind in (("camera", camera, Camera), ("config", config, AlignConfig | None)):
            if not isinstance(value, kind):
                raise InputError(f"{name}: expected {getattr(kind, '__name__', 'AlignConfig')}, got {value!r}.")
        self.camera = camera
        self.config = AlignConfig() if config is None else config

    def forward(self, ref: Maps, tgt: Maps, rho: Float[Tensor, "*batch H W"], **options: Any) -> AlignResult:
        """Return `align` of the arguments; `options` are its keyword arguments but for `config`."""
        return align(ref, tgt, rho, self.camera, config=self.config, **options)

    def extra_repr(self) -> str:
        return f"{self.camera}, backward={self.config.backward}"


def _coarse_to_fine(levels: list[Level], inputs: Inputs, config: AlignConfig, outputs: Collection[str]) -> AlignResult:
    finest = 0 if inputs.is_pyramid else config.finest
    free = free_parameters(config, inputs.rho.device)
    brightness = inputs.T_tgt_ref.new_zeros(len(inputs.T_tgt_ref), 2)
    if config.affine:
        brightness = match_brightness(levels[-1].reference, levels[-1].target, inputs.T_tgt_ref)
    state: State = (inputs.T_tgt_ref, brightness)
    followed = torch.is_grad_enabled() and has_gradient(levels[finest], state, config)
    traced = "history" in outputs
    steps = torch.zeros(len(inputs.T_tgt_ref), dtype=torch.int64, device=inputs.rho.device)
    history: list[LevelHistory] = []
    unrolled = followed and config.backward == "unroll"
    for number in range(len(levels) - 1, finest, -1):
        # The first level keeps the brightness that the images as wholes show: free from the start, it takes the place
        # of a large motion.
        first = number == len(levels) - 1
        moving = free_parameters(config, inputs.rho.device, motion_only=first)
        solution, state = _solve(levels[number], number, state, config, moving, unrolled=unrolled, traced=traced)
        steps = steps + solution.steps
        if traced:
            history.append(_history(solution, state[0], inputs.batch))
    unrolled = unrolled or (followed and config.backward == "truncated")
    solution, state = _solve(levels[finest], finest, state, config, free, unrolled=unrolled, traced=traced)
    if traced:
        history.append(_history(solution, state[0], inputs.batch))
    status, agreed = _judged(levels[finest], solution, inputs, config)
    if config.backward == "implicit":
        solved = (status == int(Status.CONVERGED)) & _invertible(solution.equations.H, free)
        if followed:
            state = attach_solution(levels[finest], solution.state, solved, config, free)
    else:
        solved = inputs.started & (status != int(Status.TOO_FEW_PIXELS))
        if followed:
            state = choose(solved, state, tuple(part.detach() for part in state))
    T, affine = state
    equations = solution.equations
    if "information" in outputs:
        level = levels[finest]
        equations = linearize(level.reference, level.target, T, affine, config.loss, noise=config.noise)
    some = equations.weight > 0
    fields = {
        "T_tgt_ref": T,
        "a": affine[:, 0],
        "b": affine[:, 1],
        "status": status,
        "cost": torch.where(some, equations.cost / torch.where(some, equations.weight, 1.0), torch.inf),
        "steps": steps + solution.steps,
        "H": equations.H,
        "variance": equations.square / (equations.weight - 8).clamp_min(1),
        "agreement": agreed,
        "differentiable": solved if followed else torch.zeros_like(solved),
        "estimated": free.expand(len(status), 8),
    }
    return AlignResult(
        **{name: value.reshape((*inputs.batch, *value.shape[1:])) for name, value in fields.items()},
        history=history if traced else None,
        maps=_maps(levels[finest], T, affine, config, inputs.batch) if "maps" in outputs else None,
    )


def _solve(
    level: Level, number: int, state: State, config: AlignConfig, free: Tensor, *, unrolled: bool, traced: bool
) -> tuple[Solution, State]:
    """Return the solve of one level, and its state: with the gradients of its steps where they are unrolled."""
    T, affine = (part.detach() for part in state)
    with torch.no_grad():
        solution = solve_level(
            level.reference,
            level.target,
            T,
            affine,
            config,
            max_steps=config.most_steps(number),
            free=free,
            traced=traced or unrolled,
        )
    if not unrolled:
        return solution, solution.state
    last = config.backward_steps if config.backward == "truncated" else None
    return solution, attach_steps(level, state, solution, config, free, last=last)


def _invertible(H: Tensor, free: Tensor) -> Tensor:
    """Return which undamped H can be inverted, over what is estimated."""
    eye = torch.eye(len(free), dtype=H.dtype, device=H.device)
    return inverse_ldl(torch.where(free[:, None] & free, H, eye))[1]


@torch.no_grad()
def _judged(level: Level, solution: Solution, inputs: Inputs, config: AlignConfig) -> tuple[Tensor, Tensor]:
    """Return the final status of every element, and how well its images agree."""
    T, affine = solution.state
    agreed = agreeing_share(level.reference, level.target, T, affine).double().nan_to_num(nan=0.0)
    false_minimum = (solution.status == int(Status.CONVERGED)) & (agreed < config.min_agreement)
    status = torch.where(false_minimum, int(Status.DIVERGED), solution.status)
    return torch.where(inputs.started, status, int(Status.BAD_START)), agreed


def _history(solution: Solution, T: Tensor, batch: torch.Size) -> LevelHistory:
    assert solution.trace is not None
    rows = (row.mT.reshape(*batch, row.shape[0]) for row in solution.trace[1:])
    return LevelHistory(T.reshape(*batch, 4, 4), solution.status.reshape(batch), *rows)


def _maps(level: Level, T: Tensor, affine: Tensor, config: AlignConfig, batch: torch.Size) -> AlignMaps:
    reference, camera = level.reference, level.target.camera
    T, affine = T.to(reference.value.dtype), affine.to(reference.value.dtype)
    samples = look_up(reference, level.target, T, affine)
    weighed = weigh(samples, reference, T[:, :3, 3], config.loss, config.noise)
    seen = (samples.weight > 0).all(1, keepdim=True)

    def image(value: Tensor) -> Tensor:
        return value.reshape(*batch, value.shape[1], camera.height, camera.width)

    return AlignMaps(
        residual=image(torch.where(seen, samples.residual, 0.0)),
        weight=image(samples.weight * weighed.weight),
        visible=image(seen)[..., 0, :, :],
        warped=image(torch.where(seen, samples.residual + samples.gained + affine[:, 1:, None], 0.0)),
    )
