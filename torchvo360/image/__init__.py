"""What is done to an image before any residual: padding, pyramids, gradients, look-up and selection."""

from torchvo360.image.covector import covector_field, gradient, gradient_magnitude
from torchvo360.image.padding import pad_image
from torchvo360.image.pyramid import blur, blur_radius, level_camera, masked_pyramid, pyramid, resample
from torchvo360.image.sampling import Interpolated, Taps, interpolate, locate, sample
from torchvo360.image.selection import (
    cell_of,
    equal_area_cells,
    equal_area_rows,
    one_per_cell,
    select_about,
    select_pixels,
)

__all__ = [
    "Interpolated",
    "Taps",
    "blur",
    "blur_radius",
    "cell_of",
    "covector_field",
    "equal_area_cells",
    "equal_area_rows",
    "gradient",
    "gradient_magnitude",
    "interpolate",
    "level_camera",
    "locate",
    "masked_pyramid",
    "one_per_cell",
    "pad_image",
    "pyramid",
    "resample",
    "sample",
    "select_about",
    "select_pixels",
]
