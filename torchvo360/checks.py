"""Bad input is refused here, in one sentence: what it is, what was expected, what came."""

import math
from collections.abc import Sequence
from numbers import Real

import torch
from torch import Tensor


class InputError(ValueError):
    """The caller gave something unusable; the message names it, what was expected and what came."""


class ShapeError(InputError):
    """A tensor has the wrong shape."""


def check_shape(name: str, value: Tensor, pattern: str) -> dict[str, int]:
    """Hold a tensor to a shape pattern such as `"... C H W"` or `"... 3"`.

    Args:
        name: The argument's name, for the message.
        value: The tensor.
        pattern: Axis names and sizes; `...` first stands for any leading axes. A name used twice must have one size.

    Returns:
        The size of every named axis.

    Raises:
        InputError: It is not a tensor at all.
        ShapeError: The tensor does not match.
    """
    if not isinstance(value, Tensor):
        raise InputError(f"{name}: expected a tensor, got {type(value).__name__}.")
    axes = pattern.split()
    any_batch = bool(axes) and axes[0] == "..."
    axes = axes[1:] if any_batch else axes
    sizes: dict[str, int] = {}
    fits = value.ndim >= len(axes) if any_batch else value.ndim == len(axes)
    if fits:
        tail = value.shape[value.ndim - len(axes) :]
        for axis, size in zip(axes, tail, strict=True):
            expected = int(axis) if axis.isdigit() else sizes.setdefault(axis, size)
            fits = fits and expected == size
    if not fits:
        raise ShapeError(f"{name}: expected shape [{pattern}], got {list(value.shape)}.")
    return sizes


def check_floating(name: str, value: Tensor) -> None:
    """Refuse a tensor that is not of a floating type.

    Raises:
        InputError: The tensor holds integers, booleans or complex numbers.
    """
    if not value.is_floating_point():
        raise InputError(f"{name}: expected a floating-point tensor, got {value.dtype}.")


def check_same_device(**tensors: Tensor | None) -> None:
    """Refuse tensors that do not live on one device.

    Raises:
        InputError: Two of them differ.
    """
    devices = {name: value.device for name, value in tensors.items() if value is not None}
    if len(set(devices.values())) > 1:
        listed = ", ".join(f"{name} on {device}" for name, device in devices.items())
        raise InputError(f"device: expected all tensors on one device, got {listed}.")


def check_finite_number(name: str, value: float, *, above: float = -math.inf, at_most: float = math.inf) -> None:
    """Refuse a number that is not finite or not in `(above, at_most]`.

    Raises:
        InputError: It is outside, or no number.
    """
    if not (isinstance(value, Real) and math.isfinite(value) and above < value <= at_most):
        low = "" if above == -math.inf else f" above {above:g}"
        high = "" if at_most == math.inf else f" at most {at_most:g}"
        raise InputError(f"{name}: expected a finite number{low}{high}, got {value!r}.")


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Refuse a word that is not one of the choices.

    Raises:
        InputError: It is another word.
    """
    if value not in choices:
        raise InputError(f"{name}: expected one of {', '.join(choices)}, got {value!r}.")


def is_pose(T: Tensor, *, tolerance: float = 1e-3) -> Tensor:
    """Return which of the matrices [..., 4, 4] are rigid motions: finite, R orthonormal with determinant +1.

    It has no branches and no gradient.
    """
    T = T.detach()
    finite = torch.isfinite(T).flatten(-2).all(-1)
    safe = torch.where(finite[..., None, None], T, 0.0)
    R = safe[..., :3, :3]
    eye = torch.eye(4, dtype=T.dtype, device=T.device)
    orthonormal = ((R @ R.mT - eye[:3, :3]).abs() < tolerance).flatten(-2).all(-1)
    last = ((safe[..., 3, :] - eye[3]).abs() < tolerance).all(-1)
    return finite & orthonormal & (torch.linalg.det(R) > 0) & last


def check_pose(name: str, T: Tensor, *, tolerance: float = 1e-3) -> None:
    """Refuse a tensor that does not hold rigid motions [..., 4, 4].

    Raises:
        ShapeError: The last two axes are not 4 x 4.
        InputError: Integers, not finite, rotation not orthonormal with determinant +1, or last row not 0 0 0 1.
    """
    check_shape(name, T, "... 4 4")
    check_floating(name, T)
    if not bool(is_pose(T, tolerance=tolerance).all()):
        raise InputError(f"{name}: expected rigid motions (orthonormal R, last row 0 0 0 1), got another matrix.")
