"""The search for single points' matches along their great circles, the compiled form of `depth.epipolar`.

What is explained there is done here point by point in float64, but for the images' values. Only the places within a
point's interval are looked up; those of many points go through the image together.
"""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import compiled, inlined
from torchvo360.backends.numba.kernels.scratch import f4
from torchvo360.backends.numba.kernels.sight import desk, see

HALF = 2
"""Samples on each side of the centre."""
TOGETHER = 2048
"""Samples that are looked up at once, about 60 points' intervals."""
START, TOWARDS, PHI, SINE, SIGMA, MIDDLE, WIDTH, SLOPE2, EACH = 0, 3, 6, 7, 8, 9, 10, 11, 12
"""What is kept of a point: its great circle, the interval, and the mean square slope along the curve."""


@inlined()
def _circle(ray, i, T, epipole, keep):
    """Write a point's great circle and return its direction there as seen in the reference."""
    for row in range(3):
        keep[START + row] = T[row, 0] * ray[0, i] + T[row, 1] * ray[1, i] + T[row, 2] * ray[2, i]
    a, b, c = keep[START], keep[START + 1], keep[START + 2]
    cosine = min(max(epipole[0] * a + epipole[1] * b + epipole[2] * c, -1.0), 1.0)
    d, e, f = epipole[0] - cosine * a, epipole[1] - cosine * b, epipole[2] - cosine * c
    sine = math.sqrt(d * d + e * e + f * f)
    inverse = 1.0 / max(sine, 1e-6)
    d, e, f = d * inverse, e * inverse, f * inverse
    keep[TOWARDS], keep[TOWARDS + 1], keep[TOWARDS + 2] = d, e, f
    keep[PHI], keep[SINE] = math.atan2(sine, cosine), sine
    return (
        T[0, 0] * d + T[1, 0] * e + T[2, 0] * f,
        T[0, 1] * d + T[1, 1] * e + T[2, 1] * f,
        T[0, 2] * d + T[1, 2] * e + T[2, 2] * f,
    )


@inlined()
def _angle(rho, baseline, keep):
    """Return where a point of this inverse distance lies on its circle."""
    along = rho * baseline
    return math.atan2(along * keep[SINE], 1.0 + along * math.cos(keep[PHI]))


@inlined()
def _rho_by_angle(theta, baseline, keep):
    return keep[SINE] / (baseline * math.sin(max(keep[PHI] - theta, 1e-3)) ** 2)


@inlined()
def _around(ray, T, epipole, step, keep, x, y, z):
    """Write the circles, and the directions of five samples of the reference along each."""
    for i in range(len(keep)):
        d, e, f = _circle(ray, i, T, epipole, keep[i])
        for j in range(5):
            cosine, sine = math.cos((j - HALF) * step), math.sin((j - HALF) * step)
            x[5 * i + j] = ray[0, i] * cosine + d * sine
            y[5 * i + j] = ray[1, i] * cosine + e * sine
            z[5 * i + j] = ray[2, i] * cosine + f * sine


@inlined()
def _lay_out(x, y, z, at, each, keep, cosine, sine):
    """Write the directions of a point's interval, one pixel of arc apart."""
    c, s = math.cos(keep[MIDDLE]), math.sin(keep[MIDDLE])
    a, d = f4(keep[START] * c + keep[TOWARDS] * s), f4(keep[TOWARDS] * c - keep[START] * s)
    b, e = f4(keep[START + 1] * c + keep[TOWARDS + 1] * s), f4(keep[TOWARDS + 1] * c - keep[START + 1] * s)
    g, f = f4(keep[START + 2] * c + keep[TOWARDS + 2] * s), f4(keep[TOWARDS + 2] * c - keep[START + 2] * s)
    first = (len(cosine) - each) // 2
    for j in range(each):
        x[at + j] = a * cosine[first + j] + d * sine[first + j]
        y[at + j] = b * cosine[first + j] + e * sine[first + j]
        z[at + j] = g * cosine[first + j] + f * sine[first + j]


@inlined()
def _match(seen, samples, step, max_ssd, min_distinction, keep, ssd):
    """Return the angle of the best place of an interval, and whether it is clear."""
    width = int(keep[WIDTH])
    n = 2 * width + 3
    for j in range(n):
        total = 0.0
        for k in range(5):
            off = float(seen[j + k]) - float(samples[k])
            total += off * off
        ssd[j] = total if total == total else np.inf
    low, high = n, 0
    best, second, at = np.inf, np.inf, 1
    for j in range(1, n - 1):
        centre = keep[MIDDLE] + (j - 1 - width) * step
        if centre > -1.5 * step and centre < keep[PHI] - 0.02:
            low, high = min(low, j), j + 1
            if ssd[j] < best:
                best, at = ssd[j], j
    for j in range(low, high):
        if abs(j - at) > HALF:
            second = min(second, ssd[j])
    before, after = ssd[at - 1], ssd[at + 1]
    curvature = before - 2 * best + after
    shift = 0.0
    if curvature > 1e-9 and before < np.inf and after < np.inf:
        shift = min(max((before - after) / (2 * curvature), -0.6), 0.6)
    theta = max(keep[MIDDLE] + (at - 1 - width + shift) * step, 0.0)
    return theta, best < max_ssd and second > min_distinction * best


