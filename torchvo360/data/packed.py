"""Two cameras whose images share each frame of a video or each image file: above each other or side by side."""

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8
from torch import Tensor

from torchvo360.cameras import Rig
from torchvo360.checks import InputError
from torchvo360.data.frame import Frame
from torchvo360.data.images import Images, Source, View, judge
from torchvo360.data.selection import Selection

LAYOUTS = ("top_bottom", "left_right")


def half_size(layout: str, width: int, height: int) -> tuple[int, int]:
    """Return width and height of the two images in a frame.

    Raises:
        InputError: The frame has no two equal halves.
    """
    length = height if layout == "top_bottom" else width
    if length % 2:
        side = "height" if layout == "top_bottom" else "width"
        raise InputError(f"rig.layout: expected an even {side} for {layout}, got frames of {width} x {height}.")
    return (width, height // 2) if layout == "top_bottom" else (width // 2, height)


def halves(
    image: UInt8[np.ndarray, "H W 3"], layout: str
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]:
    """Return the upper and the lower, or the left and the right half of a frame."""
    width, height = half_size(layout, image.shape[1], image.shape[0])
    if layout == "top_bottom":
        return image[:height], image[height:]
    return np.ascontiguousarray(image[:, :width]), np.ascontiguousarray(image[:, width:])


class PackedImages(Images):
    """A sequence whose frames bring a second camera's image in `others`, None where that cannot be used."""

    def __init__(
        self,
        source: Source,
        selection: Selection,
        views: tuple[View, View],
        T_first_second: Float64[Tensor, "4 4"],
        *,
        layout: str,
        swap: bool = False,
    ) -> None:
        """Take a source of packed frames.

        Args:
            source: Frames as they are stored.
            selection: Which of them are used.
            views: How the halves become images of the first and of the second camera.
            T_first_second: Pose of the second camera in the first, metres.
            layout: `top_bottom` or `left_right`.
            swap: Whether the second camera's half comes first.

        Raises:
            InputError: The cameras are in one place.
        """
        super().__init__(source, views[0], selection)
        self._second = views[1]
        self._layout, self._swap = layout, swap
        T_body_cam = torch.stack([torch.eye(4, dtype=torch.float64), T_first_second])
        self._rig = Rig((views[0].camera, views[1].camera), T_body_cam)
        self._rig.baseline(1)

    @property
    def rig(self) -> Rig:
        """The first camera, which is the body, and the second one."""
        return self._rig

    @property
    def mask(self) -> Bool[Tensor, "H W"] | None:
        """The pixels of the first camera's images that show something."""
        return self.fit.mask

    def _prepare(self, frame: Frame) -> Frame:
        if frame.image is None:
            return Frame(frame.index, frame.t_ns, None, frame.problem, others=(None,))
        width, height = self.fit.source_size
        down, right = (2, 1) if self._layout == "top_bottom" else (1, 2)
        if frame.image.shape[:2] != (down * height, right * width):
            return Frame(frame.index, frame.t_ns, None, "size", others=(None,))
        parts = halves(frame.image, self._layout)
        first, second = (
            view(part) for view, part in zip((self.fit, self._second), parts[:: -1 if self._swap else 1], strict=True)
        )
        return Frame(frame.index, frame.t_ns, first, judge(first), others=(None if judge(second) else second,))
