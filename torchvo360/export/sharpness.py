"""Which of a sequence's images are blurred: far less sharp than those about them in time.

How sharp an image can be depends on what it shows, so that it is judged by its neighbours and not by a number.
"""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import UInt8

NEIGHBOURS = 4
"""Images before and after that one is compared with."""

LEAST_SHARE = 0.6
"""Of their median sharpness. Source: of the embedded clip's frames a Gaussian blur of one pixel leaves 0.40, a motion
blur of nine 0.49; among themselves they differ by 0.1."""

LEAST_IMAGES = 5
"""With fewer there is nothing to compare with."""


def sharpness(image: UInt8[np.ndarray, "H W 3"]) -> float:
    """Return the mean of the Laplacian's size per contrast, which no gain or offset of brightness changes."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    contrast = float(grey.std())
    return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean()) / contrast if contrast > 0 else 0.0


def blurred(sharpness_of: Mapping[int, float]) -> set[int]:
    """Return the indices of blurred images.

    Args:
        sharpness_of: The sharpness of images, by index.
    """
    indices = sorted(sharpness_of)
    values = np.array([sharpness_of[index] for index in indices])
    if len(values) < LEAST_IMAGES:
        return set()
    padded = np.pad(values, NEIGHBOURS, constant_values=np.nan)
    usual = np.nanmedian(np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1), -1)
    return {index for index, value, median in zip(indices, values, usual, strict=True) if value < LEAST_SHARE * median}
