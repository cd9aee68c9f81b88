"""How kernels are compiled, and when they are compiled again."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from torchvo360.cameras import equirectangular, pinhole
from torchvo360.residuals import direct

# NaN and infinities stay what they are: they must not get past the comparisons that hold indices inside.
FAST = {"contract", "reassoc", "arcp", "nsz"}

# With the modules whose constants the kernels hold.
_OTHERS = [Path(inspect.getfile(module)) for module in (equirectangular, pinhole, direct)]
_SOURCES = [*sorted(Path(__file__).parent.glob("*.py")), *_OTHERS]
_STAMP = tuple((path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in _SOURCES)


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function that Python calls, without Python's lock, and keep what was compiled on disk.

    By itself numba looks for changes in the file of the function alone. A kernel is made of functions of several files
    here: a change in any of them compiles all again.

    Args:
        options: Of `numba.njit`, besides.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        dispatcher: Any = njit(error_model="numpy", cache=True, nogil=True, **options)(function)
        dispatcher._cache._cache_file._source_stamp = _STAMP  # there is no public way
        return dispatcher

    return decorate


def inlined(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a part of kernels into each of them.

    As a function of its own it would be compiled with every kernel that calls it, a little differently, and whichever
    was loaded first would serve them all: sums would depend on what else the process has done before.

    Args:
        options: Of `numba.njit`, besides.
    """
    return njit(error_model="numpy", forceinline=True, **options)


def is_on_disk(kernel: Any) -> bool:
    """Return whether a compiled function was kept, in its present state."""
    return bool(kernel._cache._cache_file._load_index())
