"""A window's points as one of its keyframes sees them, the compiled form of `window.projection`."""

import math

import numpy as np

from torchvo360.backends.numba.kernels.geometry import project_pinhole, project_sphere, wrap
from torchvo360.backends.numba.kernels.jit import compiled, inlined
from torchvo360.backends.numba.kernels.scratch import BLOCK, NEAREST, ONE, SPHERE, U, V, X, Y, Z, f4
from torchvo360.backends.numba.kernels.sight import desk, see
from torchvo360.cameras.equirectangular import MIN_HORIZONTAL

NEAREST_AXIS2 = f4(MIN_HORIZONTAL**2)


@inlined()
def _carry(ray, centre, rho, host, T, out_ray, out_rho):
    """Move points into the keyframe."""
    for i in range(len(rho)):
        R = T[host[i]]
        a, b, c, d = ray[0, i, centre], ray[1, i, centre], ray[2, i, centre], rho[i]
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + R[0, 3] * d
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + R[1, 3] * d
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + R[2, 3] * d
        inverse = ONE / math.sqrt(max(x * x + y * y + z * z, f4(1e-24)))
        out_ray[0, i], out_ray[1, i], out_ray[2, i], out_rho[i] = x * inverse, y * inverse, z * inverse, d * inverse


@inlined()
def _find(s, ray, view, pixel, shown):
    """Write the nearest pixels, and which rays are in view."""
    image, _, k, kind, period, _, may_miss, _ = view
    width, height = image.shape[1] - 2, image.shape[0] - 2
    for at in range(0, len(pixel), BLOCK):
        n = min(BLOCK, len(pixel) - at)
        for i in range(n):
            s[X + i], s[Y + i], s[Z + i] = ray[0, at + i], ray[1, at + i], ray[2, at + i]
        if kind == SPHERE:
            project_sphere(s, n, k[0], k[1], k[2], k[3])
            wrap(s, n, period)
        else:
            project_pinhole(s, n, k[0], k[1], k[2], k[3])
        for i in range(n):
            x, z, u, v = s[X + i], s[Z + i], s[U + i], s[V + i]
            seen = x * x + z * z > NEAREST_AXIS2 if kind == SPHERE else z > NEAREST
            if may_miss:
                seen = seen and u >= 0 and u <= f4(width) and v >= 0 and v <= f4(height)
            # A NaN is nowhere, and stays at the first pixel.
            column = int(u) if u > 0 and u < f4(width) else (width - 1 if u > 0 else 0)
            row = int(v) if v > 0 and v < f4(height) else (height - 1 if v > 0 else 0)
            pixel[at + i], shown[at + i] = row * width + column, seen


@compiled()
def project(ray, centre, rho, host, value, weight, T, affine, own, view, most, out_ray, out_rho, pixel, shown):
    """Find where points lie in a keyframe, and whether they look there as they should.

    Args:
        ray: Unit rays of the patterns in the hosts [3, N, P], float32.
        centre: Which of the pattern is the point itself.
        rho: Inverse distances [N], float32.
        host: Places of the hosts [N], int64.
        value: Intensities in the hosts [N, P], float32.
        weight: Of each pixel of the pattern [N, P], float32.
        T: T_keyframe_host of each place [K, 4, 4], float32.
        affine: (a, b) of each place [K, 2], float32.
        own: (a, b) of the keyframe [2], float32.
        view: Its image, as `see` has it.
        most: Points whose intensity differs by as much are hidden, float32.
        out_ray: Out: unit rays [3, N], float32.
        out_rho: Out: inverse distances [N], float32.
        pixel: Out: flat, the nearest in the image [N], int64.
        shown: Out [N].
    """
    s, index = desk()
    _carry(ray, centre, rho, host, T, out_ray, out_rho)
    _find(s, out_ray, view, pixel, shown)
    found = np.empty(len(rho), f4)
    see(s, index, out_ray[0], out_ray[1], out_ray[2], len(rho), view, found)
    gain = f4(math.exp(own[0]))
    back = np.empty(len(T), f4)
    for k in range(len(T)):
        back[k] = math.exp(-affine[k, 0])
    for i in range(len(rho)):
        scene = (value[i, centre] - affine[host[i], 1]) * back[host[i]]
        # A NaN, where nothing usable is seen, fails the comparison.
        agrees = abs(found[i] - (gain * scene + own[1])) < most
        shown[i] = shown[i] and agrees and weight[i, centre] > 0
