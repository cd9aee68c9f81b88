"""Where a network of one's own is plugged in: what it must fulfil, how it is named, and how it is held to its word."""

import importlib
import re
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchvo360.checks import InputError, check_shape

TARGET = "_target_"
"""The key of a specification that names the class; the others are its arguments."""


class NonFiniteError(InputError):
    """A network gave numbers that are not finite; a training skips such a step."""


class FeaturePyramid(NamedTuple):
    """Feature maps and how far to trust each of their pixels, the finest level first."""

    maps: list[Float[Tensor, "B C h w"]]
    confidence: list[Float[Tensor, "B h w"]]
    """At least 0."""


class FeatureExtractor(Protocol):
    """What the class named by `features._target_` must fulfil, besides being an `nn.Module`."""

    def __call__(self, image: Float[Tensor, "B 3 H W"]) -> FeaturePyramid:
        """Return the pyramid of a batch of images in [0, 1]; no level is larger than the one before it.

        Those of a full panorama are full panoramas, twice as wide as high.
        """
        ...


class RangeEstimate(NamedTuple):
    """Inverse range and its variance."""

    rho: Float[Tensor, "B H W"]
    """1/m, above 0."""
    variance: Float[Tensor, "B H W"]
    """1/m^2, above 0."""


class DepthEstimator(Protocol):
    """What the class named by `depth._target_` must fulfil, besides being an `nn.Module`."""

    def __call__(self, image: Float[Tensor, "B 3 H W"]) -> RangeEstimate:
        """Return inverse range and variance of every pixel of a batch of images in [0, 1]."""
        ...


ROLES = {FeatureExtractor: "features", DepthEstimator: "depth"}
"""Under what name a user sets the network that fulfils a protocol."""


def build(spec: Mapping[str, Any], protocol: type) -> nn.Module:
    """Make the network that a specification `{"_target_": "my.module.Net", **arguments}` names.

    To name a class is to run its code: its module is imported and the class is called. So a specification must come
    from the user; that of a checkpoint, which is a file, goes through `load_checkpoint`.

    Args:
        spec: The dotted name of an importable subclass of `nn.Module`, and its arguments.
        protocol: `FeatureExtractor` or `DepthEstimator`.

    Raises:
        InputError: The name cannot be imported, is not that of such a class, or the class refuses the arguments.
    """
    role = ROLES[protocol]
    if not isinstance(spec, Mapping) or TARGET not in spec:
        raise InputError(f"{role}: expected the key {TARGET}, such as {role}.{TARGET}=my.module.Net, got {spec!r}.")
    name = spec[TARGET]
    arguments = {key: value for key, value in spec.items() if key != TARGET}
    return construct(import_network(f"{role}.{TARGET}", name), name, arguments, role)


def import_network(key: str, name: object) -> type[nn.Module]:
    """Import a network's class as `import_name` does; what is none is refused before anything calls it.

    Raises:
        InputError: It is no dotted name, cannot be imported, or names something else.
    """
    found = import_name(key, name)
    if not (isinstance(found, type) and issubclass(found, nn.Module)):
        raise InputError(f"{key}: expected a subclass of torch.nn.Module, got {name}, a {type(found).__name__}.")
    return found


def import_name(key: str, name: object) -> Any:
    """Import what a dotted name `package.module.Class` names; this runs the code of its module.

    Args:
        key: What the name is the value of, for the message.
        name: The name.

    Raises:
        InputError: It is no dotted name, or cannot be imported.
    """
    if not isinstance(name, str) or not re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)+", name):
        raise InputError(f"{key}: expected a dotted name such as my.module.Net, got {name!r}.")
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute)
    except Exception as error:  # a stranger's module may raise anything while it is imported
        hint = "; one of your own must be on PYTHONPATH" if isinstance(error, ModuleNotFoundError) else ""
        raise InputError(f"{key}: expected an importable class, got {name} ({_told(error)}{hint}).") from error


def construct(target: Any, name: str, arguments: Mapping[str, Any], role: str) -> nn.Module:
    """Call a class, or a function, with arguments and hold the result to be a module.

    Raises:
        InputError: It cannot be called so, or makes something else.
    """
    if not callable(target):
        raise InputError(f"{role}.{TARGET}: expected a class, got {name}, a {type(target).__name__}.")
    try:
        module = target(**arguments)
    except InputError as error:
        raise InputError(f"{role}.{error}") from error
    except Exception as error:  # as above: its constructor is not ours
        given = ", ".join(arguments) or "none"
        raise InputError(f"{role}: expected arguments that {name} accepts, got {given} ({_told(error)}).") from error
    if not isinstance(module, nn.Module):
        raise InputError(f"{role}.{TARGET}: expected {name} to make an nn.Module, got {type(module).__name__}.")
    return module


