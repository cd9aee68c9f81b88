"""The state of a training: one file, replaced in one step, from which it continues bit for bit.

A safetensors file holds the tensors of network and optimizer and, as metadata, the counters as JSON. Batches, learning
rate and random numbers are functions of the step, so there is nothing else.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from torchvo360.checks import InputError
from torchvo360.files import write_atomically
from torchvo360.learn.checkpoint import load_tensors, read_tensors, tensors_to_bytes

STATE = "state.safetensors"

MODULE, OPTIMIZER, PROGRESS = "module.", "optimizer.", "progress"
"""Prefixes of the tensors' names, and the key of the metadata."""


@dataclass
class Progress:
    """How far a training has come."""

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
    write_atomically(path, tensors_to_bytes(tensors, {PROGRESS: json.dumps(asdict(progress), allow_nan=False)}))


def load_state(path: Path, module: nn.Module, optimizer: torch.optim.Optimizer) -> Progress:
    """Set network and optimizer to a saved state and return how far it had come.

    Raises:
        InputError: The file is damaged, or is that of another network.
    """
    tensors, metadata = read_tensors(path)
    progress = _progress(path, metadata)
    load_tensors(module, _under(MODULE, tensors), str(path))
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in _under(OPTIMIZER, tensors).items():
        index, _, key = name.partition(".")
        known = index.isdecimal() and int(index) < len(parameters)
        if not known or value.shape not in (parameters[int(index)].shape, torch.Size()):
            raise InputError(f"resume: expected the state of this optimizer in {path}, got {name} {list(value.shape)}.")
        state.setdefault(int(index), {})[key] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    return progress


def _progress(path: Path, metadata: Mapping[str, str]) -> Progress:
    try:
        progress = Progress(**json.loads(metadata[PROGRESS]))
    except (KeyError, TypeError, ValueError, RecursionError):
        progress = None
    numbers = [] if progress is None else [*asdict(progress).values()]
    if progress is None or not all(isinstance(number, int | float | None) for number in numbers):
        raise InputError(f"resume: expected the state of a training in {path}, got another file.")
    return progress


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
