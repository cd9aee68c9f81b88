"""What an image shows along rays: the compiled form of `residuals.direct.look_up_usable`."""

import numpy as np

from torchvo360.backends.numba.kernels.geometry import hide_unseen, locate, project_pinhole, project_sphere, wrap
from torchvo360.backends.numba.kernels.jit import FAST, compiled, inlined
from torchvo360.backends.numba.kernels.lookup import doubt, gather
from torchvo360.backends.numba.kernels.scratch import (
    BLOCK,
    NEAREST,
    ONE,
    PINHOLE,
    SCRATCH,
    SPHERE,
    T00,
    T01,
    T10,
    T11,
    WEIGHT,
    U,
    V,
    X,
    Y,
    Z,
    f4,
)
from torchvo360.residuals.direct import MIN_CONFIDENCE

SURE = f4(MIN_CONFIDENCE)
NAN = f4(np.nan)


@inlined()
def desk():
    """Return the scratch of a block and its indices; filled, since numbers below the normal ones are slow to touch."""
    return np.zeros(SCRATCH, f4), np.zeros(BLOCK, np.uint32)


@inlined(fastmath=FAST)
def _lay(s, n, x, y, z):
    for i in range(n):
        s[X + i] = x[i]
        s[Y + i] = y[i]
        s[Z + i] = z[i]
        s[WEIGHT + i] = ONE


@inlined(fastmath=FAST)
def _read(s, n, saturation, out):
    for i in range(n):
        across = s[U + i]
        upper = s[T00 + i] + across * (s[T01 + i] - s[T00 + i])
        lower = s[T10 + i] + across * (s[T11 + i] - s[T10 + i])
        value = upper + s[V + i] * (lower - upper)
        usable = (s[WEIGHT + i] >= SURE) & (value < saturation)
        out[i] = value if usable else NAN


@inlined()
def see(s, index, x, y, z, n, view, out):
    """Look an image up along the first n rays; NaN where they are unseen, masked or clipped.

    Args:
        s: Scratch, with `index` from `desk`.
        index: Of a block.
        x: Components of rays of any length but 0, with `y` and `z`.
        y: Likewise.
        z: Likewise.
        n: How many; not bound to blocks.
        view: Padded image [Hp, Wp]; its confidence or an empty array; intrinsics; SPHERE or PINHOLE; how many pixels go
            around a sphere; whether u is still to be brought into one turn; whether rays may lie out of view;
            saturation.
        out: Values, at least n.
    """
    image, confidence, k, kind, period, wrap_again, may_miss, saturation = view
    fx, fy, cx, cy = k[0], k[1], k[2], k[3]
    height, pitch = image.shape[0] - 2, image.shape[1]
    width = pitch - 2
    nearest = NEAREST if kind == PINHOLE else f4(-np.inf)
    for at in range(0, n, BLOCK):
        end = min(at + BLOCK, n)
        m = end - at
        _lay(s, m, x[at:end], y[at:end], z[at:end])
        if kind == SPHERE:
            project_sphere(s, m, fx, fy, cx, cy)
            if wrap_again:
                wrap(s, m, period)
        else:
            project_pinhole(s, m, fx, fy, cx, cy)
        if may_miss:
            hide_unseen(s, m, f4(width - 0.5), f4(height - 0.5), nearest)
        locate(s, index, m, height, width)
        if confidence.size:
            gather(s, index, m, confidence.reshape(-1), pitch)
            doubt(s, m)
        gather(s, index, m, image.reshape(-1), pitch)
        _read(s, m, saturation, out[at:end])


@compiled()
def see_rays(ray, view, out):
    """Look an image up along rays [3, N]."""
    s, index = desk()
    see(s, index, ray[0], ray[1], ray[2], len(out), view, out)
