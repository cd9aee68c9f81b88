"""Recordings that go wrong: frames that are black, missing, doubled or out of order, and views that are covered.

A recording is a list of frame numbers of a source that is read again each time, so that no more than one frame is
held. Faults are of two kinds: another order of the frames (`in_order`), or another image in a frame's place
(`with_images`). The true poses go with them. benchmarks/accuracy.py measures `synthetic_days` and `walk_days`.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from torchvo360.cameras import Camera
from torchvo360.data.frame import Frame
from torchvo360.data.images import Images, judge
from torchvo360.data.selection import Selection
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import se3, so3_exp

STEP_NS = 33_333_333
"""Time between two frames of a recording."""
READ_AHEAD = 50
"""Frames held where a source that is read forwards is asked for backwards."""
JUMP_FRAMES = 20
"""Frames between two jumps of the exposure."""

Image = UInt8[np.ndarray, "H W 3"]
Reader = Callable[[Sequence[int]], Iterator[Frame]]
"""Yields frames of a source by their numbers, in any order."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames as a camera would have delivered them: numbered and timed anew, judged as a file's are."""

    name: str
    camera: Camera
    read: Reader
    """Frames of the source by their numbers, in the order asked for."""
    length: int
    T_world_cam: Mapping[int, Float64[Tensor, "4 4"]]
    """True poses, by number; some may be missing."""
    index: tuple[int, ...]
    """Index of each frame, which increases; its time is `index * STEP_NS`."""

    @classmethod
    def of(cls, sequence: SyntheticSequence) -> "Recording":
        """Take a rendered sequence."""
        poses = dict(enumerate(sequence.truth.T_world_cam))
        length = len(sequence)
        return cls(sequence.name, sequence.camera, _by_number(sequence.frame), length, poses, tuple(range(length)))

    @classmethod
    def of_images(cls, images: Images, length: int, T_world_cam: Mapping[int, Float64[Tensor, "4 4"]]) -> "Recording":
        """Take the first frames of a whole video or folder."""

        def read(numbers: Sequence[int]) -> Iterator[Frame]:
            return _read_images(images, numbers)

        poses = {number: T for number, T in T_world_cam.items() if number < length}
        return cls(images.name, images.camera, read, length, poses, tuple(range(length)))

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[Frame]:
        for index, frame in zip(self.index, self.read(range(self.length)), strict=True):
            yield replace(frame, index=index, t_ns=index * STEP_NS)

    @property
    def truth(self) -> Trajectory:
        """The known true poses at the times of the frames."""
        known = sorted(self.T_world_cam)
        t_ns = torch.tensor([self.index[number] * STEP_NS for number in known])
        return Trajectory(t_ns, torch.stack([self.T_world_cam[number] for number in known]))

    def held(self) -> "Recording":
        """Return the same recording with all its frames in memory, for a short one that is read many times."""
        frames = list(self)
        return replace(self, read=_by_number(frames.__getitem__))

    def in_order(self, order: Sequence[int], *, keeps_times: bool = False) -> "Recording":
        """Return the frames in another order, some left out or repeated.

        Args:
            order: Numbers of the frames; they increase where the times are kept.
            keeps_times: Whether each keeps its index and its time, or all are counted anew.
        """
        order = tuple(order)

        def read(numbers: Sequence[int]) -> Iterator[Frame]:
            return self.read([order[number] for number in numbers])

        poses = {k: self.T_world_cam[number] for k, number in enumerate(order) if number in self.T_world_cam}
        index = tuple(self.index[number] for number in order) if keeps_times else tuple(range(len(order)))
        return replace(self, read=read, length=len(order), T_world_cam=poses, index=index)

    def with_images(self, change: Callable[[int, Image], Image]) -> "Recording":
        """Return the recording with each image replaced by `change(number, image)`, and judged as a reader would."""

        def read(numbers: Sequence[int]) -> Iterator[Frame]:
            for number, frame in zip(numbers, self.read(numbers), strict=True):
                image = None if frame.image is None else np.ascontiguousarray(change(number, frame.image))
                yield frame if image is None else replace(frame, image=image, problem=judge(image))

        return replace(self, read=read)

    def turned(self, columns: Sequence[int]) -> "Recording":
        """Return the recording of a camera that was turned about its vertical: image k moves right by columns[k]."""
        angle = torch.tensor(columns, dtype=torch.float64)[:, None] * (math.tau / self.camera.width)
        R_turned_cam = so3_exp(angle * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
        T_cam_turned = se3(R_turned_cam.mT, torch.zeros(len(columns), 3, dtype=torch.float64))
        out = self.with_images(lambda number, image: np.roll(image, columns[number], 1))
        return replace(out, T_world_cam={k: T @ T_cam_turned[k] for k, T in self.T_world_cam.items()})


def _by_number(frame: Callable[[int], Frame]) -> Reader:
    return lambda numbers: map(frame, numbers)


def _read_images(images: Images, numbers: Sequence[int]) -> Iterator[Frame]:
    """Read a source that only goes forwards: one pass for every stretch of numbers that does not fall."""
    if len(numbers) > 1 and all(after < before for before, after in pairwise(numbers)):
        for begin in range(0, len(numbers), READ_AHEAD):
            part = numbers[begin : begin + READ_AHEAD]
            yield from reversed(list(_read_images(images, part[::-1])))
        return
    begin = 0
    while begin < len(numbers):
        end = begin + 1
        while end < len(numbers) and numbers[end] >= numbers[end - 1]:
            end += 1
        wanted = numbers[begin:end]
        passing = iter(Images(images.source, images.fit, Selection(wanted[0], wanted[-1] + 1, 1)))
        at, frame = wanted[0], next(passing)
        for number in wanted:
            while at < number:
                at, frame = at + 1, next(passing)
            yield frame
        begin = end


# Faults of frames


def black_frames(recording: Recording, at: int, count: int = 10) -> Recording:
    """Make frames black, as with a cap on the lens."""
    return recording.with_images(lambda k, image: np.zeros_like(image) if at <= k < at + count else image)


def dropped_frames(recording: Recording, lost: Sequence[int]) -> Recording:
    """Leave frames out; the others keep their times."""
    missing = set(lost)
    return recording.in_order([k for k in range(len(recording)) if k not in missing], keeps_times=True)


def doubled_frames(recording: Recording, doubled: Sequence[int]) -> Recording:
    """Deliver frames a second time in place of the next one, as a camera that stutters."""
    order = list(range(len(recording)))
    for k in doubled:
        order[k + 1] = order[k]
    return recording.in_order(order)


def jump_back(recording: Recording, at: int, by: int = 100, count: int | None = None) -> Recording:
    """Go on, from a frame on, with what was seen some frames before: ..., at - 1, at - by, at - by + 1, ...

    Args:
        recording: The frames.
        at: Number of the first frame after the jump.
        by: How far it goes back.
        count: Frames after the jump; all that are left by default.
    """
    count = len(recording) - at if count is None else count
    return recording.in_order([*range(at), *range(at - by, at - by + count)])


def exposure_jumps(recording: Recording, every: int = JUMP_FRAMES) -> Recording:
    """Let the exposure jump by two stops again and again, half and twice the intensities, clipped at 255."""

    def change(number: int, image: Image) -> Image:
        return cv2.convertScaleAbs(image, alpha=2.0 if number // every % 2 else 0.5)

    return recording.with_images(change)


def yaw_jump(recording: Recording, at: int, jump_deg: float = 30.0) -> Recording:
    """Turn the camera about its vertical between two frames."""
    columns = round(recording.camera.width * jump_deg / 360)
    return recording.turned([columns if k >= at else 0 for k in range(len(recording))])


def noise(recording: Recording, deviation: float, seed: int = 0) -> Recording:
    """Add noise of its own to each pixel and channel; its standard deviation is in intensities of [0, 1]."""

    def change(number: int, image: Image) -> Image:
        drawn = np.random.default_rng([seed, number]).standard_normal(image.shape, dtype=np.float32)
        return np.rint(image + 255 * deviation * drawn).clip(0, 255).astype(np.uint8)

    return recording.with_images(change)


def covered(recording: Recording, share: float, mask: Tensor | None = None, seed: int = 0, start: int = 0) -> Recording:
    """Put a round textured patch before the camera, which sways about and carries its texture with it.

    Args:
        recording: Frames of a panorama.
        share: Part of the solid angle that may be used and is covered while the patch is in its middle place.
        mask: Pixels that may be used; all by default.
        seed: Of the texture.
        start: First frame that is covered.
    """
    ray = recording.camera.ray_grid(dtype=torch.float64)
    area = recording.camera.solid_angle(recording.camera.pixel_grid(dtype=torch.float64))
    area = area if mask is None else area * mask
    elevation = -math.asin(float((area * ray[..., 1]).sum() / area.sum()))
    cosine = ray @ _direction(0.0, elevation)
    order = cosine.flatten().argsort(descending=True)
    gone = area.flatten()[order].cumsum(0) / area.sum()
    edge = float(cosine.flatten()[order[int((gone < share).sum())]])
    texture = _texture(seed)
    points = ray.float()

    def change(number: int, image: Image) -> Image:
        if number < start:
            return image
        t = number / 30
        forward = _direction(0.7 * math.sin(1.3 * t) + 0.25 * t, elevation + 0.1 * math.sin(0.9 * t)).float()
        side = torch.nn.functional.normalize(torch.tensor([float(forward[2]), 0.0, -float(forward[0])]), dim=0)
        down = torch.linalg.cross(forward, side)
        near = points @ forward
        angle = near.clamp(-1, 1).acos()
        radial = angle / (1 - near * near).clamp_min(1e-9).sqrt() * (len(texture) / math.pi)
        u, v = (points @ side) * radial + len(texture), (points @ down) * radial + len(texture) / 2
        patch = cv2.remap(texture, u.numpy(), v.numpy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return np.where((near > edge).numpy()[..., None], patch, image)

    return recording.with_images(change)


def half_sky(recording: Recording, mask: Tensor | None = None, share: float = 0.5) -> Recording:
    """Replace the upper part of the view, a share of the solid angle that may be used, by a sky without clouds."""
    camera = recording.camera
    area = camera.solid_angle(camera.pixel_grid(dtype=torch.float64))
    area = area if mask is None else area * mask
    rows = int((area.sum(1).cumsum(0) / area.sum() < share).sum())
    row = np.arange(camera.height, dtype=np.float32)[:, None, None]
    down = (row / rows).clip(0, 1)
    sky = (1 - down) * np.array([120, 160, 215], np.float32) + down * np.array([190, 205, 225], np.float32)
    # haze at its lower edge, which turns with the camera and must not be a landmark
    ground = ((row - rows) / (camera.height / 16) + 0.5).clip(0, 1)

    def change(number: int, image: Image) -> Image:
        return np.rint(ground * image + (1 - ground) * sky).astype(np.uint8)

    return recording.with_images(change)


def _direction(lon: float, lat: float) -> Float64[Tensor, "3"]:
    """Return the unit ray at a longitude and a latitude, radians."""
    ray = [math.cos(lat) * math.sin(lon), -math.sin(lat), math.cos(lat) * math.cos(lon)]
    return torch.tensor(ray, dtype=torch.float64)


def _texture(seed: int) -> UInt8[np.ndarray, "H W 3"]:
    """Return colours as smooth as those of clothes in a compressed video, 512 rows."""
    generator = torch.Generator().manual_seed(seed)
    fu, fv = torch.fft.rfftfreq(1024), torch.fft.fftfreq(512)[:, None]
    frequency = torch.hypot(fu, fv)
    frequency[0, 0] = torch.inf
    spectrum = torch.fft.rfft2(torch.randn(4, 512, 1024, generator=generator))
    field: Float[Tensor, "4 H W"] = torch.fft.irfft2(spectrum / frequency**1.5, s=(512, 1024))
    field = field / field.std((-2, -1), keepdim=True)
    colour = 0.45 + 0.18 * field[3] + 0.06 * field[:3]
    return (255 * colour.clamp(0, 1)).round().byte().permute(1, 2, 0).contiguous().numpy()


# The days that are measured


def rendered(**settings: object) -> Recording:
    """Return a synthetic recording of 512 x 256 with the given settings of SyntheticConfig."""
    return Recording.of(SyntheticSequence(SyntheticConfig(**{"width": 512, "height": 256, **settings})))  # pyright: ignore[reportArgumentType]


def order_faults(recording: Recording) -> Iterator[tuple[str, Recording]]:
    """Yield the faults in order and delivery that any recording of 150 frames or more can have, with their names."""
    n = len(recording)
    yield "black", black_frames(recording, n // 2)
    yield "dropped_3_of_4", dropped_frames(recording, [k for k in range(n // 3, 2 * n // 3) if k % 4])
    yield "dropped_10", dropped_frames(recording, range(n // 2, n // 2 + 10))
    yield "doubled", doubled_frames(recording, range(n // 4, n - 1, 5))
    yield "jump_back", jump_back(recording, n, count=50)
    yield "yaw_jump", yaw_jump(recording, n // 2)


def synthetic_days(
    seed: int = 0, frames: int = 150, size: tuple[int, int] = (512, 256)
) -> Iterator[tuple[str, Recording]]:
    """Yield the bad days on rendered worlds, with their names."""
    shape = {"seed": seed, "frames": frames, "width": size[0], "height": size[1]}
    for name, settings in {
        "moving_tenth": {"moving_share": 0.1},
        "moving_third": {"moving_share": 1 / 3},
        "noise": {"world": "courtyard", "noise": 0.06},
        "exposure_jumps": {"world": "pillars", "exposure": "jumps"},
        "half_sky": {"world": "field"},
        "pause": {"motion": "pause"},
        "turn": {"motion": "turn", "frames": frames + 30},
        "turn_first": {"motion": "turn_first", "frames": frames + 30},
        "loop": {"world": "pillars", "motion": "loop", "frames": max(300, frames)},
        "turned_loop": {"world": "pillars", "motion": "turned_loop", "frames": max(300, frames)},
    }.items():
        yield name, rendered(**{**shape, **settings})
    yield from order_faults(rendered(**shape, world="pillars"))


def walk_days(walk: Recording, mask: Tensor | None) -> Iterator[tuple[str, Recording]]:
    """Yield the bad days that a real recording can be made to have, with their names."""
    yield "as_it_is", walk
    yield from order_faults(walk)
    yield "exposure_jumps", exposure_jumps(walk)
    yield "noise", noise(walk, 0.06)
    yield "moving_third", covered(walk, 1 / 3, mask)
    yield "half_sky", half_sky(walk, mask)
