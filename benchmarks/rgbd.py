"""Measure the alignment of RGB-D pairs, beside OpenCV's C++ odometry in the same run.

    python benchmarks/rgbd.py [--seeds 0 1] [--only synthetic rgbd] [--data ../shared/data/pinhole_rgbd]

`synthetic` are pairs of a walk through room, pillars and courtyard, 320 x 240, 1 to 10 frames apart, both with 1 % of
noise in their depth. `rgbd` are five real frames of a Kinect and `dense_rgbd` five rendered ones, 640 x 480: all
neighbours in both directions that share at least a fifth of what they see. Each is measured as it is and with the
target's brightness changed, by a gain of 1.3 and an offset of 0.05. Every method starts from the identity. A line is:

    t mm, worst     error of the translation, median and largest
    r deg, worst    of the rotation
    right           share of the pairs that are right to within 10 cm and 3 deg
    claimed         share that the method calls a success, and how many of these are right
    ms              median time of a pair, of one thread's own

`cv2.Odometry` has its bounds widened to what the pairs hold (range 30 m, difference of depth 0.3 m, motion 2 m and
90 deg), without which it does worse. `align` is this library's, with the sensor's variance and all else by default but
the width of the coarsest level; `align, 63 starts` turns the camera in a batch at an eighth of a real image's width,
goes on from the turn that agrees best, and is asked only where `align` has not converged.
"""

import argparse
import itertools
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read once, when OpenMP starts

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from torch import Tensor

from torchvo360 import lie
from torchvo360.alignment import AlignConfig, AlignResult, align
from torchvo360.cameras import Pinhole
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.image import masked_pyramid
from torchvo360.solve import Status
from torchvo360.vo.sensor import SensorConfig, read_depth

SHARED = Path(__file__).parents[1] / ".." / "shared" / "data" / "pinhole_rgbd"
WORLDS = ("room", "pillars", "courtyard")
GAPS = range(1, 11)
GAIN, OFFSET = 1.3, 0.05
RIGHT_M, RIGHT_DEG = 0.1, 3.0
LEAST_SHARED = 0.2
CONFIG = AlignConfig(backward="none", coarsest_width=48)
"""A coarsest level of 20 x 15 pixels: pairs ten frames apart are twenty pixels apart at full size."""
TURNS_DEG = tuple(itertools.product((-20, 0, 20), (-45, -30, -15, 0, 15, 30, 45), (-20, 0, 20)))
SMALL = (80, 60)
CPU = torch.device("cpu")


@dataclass(frozen=True)
class Shot:
    """What an RGB-D camera gives at one moment."""

    colour: UInt8[np.ndarray, "H W 3"]
    depth: Float32[np.ndarray, "H W"]
    """z, metres; 0 where it is not known."""
    shows: Bool[np.ndarray, "H W"]
    """Pixels that are part of the picture: undistortion leaves a white frame."""


@dataclass(frozen=True)
class Pair:
    """Two of them with their true motion."""

    camera: Pinhole
    ref: Shot
    tgt: Shot
    T_tgt_ref: Float64[Tensor, "4 4"]


@dataclass(frozen=True)
class Answer:
    """What a method says of a pair."""

    T_tgt_ref: Float64[Tensor, "4 4"]
    claimed: bool
    seconds: float


Method = Callable[[Pair], Answer]


# What is aligned


def synthetic_pairs(seeds: list[int], gain: float, offset: float) -> Iterator[Pair]:
    """Yield pairs of all worlds and seeds."""
    for world, seed in itertools.product(WORLDS, seeds):
        config = SyntheticConfig(
            world=world, seed=seed, frames=40, camera="pinhole", width=320, height=240, depth_noise=0.01
        )
        sequence = SyntheticSequence(config)
        assert isinstance(sequence.camera, Pinhole)
        for number, gap in enumerate(GAPS):
            i, j = 3 * number, 3 * number + gap
            ref, tgt = (_shot_of(sequence, k) for k in (i, j))
            yield Pair(sequence.camera, ref, _brightened(tgt, gain, offset), _between(sequence.truth.T_world_cam, i, j))


