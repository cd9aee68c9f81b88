"""A few keyframes of a synthetic world with points at their true ranges, and small windows of random images."""

from collections.abc import Sequence
from functools import cache

import torch
from jaxtyping import Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Camera
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.image import pad_image, select_pixels
from torchvo360.residuals.direct import Target
from torchvo360.vo.frame import FrameBuilder
from torchvo360.window import Window, WindowConfig, WindowFrame, WindowPoints, make_points


class Scene:
    """Frames of a synthetic sequence, rendered once."""

    def __init__(self, places: Sequence[int], **settings: object) -> None:
        config = SyntheticConfig(**{"width": 256, "height": 128, "frames": max(places) + 1, **settings})  # type: ignore[arg-type]
        self.sequence, self.places = SyntheticSequence(config), list(places)
        self.camera: Camera = self.sequence.camera
        self.builder = FrameBuilder(self.camera, 1, 0.5, None, 252 / 255, rig=self.sequence.rig)
        frames = [self.sequence.frame(place) for place in places]
        self.frames = [self.builder.build(f.image, f.index, f.t_ns, f.others) for f in frames if f.image is not None]
        self.ranges = [self.sequence.range(place) for place in places]
        self.T_cam_world = torch.stack(
            [lie.se3_inverse(self.sequence.pose(place)) @ self.sequence.pose(places[0]) for place in places]
        )

    def points(self, place: int, count: int, config: WindowConfig, camera: Camera | None = None) -> WindowPoints:
        """Points of one keyframe at their true inverse distances; their rays by another camera, if one is given."""
        frame, camera = self.frames[place], self.camera if camera is None else camera
        strength = self.builder.strength(frame)
        pixel = select_pixels(strength, self.builder.usable(frame), self.camera, count, minimum=4 / 255)
        true = self.camera.ray_grid().view(-1, 3)[pixel]
        ray = camera.ray_grid().view(-1, 3)[pixel]
        rho = 1 / (self.ranges[place].flatten()[pixel] * true.norm(dim=-1))
        target = Target(camera, frame.targets[0].padded, None, frame.targets[0].saturation)
        return make_points(target, pixel, (ray / ray.norm(dim=-1, keepdim=True)).T.contiguous(), rho, config, place)

    def window(self, config: WindowConfig, count: int = 300, camera: Camera | None = None) -> Window:
        """All frames as keyframes where they truly are, each with points; with a rig its other images, too."""
        window = Window(config, self.builder.T_other_first)
        for place, (frame, T) in enumerate(zip(self.frames, self.T_cam_world, strict=True)):
            target = frame.targets[0]
            target = Target(camera or self.camera, target.padded, None, target.saturation)
            none = torch.zeros(2, dtype=torch.float64)
            window.add_frame(WindowFrame(place, target, T, none, frame.others))
            window.add_points(self.points(place, count, config, camera))
        return window


@cache
def scene(*places: int, **settings: object) -> Scene:
    """A scene, made once for all tests."""
    return Scene(places, **settings)


def perturbed(window: Window, seed: int, translation: float, rotation: float, ranges: float) -> None:
    """Move all keyframes but the first, and spoil all inverse ranges by a share."""
    g = torch.Generator().manual_seed(seed)
    size = torch.tensor([translation] * 3 + [rotation] * 3, dtype=torch.float64)
    for place in range(1, len(window.frames)):
        xi = torch.randn(6, generator=g, dtype=torch.float64) * size
        moved(window, place, lie.se3_exp(xi) @ window.frames[place].T_cam_world)
    points = window.points
    assert points is not None
    points.rho = points.rho * (1 + ranges * torch.randn(len(points), generator=g)).clamp(0.3, 3)


def moved(window: Window, place: int, T_cam_world: Float64[Tensor, "4 4"]) -> None:
    """Put a keyframe somewhere else, without a word to the prior."""
    frame = window.frames[place]
    window.frames[place] = WindowFrame(**{**vars(frame), "T_cam_world": T_cam_world})


def random_target(camera: Camera, seed: int) -> Target:
    """A smooth random image in float64."""
    g = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 1, camera.height // 4, camera.width // 4, generator=g, dtype=torch.float64)
    image = torch.nn.functional.interpolate(coarse, (camera.height, camera.width), mode="bicubic")
    return Target(camera, pad_image(image, camera, 1).contiguous())
