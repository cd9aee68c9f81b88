"""How kernels are compiled, and when they are compiled again."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

# NaN and infinities stay what they are: they must not get past the comparisons that hold indices inside.
FAST = {"contract", "reassoc", "arcp", "nsz"}

_SOURCES = sorted(Path(__file__).parent.glob("*.py"))
_STAMP = tuple((path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in _SOURCES)


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function by numba without its interpreter, and keep what was compiled on disk.

    By itself numba looks for changes in the file of the function alone. A kernel is made of functions of several files
    here: a change in any of them compiles all again.

    Args:
        options: Of `numba.njit`, besides.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        dispatcher = njit(error_model="numpy", cache=True, **options)(function)
        dispatcher._cache._cache_file._source_stamp = _STAMP
        return dispatcher

    return decorate
