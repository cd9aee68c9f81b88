"""A* compiled by numba, from the one source; imported only where numba is installed.

What is compiled is kept beside the package, or in the user's cache where that cannot be written.
"""

import numba
from numba.extending import register_jitable

from torchvo360.planning import astar as source

register_jitable(source.octile)
astar = numba.njit(cache=True)(source.astar)
