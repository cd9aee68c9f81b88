"""Keyframes rendered in synthetic worlds, with points at the exact ranges and noise of 5 %."""

import math
from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.cameras import Camera, Equirectangular
from torchvo360.data.synthetic import make_world
from torchvo360.data.synthetic.motion import UPRIGHT
from torchvo360.image import blur, gradient_magnitude, level_camera, pad_image, resample, select_pixels
from torchvo360.loop import LoopFrame, make_loop_frame
from torchvo360.residuals.direct import Target

PANORAMA = Equirectangular(512, 256)


def turned(yaw: float, tilt: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """R_world_cam of a camera turned left by yaw, then tilted about its x and z axes, radians."""
    about = torch.tensor([0.0, 0.0, yaw], dtype=torch.float64)
    lean = torch.tensor([tilt[0], 0.0, tilt[1]], dtype=torch.float64)
    return lie.so3_exp(about) @ UPRIGHT @ lie.so3_exp(lean)


@dataclass
class Studio:
    """Renders a world from poses near its walkway's centre."""

    name: str
    seed: int
    worlds: dict = field(default_factory=dict)

    def pose(
        self, offset: tuple[float, float, float] = (0.0, 0.0, 0.0), yaw: float = 0.0, tilt=(0.0, 0.0), at: float = 0.0
    ) -> Tensor:
        way = self.world.walkway
        x = way.centre[0] + way.radii[0] * math.cos(at) + offset[0]
        y = way.centre[1] + way.radii[1] * math.sin(at) + offset[1]
        position = torch.tensor([x, y, way.eye_height + offset[2]], dtype=torch.float64)
        return lie.se3(turned(yaw, tilt), position)

    @property
    def world(self):
        return self.worlds.setdefault("world", make_world(self.name, seed=self.seed))

    def look(self, T_world_cam: Tensor, camera: Camera = PANORAMA) -> tuple[Tensor, Tensor]:
        """Grey image and range."""
        key = (camera, tuple(T_world_cam.flatten().tolist()))
        if key not in self.worlds:
            image, reach = self.world.render(camera, T_world_cam)
            self.worlds[key] = (image.mean(0), reach)
        return self.worlds[key]

    def frame(
        self,
        T_world_cam: Tensor,
        *,
        scale: float = 1.0,
        gain: float = 1.0,
        offset: float = 0.0,
        noise: float = 0.05,
        seed: int = 0,
        points: int = 3000,
        camera: Camera = PANORAMA,
        mask: Tensor | None = None,
    ) -> LoopFrame:
        """A keyframe whose own unit is 1 / scale metres."""
        grey, reach = self.look(T_world_cam, camera)
        grey = (grey * gain + offset).clamp(0, 1)
        generator = torch.Generator().manual_seed(seed)
        grey = ((grey + 0.01 * torch.randn(grey.shape, generator=generator)).clamp(0, 1) * 255).round() / 255
        smooth = level = blur(grey, camera, 0.5)
        share = None if mask is None else mask.float()
        targets = []
        for k in range(4):
            small = level_camera(camera, k)
            level = resample(level, small)
            confidence = None
            if share is not None:
                share = resample(share, small)
                confidence = pad_image((share > 0.99).float()[None, None], small, 1)
            targets.append(Target(small, pad_image(level[None, None], small, 1).contiguous(), confidence, 252 / 255))
        usable = torch.isfinite(reach) & (smooth < 252 / 255)
        usable = usable if mask is None else usable & mask
        strength = gradient_magnitude(smooth, camera)
        pixel = select_pixels(strength, usable, camera, 2 * points, minimum=2 / 255)
        ray = camera.ray_grid().view(-1, 3)[pixel].T
        rho = 1 / (reach.flatten()[pixel] * torch.linalg.vector_norm(ray, dim=0) * scale)
        rho = rho * (1 + noise * torch.randn(rho.shape, generator=generator)).clamp_min(0.2)
        return make_loop_frame(T_world_cam, targets, ray, rho, (noise * rho) ** 2, max_points=points)


@pytest.fixture(scope="session")
def room() -> Studio:
    return Studio("room", 0)


@pytest.fixture(scope="session")
def courtyard() -> Studio:
    return Studio("courtyard", 1)


@pytest.fixture(scope="session")
def pillars() -> Studio:
    return Studio("pillars", 2)