@inlined()
def _plan(rho, variance, baseline, step, settings, keep, samples):
    """Write a point's interval; return whether gradient, baseline and uncertainty make a search worth while."""
    min_gradient, min_sine, max_half_width = settings[0], settings[1], settings[2]
    slope2 = 0.0
    for j in range(4):
        change = float(samples[j + 1]) - float(samples[j])
        slope2 += change * change
    slope2 /= 4
    rho, sigma = float(rho), math.sqrt(float(variance))
    nearest = _angle(rho + 2 * sigma, baseline, keep)
    farthest = _angle(max(rho - 2 * sigma, 0.0), baseline, keep)
    half_width = max((nearest - farthest) / (2 * step), 1.5)
    keep[SIGMA], keep[SLOPE2], keep[MIDDLE] = sigma, slope2, (nearest + farthest) / 2
    match_sigma = _rho_by_angle(_angle(rho, baseline, keep), baseline, keep) * step * 0.3
    worth = (
        slope2 > min_gradient**2 and keep[SINE] > min_sine and match_sigma < 2 * sigma and half_width <= max_half_width
    )
    keep[WIDTH] = math.floor(half_width + 0.5) if worth else 0.0
    return worth


@compiled()
def search(
    ray, rho, variance, slope, T, affine, reference, target, step, settings, out_rho, out_variance, searched, found
):
    """Match points of a reference image in a target image.

    Args:
        ray: Unit rays in the reference camera [3, N], float32.
        rho: Predicted inverse distances [N], float32.
        variance: Of the predictions [N], float32.
        slope: Gradient magnitudes [N], float32.
        T: T_tgt_ref [4, 4], float64.
        affine: (a, b) [2], float64.
        reference: The reference image, as `see` has it.
        target: The target image, likewise.
        step: The angle of a pixel.
        settings: min_gradient, min_sine, max_half_width_px, max_ssd, min_distinction, noise, position_error_px and
            line_error_px, float64.
        out_rho: Out: inverse distances, where nothing is found the predicted ones [N], float32.
        out_variance: Out: their variances, infinite where nothing is found [N], float32.
        searched: Out [N].
        found: Out [N].
    """
    max_ssd, min_distinction = settings[3], settings[4]
    noise, position_error, line_error = settings[5], settings[6], settings[7]
    N, most = len(rho), int(settings[2])
    baseline = max(math.sqrt(T[0, 3] ** 2 + T[1, 3] ** 2 + T[2, 3] ** 2), 1e-12)
    epipole = (T[0, 3] / baseline, T[1, 3] / baseline, T[2, 3] / baseline)
    s, index = desk()
    keep, samples = np.zeros((N, EACH)), np.zeros(5 * N, f4)
    longest = 2 * most + 7
    room = max(TOGETHER + longest, 5 * N)
    x, y, z, seen = np.zeros(room, f4), np.zeros(room, f4), np.zeros(room, f4), np.zeros(room, f4)
    _around(ray, T, epipole, step, keep, x, y, z)
    see(s, index, x, y, z, 5 * N, reference, seen)
    gain, offset = f4(math.exp(affine[0])), f4(affine[1])
    for j in range(5 * N):
        samples[j] = gain * seen[j] + offset
    cosine, sine, ssd = np.zeros(longest, f4), np.zeros(longest, f4), np.zeros(longest)
    for j in range(longest):
        cosine[j], sine[j] = math.cos((j - longest // 2) * step), math.sin((j - longest // 2) * step)
    for i in range(N):
        out_rho[i], out_variance[i], found[i] = rho[i], f4(np.inf), False
        searched[i] = _plan(rho[i], variance[i], baseline, step, settings, keep[i], samples[5 * i : 5 * i + 5])
    first = 0
    while first < N:
        last, count = first, 0
        while last < N and count < TOGETHER:
            if searched[last]:
                each = 2 * int(keep[last, WIDTH]) + 7
                _lay_out(x, y, z, count, each, keep[last], cosine, sine)
                count += each
            last += 1
        see(s, index, x, y, z, count, target, seen)
        count = 0
        for i in range(first, last):
            if not searched[i]:
                continue
            own = samples[5 * i : 5 * i + 5]
            theta, clear = _match(seen[count:], own, step, max_ssd, min_distinction, keep[i], ssd)
            count += 2 * int(keep[i, WIDTH]) + 7
            if clear:
                slope2 = max(keep[i, SLOPE2], 1e-12)
                ratio = min(max(float(slope[i]) ** 2 / slope2, 1.0), 50.0)
                error_px2 = position_error**2 + line_error**2 * ratio + noise**2 / (4 * slope2)
                out_rho[i] = math.sin(theta) / (baseline * math.sin(max(keep[i, PHI] - theta, 1e-3)))
                out_variance[i] = (_rho_by_angle(theta, baseline, keep[i]) * step) ** 2 * error_px2
                found[i] = True
        first = last