def checked_features(net: nn.Module, image: Float[Tensor, "B 3 H W"]) -> FeaturePyramid:
    """Run a feature network and hold what it returns to `FeatureExtractor`.

    Raises:
        ShapeError: The image is not [B, 3, H, W].
        NonFiniteError: A value is not finite.
        InputError: The network returned something else: one sentence names its class and what is wrong.
    """
    sizes = check_shape("image", image, "B 3 H W")
    who = f"features ({_name(net)})"
    pyramid = net(image)
    if not (
        isinstance(pyramid, tuple) and len(pyramid) == 2 and all(isinstance(part, list | tuple) for part in pyramid)
    ):
        raise InputError(f"{who}: expected a FeaturePyramid (maps, confidence), got {_described(pyramid)}.")
    maps, confidence = pyramid
    if not maps or len(maps) != len(confidence):
        expected = "at least one level, each with its confidence"
        raise InputError(f"{who}: expected {expected}, got {len(maps)} maps and {len(confidence)} confidences.")
    height, width = sizes["H"], sizes["W"]
    for level, (features, weight) in enumerate(zip(maps, confidence, strict=True)):
        _check(f"{who}: maps[{level}]", features, image, (sizes["B"], None, None, None))
        if not (0 < features.shape[2] <= height and 0 < features.shape[3] <= width):
            got = f"{features.shape[2]} x {features.shape[3]}"
            raise InputError(f"{who}: maps[{level}]: expected at most {height} x {width} (finest first), got {got}.")
        height, width = features.shape[2:]
        if sizes["W"] == 2 * sizes["H"] and width != 2 * height:  # aligned with the camera `resized` to the map
            expected = "a panorama's maps twice as wide as high"
            raise InputError(f"{who}: maps[{level}]: expected {expected}, got {height} x {width}.")
        _check(f"{who}: confidence[{level}]", weight, image, (sizes["B"], height, width))
        if not bool((weight >= 0).all()):
            raise InputError(f"{who}: confidence[{level}]: expected values of at least 0, got {weight.min():.4g}.")
    return FeaturePyramid(list(maps), list(confidence))


def checked_ranges(net: nn.Module, image: Float[Tensor, "B 3 H W"]) -> RangeEstimate:
    """Run a depth network and hold what it returns to `DepthEstimator`.

    Raises:
        ShapeError: The image is not [B, 3, H, W].
        NonFiniteError: A value is not finite.
        InputError: The network returned something else: one sentence names its class and what is wrong.
    """
    sizes = check_shape("image", image, "B 3 H W")
    who = f"depth ({_name(net)})"
    estimate = net(image)
    if not (isinstance(estimate, tuple) and len(estimate) == 2):
        raise InputError(f"{who}: expected a RangeEstimate (rho, variance), got {_described(estimate)}.")
    for name, value in zip(("rho", "variance"), estimate, strict=True):
        _check(f"{who}: {name}", value, image, (sizes["B"], sizes["H"], sizes["W"]))
        if not bool((value > 0).all()):
            raise InputError(f"{who}: {name}: expected values above 0, got {value.min():.4g}.")
    return RangeEstimate(*estimate)


def _check(name: str, value: object, image: Tensor, shape: tuple[int | None, ...]) -> None:
    """Hold one output to a shape (None: any size), the image's device and finite numbers."""
    wanted = ", ".join("any" if size is None else str(size) for size in shape)
    if not isinstance(value, Tensor) or not value.is_floating_point():
        raise InputError(f"{name}: expected a floating-point tensor [{wanted}], got {_described(value)}.")
    fits = value.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, value.shape, strict=True))
    if not fits:
        raise InputError(f"{name}: expected shape [{wanted}], got {list(value.shape)}.")
    if value.device != image.device:
        raise InputError(f"{name}: expected the image's device {image.device}, got {value.device}.")
    if bad := int((~torch.isfinite(value)).sum()):
        raise NonFiniteError(f"{name}: expected finite values, got {bad} of {value.numel()} that are not.")


def _name(net: nn.Module) -> str:
    return f"{type(net).__module__}.{type(net).__qualname__}"


def _described(value: object) -> str:
    if isinstance(value, Tensor):
        return f"a tensor {list(value.shape)} of {value.dtype}"
    return f"{type(value).__name__}" + (f" of {len(value)}" if isinstance(value, list | tuple) else "")


def _told(error: Exception) -> str:
    """Return an error as words within a sentence."""
    line = str(error).strip().partition("\n")[0].rstrip(".")
    return f"{type(error).__name__}: {line}" if line else type(error).__name__
