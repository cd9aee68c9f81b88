"""A synthetic sequence: frames rendered one at a time, with exact poses and ranges."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from torchvo360.cameras import Camera, Equirectangular, Pinhole, Rig
from torchvo360.checks import InputError, check_choice, check_finite_number
from torchvo360.data.frame import Frame, ImageSequence
from torchvo360.data.synthetic.companion import MOST_SHARE, with_companion
from torchvo360.data.synthetic.depth import sensed_depth
from torchvo360.data.synthetic.imu import ImuSetup, SyntheticImu, make_imu
from torchvo360.data.synthetic.layouts import FIELD, WORLDS, make_world
from torchvo360.data.synthetic.motion import MOTIONS, trajectory
from torchvo360.data.synthetic.rays import CameraRays
from torchvo360.data.trajectory import Trajectory
from torchvo360.inertial import ImuSensor
from torchvo360.lie import se3, so3_exp

CAMERAS = ("equirectangular", "pinhole")
EXPOSURES = ("constant", "steps", "jumps", "drift")
JUMP = 4.0
"""Two stops."""
STEREO_AXES = ("x", "y")
MIN_BASELINE, MAX_BASELINE = 1e-3, 0.4
"""Shortest and longest distance of two cameras, metres: the second too keeps clear of what stands beside the path."""
MAX_SEED = 2**32 - 1
"""Largest seed: with the number of a frame it still makes a seed of 64 bits."""
MIN_IMU_HZ, MAX_IMU_HZ = 20.0, 2000.0
MAX_OFFSET_MS = 300.0
STEP_FRAMES = 20
"""Frames between two steps of the exposure."""


@dataclass(kw_only=True)
class SyntheticConfig:
    """Settings of a synthetic sequence."""

    world: str = "room"
    """What the camera is in: room, pillars, courtyard or field."""
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
    """How the camera moves: walk (0.95 m/s), loop (closed), turned_loop (closed but for the yaw), pause, turn and
    turn_first (walks that stand still for 1.5 s, or only turn for 3 s), rotation (about a fixed point) or still."""
    exposure: str = "constant"
    """Brightness over time: constant, steps (by a factor of 1.5 to 2 every 20 frames), jumps (by two stops, between
    0.5 and 2, every 20 frames) or drift (slow, 0.7 to 1.4)."""
    noise: float = 0.0
    """Standard deviation of the noise of each pixel and channel, in intensities of [0, 1]."""
    moving_objects: int = 0
    """Number of boxes that swing beside the path."""
    moving_share: float = 0.0
    """Share of the sphere, up to 0.4, that one object covers: it goes along with the camera and sways about it."""
    yaw_jump_deg: float = 0.0
    """Turn about the vertical inside two frames at the middle of the sequence, on top of the path, degrees."""
    stereo_baseline: float = 0.0
    """Distance of a second camera of the same kind from the first, metres; 0 for a single camera."""
    stereo_axis: str = "x"
    """Where the second camera is, in the first one's frame: x, to the right, or y, below."""
    depth_noise: float | None = None
    """Noise of a depth sensor beside the camera, as a share of each range; None without one."""
    depth_holes: float = 0.0
    """Share of the image in which that sensor knows nothing, in blobs."""
    imu_rate: float = 0.0
    """Samples a second of an IMU that is fixed to the camera; 0 for none."""
    imu_noise: float = 1.0
    """White noise and random walk of its biases, times those of EuRoC's IMU."""
    imu_bias: float = 1.0
    """Its first biases, drawn with standard deviations of this times 0.03 rad/s and 0.08 m/s^2."""
    imu_lever: list[float] = field(default_factory=lambda: [0.06, -0.04, 0.03])
    """Where it is in the camera's frame, metres."""
    imu_turn_deg: list[float] = field(default_factory=lambda: [5.0, -85.0, 10.0])
    """How it is turned in the camera's frame: a rotation vector, degrees."""
    imu_offset_ms: float = 0.0
    """What to add to its times to get the camera's; the sequence does not tell."""
    imu_gap_s: float = 0.0
    """How long it gives no samples at the middle of the sequence, seconds."""
    blackout_s: float = 0.0
    """How long the images are black at the middle of the sequence, seconds."""
    panorama: str | None = None
    """Path of an equirectangular image that the walls wear, or the sky of the courtyard; None for procedural looks."""

    def __post_init__(self) -> None:
        check_choice("world", self.world, (*WORLDS, FIELD))
        check_choice("camera", self.camera, CAMERAS)
        check_choice("motion", self.motion, MOTIONS)
        check_choice("exposure", self.exposure, EXPOSURES)
        check_choice("stereo_axis", self.stereo_axis, STEREO_AXES)
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
        if not (self.stereo_baseline == 0 or MIN_BASELINE <= self.stereo_baseline <= MAX_BASELINE):
            expected = f"0 or a number from {MIN_BASELINE:g} to {MAX_BASELINE:g}"
            raise InputError(f"stereo_baseline: expected {expected}, got {self.stereo_baseline!r}.")
        if not 0 <= self.moving_share <= MOST_SHARE:
            raise InputError(f"moving_share: expected a number from 0 to {MOST_SHARE}, got {self.moving_share!r}.")
        if self.moving_share > 0 and self.stereo_baseline > 0:
            raise InputError(f"moving_share: expected 0 with a second camera, got {self.moving_share!r}.")
        if not abs(self.yaw_jump_deg) <= 180:
            raise InputError(f"yaw_jump_deg: expected a finite number from -180 to 180, got {self.yaw_jump_deg!r}.")
        self._check_imu()
        if self.depth_noise is not None and not 0 <= self.depth_noise <= 1:
            raise InputError(f"depth_noise: expected None or a number from 0 to 1, got {self.depth_noise!r}.")
        if not 0 <= self.depth_holes <= 1:
            raise InputError(f"depth_holes: expected a share from 0 to 1, got {self.depth_holes!r}.")
        if not (math.isfinite(self.noise) and 0 <= self.noise <= 1):
            raise InputError(f"noise: expected a number from 0 to 1, got {self.noise!r}.")

    def _check_imu(self) -> None:
        if not (self.imu_rate == 0 or MIN_IMU_HZ <= self.imu_rate <= MAX_IMU_HZ):
            expected = f"0 or a number from {MIN_IMU_HZ:g} to {MAX_IMU_HZ:g}"
            raise InputError(f"imu_rate: expected {expected}, got {self.imu_rate!r}.")
        for name in ("imu_noise", "imu_bias", "imu_gap_s", "blackout_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"{name}: expected a finite number of at least 0, got {value!r}.")
        if not abs(self.imu_offset_ms) <= MAX_OFFSET_MS:
            expected = f"a number from {-MAX_OFFSET_MS:g} to {MAX_OFFSET_MS:g}"
            raise InputError(f"imu_offset_ms: expected {expected}, got {self.imu_offset_ms!r}.")
        for name in ("imu_lever", "imu_turn_deg"):
            value = getattr(self, name)
            if len(value) != 3 or not all(math.isfinite(number) for number in value):
                raise InputError(f"{name}: expected three finite numbers, got {value!r}.")


class SyntheticSequence(ImageSequence):
    """An image sequence rendered on demand; `truth`, `pose` and `range` are exact, and the first camera's.

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
        self._camera = _camera(config)
        self._rig = _rig(config, self._camera)
        self._rays = CameraRays.of(self._camera)
        t_ns = (torch.arange(config.frames, dtype=torch.float64) * (1e9 / config.fps)).round().long()
        poses = self._poses()
        self._truth = Trajectory(t_ns, poses)
        if config.moving_share > 0:
            self.world = with_companion(self.world, poses, config.fps, config.moving_share, config.seed)
        self.gains, self.offsets = _exposure(config)

    @property
    def name(self) -> str:
        return f"synthetic_{self.config.world}"

    @property
    def camera(self) -> Camera:
        return self._camera

    @property
    def length(self) -> int:
        return self.config.frames

    @property
    def truth(self) -> Trajectory:
        return self._truth

    @property
    def rig(self) -> Rig | None:
        """The stereo pair, its body the first camera; None for a single camera."""
        return self._rig

    @property
    def imu(self) -> ImuSensor | None:
        return None if self.synthetic_imu is None else self.synthetic_imu.sensor

    @cached_property
    def synthetic_imu(self) -> SyntheticImu | None:
        """The IMU with its true biases and offset; None without one."""
        config = self.config
        if config.imu_rate == 0:
            return None
        setup = ImuSetup(
            se3(
                so3_exp(torch.deg2rad(torch.tensor(config.imu_turn_deg, dtype=torch.float64))),
                torch.tensor(config.imu_lever, dtype=torch.float64),
            ),
            rate_hz=config.imu_rate,
            noise=config.imu_noise,
            bias=config.imu_bias,
            offset_s=config.imu_offset_ms / 1e3,
            gap_s=config.imu_gap_s,
            seed=config.seed + 2,
        )
        return make_imu(lambda time: self._poses(time * config.fps), (config.frames - 1) / config.fps, setup)

    def _poses(self, at: Float64[Tensor, "N"] | None = None) -> Float64[Tensor, "N 4 4"]:
        """Return T_world_cam of all frames, or anywhere between them."""
        config = self.config
        return trajectory(
            config.motion,
            self.world.walkway,
            config.frames,
            config.fps,
            seed=config.seed,
            yaw_jump_deg=config.yaw_jump_deg,
            at=at,
        )

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
        return self._render(index, self.pose(index))

    def _render(
        self, index: int, T_world_cam: Float64[Tensor, "4 4"]
    ) -> tuple[Float[Tensor, "3 H W"], Float[Tensor, "H W"]]:
        return self.world.render(self._rays, T_world_cam, t=index / self.config.fps)

    def range(self, index: int) -> Float[Tensor, "H W"]:
        """Return the exact range of every pixel's centre in the camera's measure, metres; inf for the sky."""
        return self.render(index)[1]

    def frame(self, index: int) -> Frame:
        """Return a frame; of a stereo pair with the second camera's image, under the same exposure.

        Raises:
            InputError: The index is not one of the sequence.
        """
        T_world_first, t_ns = self.pose(index), int(self.truth.t_ns[index])
        if abs(index - (len(self) - 1) / 2) / self.config.fps < self.config.blackout_s / 2:
            black = np.zeros((self.config.height, self.config.width, 3), np.uint8)
            others = () if self.rig is None else (black,) * (len(self.rig.cameras) - 1)
            return Frame(index, t_ns, black, "black", others=others)
        generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + index)
        colour, reach = self._render(index, T_world_first)
        image = self._expose(index, colour, generator)
        others = () if self.rig is None else self.rig.T_body_cam[1:]
        looks = (self._render(index, T_world_first @ T_first_other)[0] for T_first_other in others)
        further = tuple(self._expose(index, colour, generator) for colour in looks)
        depth, noise = None, self.config.depth_noise
        if noise is not None:
            depth = sensed_depth(reach, noise, self.config.depth_holes, self.config.seed * 1_000_003 + index)
        return Frame(index, t_ns, image, others=further, depth=depth)

    def _expose(
        self, index: int, colour: Float[Tensor, "3 H W"], generator: torch.Generator
    ) -> UInt8[np.ndarray, "H W 3"]:
        """Return the image that a frame's exposure makes of colours, with noise drawn next from the generator."""
        image = colour * float(self.gains[index]) + float(self.offsets[index])
        if self.config.noise > 0:
            image += self.config.noise * torch.randn(image.shape, generator=generator)
        pixels = image.clamp_(0, 1).mul_(255).round_().to(torch.uint8).permute(1, 2, 0)
        return np.ascontiguousarray(pixels.numpy())

    def _checked(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise InputError(f"index: expected 0 to {len(self) - 1}, got {index}.")
        return index


def _camera(config: SyntheticConfig) -> Camera:
    if config.camera == "equirectangular":
        return Equirectangular(config.width, config.height)
    focal = config.width / 2 / math.tan(math.radians(config.fov_deg) / 2)
    return Pinhole(config.width, config.height, focal, focal, config.width / 2, config.height / 2)


def _rig(config: SyntheticConfig, camera: Camera) -> Rig | None:
    if config.stereo_baseline == 0:
        return None
    T_body_cam = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    T_body_cam[1, STEREO_AXES.index(config.stereo_axis), 3] = config.stereo_baseline
    return Rig((camera, camera), T_body_cam)


def _exposure(config: SyntheticConfig) -> tuple[Float64[Tensor, "N"], Float64[Tensor, "N"]]:
    """Return the gain and the offset of every frame; those of the first are 1 and 0, but for jumps."""
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
    elif config.exposure == "jumps":
        gains = torch.where(index // STEP_FRAMES % 2 == 1, JUMP**0.5, JUMP**-0.5).double()
    elif config.exposure == "drift":
        swing = torch.sin(index.double() / config.fps * 1.3)
        gains, offsets = torch.exp(swing * math.log(1.4)), -0.02 * swing
    return gains, offsets
