"""Fetching pixels into the cache before they are needed: a window's points lie far apart, and each waits for memory."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from torchvo360.backends.numba.kernels.jit import inlined

READ, KEEP, DATA = 0, 3, 1
"""As LLVM's `prefetch` takes them: to read, in all caches, not as instructions."""


def _fetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Ask for an element's cache line, without waiting; any index will do."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        place = builder.bitcast(builder.gep(data, [values[1]]), byte)
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [place, number(READ), number(KEEP), number(DATA)])
        return context.get_dummy_value()

    return types.void(array, index), generate


fetch: Any = intrinsic(_fetch)


@inlined()
def fetch_cells(index, n, image, pitch):
    """Ask for the pixels that `lookup.gather` reads: both rows of every cell."""
    below = np.uintp(pitch)
    for i in range(n):
        j = np.uintp(index[i])
        fetch(image, j)
        fetch(image, j + below)
