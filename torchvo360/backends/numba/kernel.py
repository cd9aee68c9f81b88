"""Where what numba has compiled comes from: imported with its first use."""

import importlib
from typing import Any

from torchvo360.checks import InputError


def kernel(name: str) -> Any:
    """Import a module of what numba has compiled: half a second, and some more the first time of all."""
    try:
        return importlib.import_module(f"torchvo360.backends.numba.kernels.{name}")
    except ModuleNotFoundError as error:
        if error.name != "numba":
            raise
        raise InputError(
            "backend: expected numba to be installed (pip install 'torchvo360[fast]'), got none."
        ) from error


def is_compiled() -> bool:
    """Return whether the odometry's passes lie compiled on disk: to compile them takes a minute."""
    return all(
        kernel("jit").is_on_disk(entry)
        for entry in (kernel("levenberg").solve_one_by_one, kernel("edges").add_target, kernel("tracing").walk)
    )
