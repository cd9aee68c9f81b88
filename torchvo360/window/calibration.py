"""The intrinsics k = (fx, fy, cx, cy) as unknowns of the window: one k for all keyframes.

A point keeps the pixels of its pattern in its host, so that its rays turn when k changes; the projection into the
targets uses the same k. What images cannot say is held: of a panorama cx, which only turns the camera about its
vertical axis, and where the image closes on itself fx too, which its width gives.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.cameras import Camera, Equirectangular

INTRINSICS = 4
HELD = 1e9
"""Weight of the prior on what images cannot say."""
SPREAD = 0.02
"""Standard deviation of the prior on the others: this share of the focal lengths and of the image's size."""
NOISE = 0.1
"""Standard deviation of an intensity, against which that prior is weighed: residuals of one patch, and of one point in
several keyframes, err together, so that they tell less than their number says."""


def at_intrinsics(camera: Camera, k: Float64[Tensor, "4"]) -> Camera:
    """Return the camera with other intrinsics."""
    fx, fy, cx, cy = k.tolist()
    return camera.recalibrated(fx, fy, cx, cy)


def intrinsics_of(camera: Camera) -> Float64[Tensor, "4"]:
    """Return a camera's intrinsics as a vector."""
    return torch.tensor(camera.intrinsics, dtype=torch.float64)


def prior_weights(camera: Camera, *, young: bool) -> Float64[Tensor, "4"]:
    """Return how much the energy holds each intrinsic parameter to its start, intensity^2 / pixel^2.

    Args:
        camera: The keyframes' camera.
        young: Whether the window has never had enough keyframes: then all are held.
    """
    if young:
        return torch.full((INTRINSICS,), HELD, dtype=torch.float64)
    fx, fy, _, _ = camera.intrinsics
    sizes: Sequence[float] = (fx, fy, camera.width, camera.height)
    weights = [(NOISE / (SPREAD * size)) ** 2 for size in sizes]
    if isinstance(camera, Equirectangular):
        weights[2] = HELD
        if camera.wraps or math.isclose(abs(fx) * math.tau, camera.width, rel_tol=1e-6):
            weights[0] = HELD
    return torch.tensor(weights, dtype=torch.float64)


def unit_rays(camera: Camera, uv: Float[Tensor, "2 N P"]) -> Float[Tensor, "3 N P"]:
    """Return the unit rays of pattern pixels."""
    ray = camera.ray(uv.movedim(0, -1)).movedim(-1, 0)
    return ray / ray.square().sum(0).sqrt()


def unit_ray_slopes(camera: Camera, uv: Float[Tensor, "2 N P"]) -> Float[Tensor, "3 4 N P"]:
    """Return the derivatives of the unit rays of pattern pixels by k."""
    return camera.unit_ray_jacobian_intrinsics(uv.movedim(0, -1)).movedim((-2, -1), (0, 1))
