"""The state of a training: one file, replaced in one step, from which it continues bit for bit.

A safetensors file holds the tensors of network and optimizer and, as metadata, the counters as JSON. Batches, learning
rate and random numbers are functions of the step, so there is nothing else.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchvo360.checks import InputError
from torchvo360.files import write_atomically
from torchvo360.learn.checkpoint import FLOATS, check_tensors, read_tensors, tensors_to_bytes

STATE = "state.safetensors"

MODULE, OPTIMIZER, PROGRESS, COUNT = "module.", "optimizer.", "progress", "tensors"
"""Prefixes of the tensors' names, and the keys of the metadata."""

MOST_STEPS = 2**62
"""TensorBoard's counter takes no more."""
COUNTERS = ("step", "best_step", "without_better", "skipped", "skipped_in_a_row")
MOMENTS = ("exp_avg", "exp_avg_sq")
"""What AdamW keeps for each parameter in its shape, besides `step`, the number of its updates."""


@dataclass
class Progress:
    """How far a training has come."""

    watch: str = ""
    """The figure that `best` is one of, as it is set."""
    losses: list[str] = field(default_factory=list)
    """Names of the losses; none before the first step."""
    step: int = 0
    """Steps done."""
    best: float | None = None
    """The best value of the watched figure, in its own sense; None before there is a finite one."""
    best_step: int = 0
    without_better: int = 0
    """Validations in a row without a better figure."""
    skipped: int = 0
    """Steps without a finite loss and gradient."""
    skipped_in_a_row: int = 0
    seconds: float = 0.0


def save_state(path: Path, module: nn.Module, optimizer: torch.optim.Optimizer, progress: Progress) -> None:
    """Write the state; a state that was there is replaced in one step.

    Raises:
        InputError: It cannot be written.
    """
    tensors = {f"{MODULE}{name}": value for name, value in module.state_dict().items()}
    for index, values in optimizer.state_dict()["state"].items():
        tensors |= {f"{OPTIMIZER}{index}.{name}": value for name, value in values.items()}
    # A parameter without a gradient has no state: only the number tells that a tensor is missing.
    metadata = {PROGRESS: json.dumps(asdict(progress), allow_nan=False), COUNT: str(len(tensors))}
    write_atomically(path, tensors_to_bytes(tensors, metadata))


def load_state(path: Path, module: nn.Module, optimizer: torch.optim.Optimizer) -> Progress:
    """Set network and optimizer to a saved state and return how far it had come.

    Raises:
        InputError: The file is damaged, or is that of another network; then both are as they were.
    """
    tensors, metadata = read_tensors(path)
    progress = _progress(path, metadata)
    if metadata.get(COUNT) != str(len(tensors)):
        raise InputError(f"resume: expected as many tensors as {path} counts, got {len(tensors)}.")
    own = _under(MODULE, tensors)
    check_tensors(module, own, str(path))
    state = _optimizer_state(path, _under(OPTIMIZER, tensors), optimizer)
    module.load_state_dict(own)
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    return progress


def _optimizer_state(
    path: Path, tensors: dict[str, Tensor], optimizer: torch.optim.Optimizer
) -> dict[int, dict[str, Tensor]]:
    """Return the tensors by parameter; one that never had a gradient has none."""
    expected = f"resume: expected the state of this optimizer in {path}"
    state: dict[int, dict[str, Tensor]] = {}
    for index, parameter in enumerate(p for group in optimizer.param_groups for p in group["params"]):
        shapes = {"step": torch.Size(), **dict.fromkeys(MOMENTS, parameter.shape)}
        own = {name: tensors.pop(f"{index}.{name}") for name in shapes if f"{index}.{name}" in tensors}
        if own and not all(name in own and _is_moment(name, own[name], shape) for name, shape in shapes.items()):
            got = ", ".join(f"{name} {list(value.shape)} of {value.dtype}" for name, value in own.items())
            raise InputError(f"{expected}, {', '.join(shapes)} of parameter {index}, got {got}.")
        state |= {index: own} if own else {}
    if tensors:
        raise InputError(f"{expected}, got {', '.join(sorted(tensors)[:3])}.")
    return state


def _is_moment(name: str, value: Tensor, shape: torch.Size) -> bool:
    if value.shape != shape or value.dtype not in FLOATS or not bool(torch.isfinite(value).all()):
        return False
    return name == "exp_avg" or bool((value >= 0).all())


def _progress(path: Path, metadata: Mapping[str, str]) -> Progress:
    try:
        values = json.loads(metadata[PROGRESS])
    except (KeyError, ValueError, RecursionError):
        values = None
    names = {each.name for each in fields(Progress)}
    if not isinstance(values, dict) or values.keys() != names:
        raise InputError(f"resume: expected the state of a training in {path}, got another file.")
    for name, value in values.items():
        if not _is_possible(name, value, values["step"]):
            raise InputError(f"resume: expected the state of a training in {path}, got {value!r} as {name}.")
    return Progress(**values)


def _is_possible(name: str, value: Any, step: Any) -> bool:
    """Return whether a field of `Progress` can have a value in a training of so many steps."""
    if name in COUNTERS:
        # A validation comes before the first step, too; a bool would be an int.
        most = MOST_STEPS if name == "step" or type(step) is not int else step + (name == "without_better")
        return type(value) is int and 0 <= value <= most
    if name == "watch":
        return isinstance(value, str)
    if name == "losses":
        return isinstance(value, list) and all(isinstance(each, str) for each in value)
    if name == "best" and value is None:
        return True
    return isinstance(value, float) and math.isfinite(value) and (name == "best" or value >= 0.0)


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
