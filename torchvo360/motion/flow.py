"""Corners and their tracks across the seam of a panorama: Shi and Tomasi, Lucas and Kanade, both by OpenCV."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from torchvo360.cameras import Camera

SEAM_MARGIN_PX = 48
"""Columns repeated on both sides, so that windows and small flows cross the seam."""
QUALITY, MIN_DISTANCE_PX = 0.004, 6
MAX_RETURN_ERROR_PX = 0.5
"""A track that does not come back to where it started, followed backwards, is dropped."""


def _extended(image: UInt8[np.ndarray, "H W"], camera: Camera) -> UInt8[np.ndarray, "H Wp"]:
    if not camera.wraps:
        return image
    margin = _seam_margin(camera)
    return np.concatenate([image[:, camera.width - margin :], image, image[:, :margin]], 1)


def _seam_margin(camera: Camera) -> int:
    return min(SEAM_MARGIN_PX, camera.width) if camera.wraps else 0


def find_corners(
    image: UInt8[np.ndarray, "H W"], camera: Camera, count: int, usable: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "N 2"]:
    """Return up to `count` corners as continuous pixels (centres at +0.5)."""
    found = cv2.goodFeaturesToTrack(
        image, count, QUALITY, MIN_DISTANCE_PX, mask=usable.astype(np.uint8) * 255, blockSize=5
    )
    if found is None:
        return np.zeros((0, 2), np.float32)
    return found.reshape(-1, 2).astype(np.float32) + 0.5


def follow(
    before: UInt8[np.ndarray, "H W"],
    after: UInt8[np.ndarray, "H W"],
    corners: Float[np.ndarray, "N 2"],
    camera: Camera,
) -> tuple[Float[np.ndarray, "N 2"], Bool[np.ndarray, "N"]]:
    """Follow corners from one image to the next and back.

    Returns:
        The corners in the second image, u wrapped into the image, and which of them returned to their start.
    """
    if len(corners) == 0:
        return corners, np.zeros(0, bool)
    shift = np.array([_seam_margin(camera), 0], np.float32) - 0.5
    start = (corners + shift).astype(np.float32)[:, None]
    settings = {
        "winSize": (15, 15),
        "maxLevel": 3,
        "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01),
    }
    first, second = _extended(before, camera), _extended(after, camera)
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, start.copy(), **settings)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, there, there.copy(), **settings)
    error = np.linalg.norm((back - start)[:, 0], axis=1)
    end = there[:, 0] - shift
    if camera.wraps:
        end[:, 0] %= camera.width
    ok = (found[:, 0] > 0) & (returned[:, 0] > 0) & (error < MAX_RETURN_ERROR_PX)
    inside = (end[:, 1] > 2) & (end[:, 1] < camera.height - 2) & (end[:, 0] >= 0) & (end[:, 0] <= camera.width)
    return end, ok & inside


def bearings(corners: Float[np.ndarray, "N 2"], camera: Camera) -> Float[Tensor, "N 3"]:
    """Return the unit rays of continuous pixels, float64."""
    ray = camera.ray(torch.from_numpy(corners).double())
    return ray / torch.linalg.vector_norm(ray, dim=-1, keepdim=True)
