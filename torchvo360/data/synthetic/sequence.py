"""A synthetic sequence: frames rendered one at a time, with exact poses and ranges."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.checks import InputError, check_choice, check_finite_number
from torchvo360.data.frame import Frame
from torchvo360.data.synthetic.layouts import WORLDS, make_world
from torchvo360.data.synthetic.motion import MOTIONS, trajectory
from torchvo360.data.synthetic.rays import CameraRays
from torchvo360.data.trajectory import Trajectory

CAMERAS = ("equirectangular", "pinhole")
EXPOSURES = ("constant", "steps", "drift")
MAX_SEED = 2**32 - 1
"""Largest seed: with the number of a frame it still makes a seed of 64 bits."""
STEP_FRAMES = 20
"""Frames between two steps of the exposure."""


@dataclass(kw_only=True)
class SyntheticConfig:
    """Settings of a synthetic sequence."""

    world: str = "room"
    """What the camera is in: room, pillars or courtyard."""
    frames: int = 150
    """Number of frames."""
    width: int = 512
    """Width of a frame, pixels."""
    height: int = 256
    """Height of a frame, pixels; half the width for a full panorama."""
    fps: float = 30.0
    """Frames a second."""
    seed: int = 0
    """Seed of the world, the path, the exposure and the noise: equal seeds give equal bits."""
    camera: str = "equirectangular"
    """The camera: equirectangular or pinhole."""
    fov_deg: float = 90.0
    """Horizontal field of view of the pinhole, degrees."""
    motion: str = "walk"
    """How the camera moves: walk (0.95 m/s), loop (closed), rotation (about a fixed point) or still."""
    exposure: str = "constant"
    """Brightness over time: constant, steps (by a factor of 1.5 to 2 every 20 frames) or drift (slow, 0.7 to 1.4)."""
    noise: float = 0.0
    """Standard deviation of the noise of each pixel and channel, in intensities of [0, 1]."""
    moving_objects: int = 0
    """Number of boxes that swing beside the path."""
    yaw_jump_deg: float = 0.0
    """Turn about the vertical inside two frames at the middle of the sequence, on top of the path, degrees."""
    panorama: str | None = None
    """Path of an equirectangular image that the walls wear, or the sky of the courtyard; None for procedural looks."""

    def __post_init__(self) -> None:
        check_choice("world", self.world, WORLDS)
        check_choice("camera", self.camera, CAMERAS)
        check_choice("motion", self.motion, MOTIONS)
        check_choice("exposure", self.exposure, EXPOSURES)
        for name, least in (("frames", 1), ("width", 16), ("height", 8), ("seed", 0), ("moving_objects", 0)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise InputError(f"{name}: expected an integer of at least {least}, got {value!r}.")
        if self.seed > MAX_SEED:
            raise InputError(f"seed: expected at most {MAX_SEED}, got {self.seed}.")
        if self.camera == "equirectangular" and self.width != 2 * self.height:
            raise InputError(f"width: expected twice the height for a panorama, got {self.width} x {self.height}.")
        check_finite_number("fps", self.fps, above=0.0, at_most=1e6)
        check_finite_number("fov_deg", self.fov_deg, above=0.0, at_most=170.0)
        if not abs(self.yaw_jump_deg) <= 180:
            raise InputError(f"yaw_jump_deg: expected a finite number from -180 to 180, got {self.yaw_jump_deg!r}.")
        if not (math.isfinite(self.noise) and 0 <= self.noise <= 1):
            raise InputError(f"noise: expected a number from 0 to 1, got {self.noise!r}.")


class SyntheticSequence:
    """An image sequence rendered on demand; `truth`, `pose` and `range` are exact.

    A frame is the world's colour times the frame's gain plus its offset plus noise, clipped to [0, 1], in 8 bits.
    """

    def __init__(self, config: SyntheticConfig | None = None) -> None:
        """Make the world and the path; frames are rendered when they are asked for.

        Raises:
            InputError: A setting is unusable, or the panorama cannot be read.
        """
        self.config = config = SyntheticConfig() if config is None else config
        config.__post_init__()  # settings may have been changed after the config was made
        self.world = make_world(
            config.world, seed=config.seed, panorama=config.panorama, moving_objects=config.moving_objects
        )
        self.camera: Camera = _camera(config)
        self._rays = CameraRays.of(self.camera)
        self.name = f"synthetic_{config.world}"
        t_ns = (torch.arange(config.frames, dtype=torch.float64) * (1e9 / config.fps)).round().long()
        poses = trajectory(
            config.motion,
            self.world.walkway,
            config.frames,
            config.fps,
            seed=config.seed,
            yaw_jump_deg=config.yaw_jump_deg,
        )
        self.truth = Trajectory(t_ns, poses)
        self.gains, self.offsets = _exposure(config)

    @property
    def length(self) -> int:
        """The number of frames."""
        return self.config.frames

    def __len__(self) -> int:
        return self.config.frames

    def __iter__(self) -> Iterator[Frame]:
        for index in range(len(self)):
            yield self.frame(index)

    def pose(self, index: int) -> Float64[Tensor, "4 4"]:
        """Return the exact T_world_cam of a frame."""
        return self.truth.T_world_cam[self._checked(index)]

    def render(self, index: int) -> tuple[Float[Tensor, "3 H W"], Float[Tensor, "H W"]]:
        """Return a frame's colours before exposure and noise, in [0, 1], and its exact range, inf for the sky."""
        return self.world.render(self._rays, self.pose(index), t=index / self.config.fps)

    def range(self, index: int) -> Float[Tensor, "H W"]:
        """Return the exact range of every pixel's centre in the camera's measure, metres; inf for the sky."""
        return self.render(index)[1]

    def frame(self, index: int) -> Frame:
        """Return a frame.

        Raises:
            InputError: The index is not one of the sequence.
        """
        image = self.render(index)[0] * float(self.gains[index]) + float(self.offsets[index])
        if self.config.noise > 0:
            generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + index)
            image += self.config.noise * torch.randn(image.shape, generator=generator)
        pixels = image.clamp_(0, 1).mul_(255).round_().to(torch.uint8).permute(1, 2, 0)
        return Frame(index, int(self.truth.t_ns[index]), np.ascontiguousarray(pixels.numpy()))

    def _checked(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise InputError(f"index: expected 0 to {len(self) - 1}, got {index}.")
        return index


def _camera(config: SyntheticConfig) -> Camera:
    if config.camera == "equirectangular":
        return Equirectangular(config.width, config.height)
    focal = config.width / 2 / math.tan(math.radians(config.fov_deg) / 2)
    return Pinhole(config.width, config.height, focal, focal, config.width / 2, config.height / 2)


def _exposure(config: SyntheticConfig) -> tuple[Float64[Tensor, "N"], Float64[Tensor, "N"]]:
    """Return the gain and the offset of every frame; those of the first are 1 and 0."""
    index = torch.arange(config.frames)
    gains, offsets = torch.ones(config.frames, dtype=torch.float64), torch.zeros(config.frames, dtype=torch.float64)
    generator = torch.Generator().manual_seed(config.seed + 1)
    if config.exposure == "steps":
        steps = -(-config.frames // STEP_FRAMES)
        draw = torch.rand(steps, 2, generator=generator, dtype=torch.float64)
        factor = 1.5 + 0.5 * draw[:, 0]
        level = torch.ones(steps, dtype=torch.float64)
        for k in range(1, steps):
            # the way that stays nearer to a gain of 1, so that neither white nor black wins
            up = (level[k - 1] * factor[k]).log().abs() < (level[k - 1] / factor[k]).log().abs()
            level[k] = level[k - 1] * factor[k] if up else level[k - 1] / factor[k]
        offset = 0.06 * (draw[:, 1] - 0.5)
        offset[0] = 0
        gains, offsets = level[index // STEP_FRAMES], offset[index // STEP_FRAMES]
    elif config.exposure == "drift":
        swing = torch.sin(index.double() / config.fps * 1.3)
        gains, offsets = torch.exp(swing * math.log(1.4)), -0.02 * swing
    return gains, offsets
