"""Networks as files: the tensors in NAME.safetensors, what makes the network again in NAME.json beside it.

Both may come from a stranger, so neither can run code: nothing is unpickled, and the json may name no class but those
of `torchvo360.learn`. Any other class is named by the caller.
"""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchvo360.checks import InputError
from torchvo360.files import write_atomically
from torchvo360.learn.plugin import TARGET, construct, import_name, import_network

NOTES = ("made_by", "figures")
"""Keys of the json that tell how the network came about: the command, and what it reached; not arguments."""

FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
"""Kinds of numbers that may stand for each other; smaller ones are not computed with."""

HOME = "torchvo360.learn."

SHIPPED_FEATURES, SHIPPED_DEPTH = (Path(__file__).parent / "checkpoints" / name for name in ("features", "depth"))
"""The checkpoints that come with the package; the json beside each names the command that made it."""


def save_checkpoint(path: str | Path, module: nn.Module, config: Mapping[str, Any]) -> None:
    """Write a network to `path`.safetensors and `path`.json; each appears only when it is complete.

    Args:
        path: With or without the suffix .safetensors.
        module: The network.
        config: `_target_`, the dotted name of its class, the arguments that make it again, and the notes `made_by` and
            `figures` where there are some. Numbers that are not finite become null.

    Raises:
        InputError: `config` names no class or holds what JSON cannot, or the files cannot be written.
    """
    if not isinstance(config.get(TARGET), str):
        raise InputError(f"config: expected {TARGET}, the name of the network's class, got {config.get(TARGET)!r}.")
    weights, beside = _paths(path)
    try:
        text = json.dumps(_finite(dict(config)), indent=2, allow_nan=False) + "\n"
    except (TypeError, ValueError) as error:
        raise InputError(f"config: expected what JSON holds, got a value it refuses ({error}).") from None
    write_atomically(weights, tensors_to_bytes(module.state_dict()))
    write_atomically(beside, text)


def load_checkpoint(path: str | Path, target: str | Callable[..., nn.Module] | None = None) -> nn.Module:
    """Return the network of a checkpoint, in evaluation mode and on the CPU.

    Args:
        path: Of the .safetensors, with or without its suffix; the .json lies beside it.
        target: The class to make (or a function that makes the network), or the dotted name of the class, where it is
            not one of `torchvo360.learn`: a checkpoint is not trusted to name others, as that would run their code.
            It is called with the arguments of the json.

    Raises:
        InputError: A file is missing or damaged, the class is not allowed or refuses its arguments, or the tensors do
            not fit it or are not finite.
    """
    weights, _ = _paths(path)
    config = read_config(path)
    arguments = {key: value for key, value in config.items() if key not in (TARGET, *NOTES)}
    name = config[TARGET] if target is None else target if isinstance(target, str) else _called(target)
    if target is None:
        target = _own_class(name, weights)
    elif isinstance(target, str):
        target = import_network("target", target)
    module = construct(target, name, arguments, "checkpoint")
    load_tensors(module, read_tensors(weights)[0], str(weights))
    return module.eval()


def read_config(path: str | Path) -> dict[str, Any]:
    """Return the json of a checkpoint: `_target_`, arguments and notes.

    Raises:
        InputError: It is missing, is no JSON, or names no class.
    """
    _, beside = _paths(path)
    try:
        config = json.loads(beside.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"checkpoint: expected a readable file {beside}, got: {error.strerror}.") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"checkpoint: expected JSON in {beside}, got: {error}.") from None
    if not isinstance(config, dict) or not isinstance(config.get(TARGET), str):
        raise InputError(f"checkpoint: expected {beside} to name a class by {TARGET}, got none.")
    return config


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors of a safetensors file and its metadata.

    Raises:
        InputError: The file is missing or damaged, or safetensors is not installed.
    """
    safetensors = _safetensors()
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"checkpoint: expected a readable file {path}, got: {reason}.") from None
    except safetensors.SafetensorError as error:
        raise InputError(f"checkpoint: expected a whole safetensors file in {path}, got: {error}.") from None


def tensors_to_bytes(tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> bytes:
    """Return tensors as the content of a safetensors file; tensors that share memory are written out each."""
    _safetensors()
    from safetensors.torch import save

    return save({name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}, metadata)


def load_tensors(module: nn.Module, tensors: Mapping[str, Tensor], source: str) -> None:
    """Copy tensors into a module, every one and no other.

    Raises:
        InputError: They do not fit, as `check_tensors` says; then the module is as it was.
    """
    check_tensors(module, tensors, source)
    module.load_state_dict(dict(tensors))


def check_tensors(module: nn.Module, tensors: Mapping[str, Tensor], source: str) -> None:
    """Hold tensors to be those of a module.

    Raises:
        InputError: Names, shapes or kinds of numbers differ from the module's, or a number is not finite.
    """
    own = module.state_dict()
    missing, foreign = sorted(own.keys() - tensors.keys()), sorted(tensors.keys() - own.keys())
    if missing or foreign:
        parts = [f"{what} {', '.join(names[:3])}" for what, names in (("without", missing), ("with", foreign)) if names]
        kind = type(module).__name__
        raise InputError(f"checkpoint: expected the tensors of {kind}, got {source} {' and '.join(parts)}.")
    for name, value in tensors.items():
        want = own[name]
        alike = value.dtype in FLOATS and want.dtype in FLOATS
        if value.shape != want.shape or not (alike or value.dtype == want.dtype):
            expected, got = (f"{list(tensor.shape)} of {tensor.dtype}" for tensor in (want, value))
            raise InputError(f"checkpoint: expected {name} to be {expected}, got {got} in {source}.")
        if value.is_floating_point() and not alike:
            raise InputError(f"checkpoint: expected 16 bits or more a number, got {name} of {value.dtype} in {source}.")
        if not bool(torch.isfinite(value).all()):
            raise InputError(f"checkpoint: expected finite numbers, got others in {name} of {source}.")


def _own_class(name: str, source: Path) -> type[nn.Module]:
    """Return the class of `torchvo360.learn` that bears a name which came from a file."""
    expected = f"checkpoint: expected {source} to name a network of torchvo360.learn"
    found = import_name("checkpoint", name) if name.startswith(HOME) else None
    if not (isinstance(found, type) and issubclass(found, nn.Module) and found.__module__.startswith(HOME)):
        raise InputError(f"{expected}, or its class from you (target=...), as naming one runs its code, got {name!r}.")
    return found


def _called(target: object) -> str:
    return getattr(target, "__qualname__", type(target).__name__)


def _paths(path: str | Path) -> tuple[Path, Path]:
    path = Path(path)
    if not path.name:  # such as "." and "/"
        raise InputError(f"checkpoint: expected the path of a file, got {str(path)!r}.")
    stem = path.with_suffix("") if path.suffix in (".safetensors", ".json") else path
    return stem.with_name(f"{stem.name}.safetensors"), stem.with_name(f"{stem.name}.json")


def _finite(value: Any) -> Any:
    """Return the value with None for every number that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _safetensors() -> Any:
    try:
        import safetensors
    except ModuleNotFoundError:
        raise InputError("checkpoint: expected safetensors, which pip install 'torchvo360[learn]' brings.") from None
    return safetensors