def _shot_of(sequence: SyntheticSequence, index: int) -> Shot:
    frame = sequence.frame(index)
    assert frame.image is not None
    assert frame.depth is not None
    return Shot(frame.image, frame.depth, np.ones(frame.depth.shape, bool))


def _between(T_world_cam: Float64[Tensor, "N 4 4"], ref: int, tgt: int) -> Float64[Tensor, "4 4"]:
    return lie.se3_inverse(T_world_cam[tgt]) @ T_world_cam[ref]


def _brightened(shot: Shot, gain: float, offset: float) -> Shot:
    changed = np.clip(shot.colour * gain + 255 * offset, 0, 255)
    return Shot(changed.round().astype(np.uint8), shot.depth, shot.shows)


def recorded_pairs(folder: Path, gain: float, offset: float) -> Iterator[Pair]:
    """Yield the neighbours among five frames, in both directions, that see the same things."""
    rendered = folder.name == "dense_rgbd"
    scale, suffix = (5000, "png") if rendered else (1000, "pgm")
    # Pixel centres at integers become +0.5. The rendered frames' y points up, with fy = -480: turned upside down they
    # are those of a camera whose y points down the image, while every point keeps its coordinates.
    camera = Pinhole(640, 480, 481.2, 480.0, 320.0, 240.0) if rendered else Pinhole(640, 480, 518, 519, 326.0, 254.0)
    shots = []
    for number in range(1, 6):
        colour = cv2.imread(str(folder / "color" / f"{number}.png"))
        depth = cv2.imread(str(folder / "depth" / f"{number}.{suffix}"), cv2.IMREAD_UNCHANGED)
        if colour is None or depth is None:
            raise SystemExit(f"--data: expected images 1 to 5 in {folder}.")
        colour, metres = cv2.cvtColor(colour, cv2.COLOR_BGR2RGB), depth.astype(np.float32) / scale
        if rendered:
            colour, metres = np.ascontiguousarray(colour[::-1]), np.ascontiguousarray(metres[::-1])
        shots.append(Shot(colour, metres, ~_frame(colour)))
    rows = torch.from_numpy(np.loadtxt(folder / "pose.txt"))
    T_world_cam = lie.se3(lie.matrix_from_quaternion(rows[:, 3:]), rows[:, :3])
    for i, j in (*itertools.pairwise(range(5)), *itertools.pairwise(range(4, -1, -1))):
        T = _between(T_world_cam, i, j)
        if _shared(camera, shots[i].depth, T) >= LEAST_SHARED:
            yield Pair(camera, shots[i], _brightened(shots[j], gain, offset), T)


def _frame(colour: UInt8[np.ndarray, "H W 3"]) -> Bool[np.ndarray, "H W"]:
    """Return the white pixels that are connected with the image's edge."""
    white = (colour.min(-1) >= 250).astype(np.uint8)
    _, label = cv2.connectedComponents(white, connectivity=4)
    edge = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
    return np.isin(label, np.setdiff1d(edge, [0]))


def _shared(camera: Pinhole, depth: Float32[np.ndarray, "H W"], T_tgt_ref: Float64[Tensor, "4 4"]) -> float:
    """Return the share of the known pixels that the target's image holds."""
    z = torch.from_numpy(depth).double()[..., None]
    _, seen = camera.project((camera.ray_grid(dtype=torch.float64) * z) @ T_tgt_ref[:3, :3].mT + T_tgt_ref[:3, 3])
    return float(seen[torch.from_numpy(depth) > 0].double().mean())


# What aligns


