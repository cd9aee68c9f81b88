"""Which backend computes: numba where it is installed and serves, else eager torch, or the one that was asked for."""

import functools
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360.backends import comparison, compiled, eager, numba
from torchvo360.backends.comparison import Comparison
from torchvo360.backends.transforms import in_transform
from torchvo360.checks import InputError, check_choice
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig

BACKENDS = ("auto", "eager", "numba", "compiled")

_asked = "auto"


def linearize(
    reference: Reference,
    target: Target,
    T_tgt_ref: Float[Tensor, "B 4 4"],
    affine: Float[Tensor, "B 2"],
    loss: LossConfig,
    *,
    noise: float = 4 / 255,
) -> NormalEquations:
    """Linearise as `backends.eager.linearize` does, on the backend asked for, else the fastest there is for these."""
    problem = (reference, target, T_tgt_ref, affine)
    if _asked == "compiled" and not in_transform() and compiled.serves(*problem):
        return compiled.linearize(*problem, loss, noise=noise)
    chosen = numba if use_numba() and numba.serves(*problem) else eager
    return chosen.linearize(*problem, loss, noise=noise)


def compare(
    reference: Reference, target: Target, T_tgt_ref: Float[Tensor, "B 4 4"], affine: Float[Tensor, "B 2"]
) -> Comparison:
    """Compare as `backends.comparison.compare` does, on the backend asked for, else the fastest there is for these."""
    chosen = numba if use_numba() and numba.serves(reference, target, T_tgt_ref, affine) else comparison
    return chosen.compare(reference, target, T_tgt_ref, affine)


@contextmanager
def backend(name: str) -> Iterator[None]:
    """Compute on a backend while this is entered, in all threads.

    Args:
        name: auto; eager: torch alone; numba: as auto, but refused where it is not installed; compiled: `linearize` by
            `torch.compile` where it serves, and all else as eager.

    Raises:
        InputError: It is none of these, or numba or a C++ compiler is not installed.
    """
    global _asked
    check_choice("backend", name, BACKENDS)
    if name == "numba" and not has_numba():
        raise InputError("backend: expected numba to be installed (pip install 'torchvo360[fast]'), got none.")
    if name == "compiled" and not compiled.has_compiler():
        raise InputError(compiled.NO_COMPILER)
    before, _asked = _asked, name
    try:
        yield
    finally:
        _asked = before


def use_numba(*tensors: Tensor | None) -> bool:
    """Return whether a pass of numba's is to compute: it is installed, not turned off, and serves these tensors.

    It serves what is on the CPU and asks for no derivative: neither backwards, nor forwards, nor by `torch.func`; and
    not what `torch.compile` compiles.
    """
    return are_plain(*tensors) and _asked in ("auto", "numba") and has_numba()


def are_plain(*tensors: Tensor | None) -> bool:
    """Return whether tensors are numbers on the CPU that ask for no derivative: NumPy and numba may have them."""
    if in_transform():
        return False
    gradients = torch.is_grad_enabled()
    return all(
        value is None or (value.device.type == "cpu" and not (gradients and value.requires_grad)) for value in tensors
    )


@functools.cache
def has_numba() -> bool:
    """Return whether numba is installed."""
    return importlib.util.find_spec("numba") is not None
