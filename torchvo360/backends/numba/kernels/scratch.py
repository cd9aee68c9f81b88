"""The scratch array of a block of points, and numbers in float32.

A block goes through short loops that each do one thing, over rows of one scratch array: that is what the compiler turns
into vector code, with one compiled function for all cameras, losses and numbers of channels.
"""

import math

import numpy as np

from torchvo360.cameras.equirectangular import AXIS_SHIFT
from torchvo360.cameras.pinhole import MIN_DEPTH

SPHERE, PINHOLE = 0, 1
HUBER, STUDENT_T, SQUARE = 0, 1, 2

BLOCK = 256
"""Points of one block: its scratch fills most of a first cache of 32 KB."""

f4 = np.float32
ZERO, HALF, ONE, TWO = f4(0), f4(0.5), f4(1), f4(2)
PI, HALF_PI = f4(math.pi), f4(math.pi / 2)
SHIFT, SHIFT2, NEAREST, TINY = f4(AXIS_SHIFT), f4(AXIS_SHIFT**2), f4(MIN_DEPTH), f4(1e-30)

# Rows of the scratch array. The last nine are those of the system: the Jacobian's columns and the residual.
X, Y, Z, RHO, INV, WEIGHT, U, V = (k * BLOCK for k in range(8))
RESIDUAL, GAINED, EACH, FORCE, COST, SHRINK, SLOPE = (k * BLOCK for k in range(8, 15))
T00, T01, T10, T11 = (k * BLOCK for k in range(15, 19))
GX, GY, GZ = T00, T01, T10  # the neighbours are not needed any more
S0, S1, S2, S3, S4, S5, S6, S7, S8 = (k * BLOCK for k in range(19, 28))
SCRATCH = 28 * BLOCK