def opencv(kind: int, algorithm: int) -> Method:
    """Return OpenCV's odometry of one kind."""

    def run(pair: Pair) -> Answer:
        camera, settings = pair.camera, cv2.OdometrySettings()
        K = [[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]]
        settings.setCameraMatrix(np.array(K, np.float32))
        settings.setMaxDepth(30.0)
        settings.setMaxDepthDiff(0.3)
        settings.setMaxTranslation(2.0)
        settings.setMaxRotation(90.0)
        odometry = cv2.Odometry(kind, settings, algorithm)
        began = time.process_time()
        frames = [cv2.OdometryFrame(s.depth, s.colour, s.shows.astype(np.uint8) * 255) for s in (pair.ref, pair.tgt)]
        odometry.prepareFrames(*frames)
        done, T = odometry.compute(*frames)  # pyright: ignore[reportCallIssue, reportArgumentType]: not in its stub
        seconds = time.process_time() - began
        return Answer(torch.eye(4, dtype=torch.float64) if T is None else torch.from_numpy(T), bool(done), seconds)

    return run


@dataclass(frozen=True)
class Prepared:
    """A pair as `align` takes it; NaN is unknown."""

    ref: Float[Tensor, "1 H W"]
    tgt: Float[Tensor, "1 H W"]
    rho: Float[Tensor, "H W"]
    variance: Float[Tensor, "H W"]

    @classmethod
    def of(cls, pair: Pair) -> "Prepared":
        """Take the grey values, and the depth with the noise of its sensor."""
        sensed = read_depth(pair.ref.depth, pair.camera, SensorConfig(), CPU)
        if sensed is None:
            raise SystemExit("--data: expected depth, got an image that knows nothing.")
        ref, tgt = (
            torch.from_numpy(cv2.cvtColor(s.colour, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255)[None]
            .masked_fill_(torch.from_numpy(~s.shows), torch.nan) for s in (pair.ref, pair.tgt)
        )  # fmt: skip
        return cls(ref, tgt, sensed.rho.masked_fill(torch.isinf(sensed.variance), torch.nan), sensed.variance)

    def smaller(self, camera: Pinhole) -> "Prepared":
        """Return the pair at a smaller camera's size."""

        def reduced(value: Tensor) -> Tensor:
            (mean, known), = masked_pyramid(value, torch.isfinite(value), [camera])  # fmt: skip
            return torch.where(known, mean, torch.nan)

        return Prepared(*(reduced(part) for part in (self.ref, self.tgt, self.rho, self.variance)))

    def aligned(self, camera: Pinhole, config: AlignConfig, T_tgt_ref: Float64[Tensor, "B 4 4"]) -> AlignResult:
        """Align the pair from some starts."""
        parts = (part.expand(len(T_tgt_ref), *part.shape) for part in (self.ref, self.tgt, self.rho, self.variance))
        ref, tgt, rho, variance = parts
        return align(ref, tgt, rho, camera, rho_variance=variance, T_tgt_ref=T_tgt_ref, config=config)


def ours(pair: Pair) -> Answer:
    """Align from the identity."""
    began = time.process_time()
    result = Prepared.of(pair).aligned(pair.camera, CONFIG, torch.eye(4, dtype=torch.float64)[None])
    return _answer(result, began)


def ours_widely(pair: Pair) -> Answer:
    """Align from the identity and, where that does not converge, from the best of a batch of turns."""
    began = time.process_time()
    prepared = Prepared.of(pair)
    result = prepared.aligned(pair.camera, CONFIG, torch.eye(4, dtype=torch.float64)[None])
    if int(result.status) != Status.CONVERGED:
        turns = torch.tensor(TURNS_DEG, dtype=torch.float64).deg2rad()
        starts = lie.se3(lie.so3_exp(turns), torch.zeros_like(turns))
        small = pair.camera.resized(*SMALL)
        # What sees less than an eighth of the image agrees by chance.
        config = AlignConfig(backward="none", min_pixels=math.prod(SMALL) // 8)
        tried = prepared.smaller(small).aligned(small, config, starts)
        best = int(torch.where(tried.status == int(Status.TOO_FEW_PIXELS), -1.0, tried.agreement).argmax())
        levels = 1 + round(math.log2(pair.camera.width / SMALL[0]))
        fine = AlignConfig(backward="none", levels=levels)
        again = prepared.aligned(pair.camera, fine, tried.T_tgt_ref[best : best + 1])
        result = again if float(again.agreement) > float(result.agreement) else result
    return _answer(result, began)


def _answer(result: AlignResult, began: float) -> Answer:
    return Answer(result.T_tgt_ref[0], int(result.status) == Status.CONVERGED, time.process_time() - began)


METHODS: dict[str, Method] = {
    "cv2 RGB": opencv(cv2.OdometryType_RGB, cv2.OdometryAlgoType_COMMON),
    "cv2 DEPTH": opencv(cv2.OdometryType_DEPTH, cv2.OdometryAlgoType_COMMON),
    "cv2 DEPTH, fast": opencv(cv2.OdometryType_DEPTH, cv2.OdometryAlgoType_FAST),
    "cv2 RGB_DEPTH": opencv(cv2.OdometryType_RGB_DEPTH, cv2.OdometryAlgoType_COMMON),
    "cv2 RGB_DEPTH, fast": opencv(cv2.OdometryType_RGB_DEPTH, cv2.OdometryAlgoType_FAST),
    "align": ours,
    "align, 63 starts": ours_widely,
}


def row(name: str, method: Method, pairs: list[Pair]) -> str:
    """Return one line of the table."""
    answers = [method(pair) for pair in pairs]
    E = [answer.T_tgt_ref @ lie.se3_inverse(pair.T_tgt_ref) for answer, pair in zip(answers, pairs, strict=True)]
    t = [float((a.T_tgt_ref - p.T_tgt_ref)[:3, 3].norm()) for a, p in zip(answers, pairs, strict=True)]
    r = [math.degrees(float(lie.so3_angle(error[:3, :3]))) for error in E]
    right = [a < RIGHT_M and b < RIGHT_DEG for a, b in zip(t, r, strict=True)]
    claimed = [good for answer, good in zip(answers, right, strict=True) if answer.claimed]
    ms = 1e3 * statistics.median(answer.seconds for answer in answers)
    return (
        f"    {name:20} {1e3 * statistics.median(t):8.2f} {1e3 * max(t):8.0f}  {statistics.median(r):7.4f} "
        f"{max(r):6.1f}  {sum(right):3d}/{len(pairs)}  {len(claimed):3d}, {sum(claimed):2d} right  {ms:7.1f}"
    )


def main() -> None:
    """Print a table for each set of pairs and each brightness."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=["synthetic", "rgbd", "dense_rgbd"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="of the synthetic worlds")
    parser.add_argument("--data", type=Path, default=SHARED, help="folder that holds rgbd and dense_rgbd")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for name, (gain, offset) in itertools.product(arguments.only, ((1.0, 0.0), (GAIN, OFFSET))):
        if name == "synthetic":
            pairs = list(synthetic_pairs(arguments.seeds, gain, offset))
        elif (arguments.data / name / "pose.txt").is_file():
            pairs = list(recorded_pairs(arguments.data / name, gain, offset))
        else:
            print(f"--data: no {name} in {arguments.data}, so that it is left out.", flush=True)
            continue
        way = statistics.median(float(pair.T_tgt_ref[:3, 3].norm()) for pair in pairs)
        turn = statistics.median(math.degrees(float(lie.so3_angle(pair.T_tgt_ref[:3, :3]))) for pair in pairs)
        apart = f"{len(pairs)} pairs, {1e3 * way:.0f} mm and {turn:.1f} deg apart"
        print(f"{name}, gain {gain:g}, offset {offset:g}: {apart} (medians)")
        print(f"    {'':20}     t mm    worst    r deg  worst  right    claimed          ms", flush=True)
        for method in METHODS:
            print(row(method, METHODS[method], pairs), flush=True)


if __name__ == "__main__":
    main()
