"""How cost grows: of the kernel and of `align` with pixels, points and batch, of the odometry with points and window.

    python benchmarks/growth.py [--backend auto] [--only kernel align odometry]

Least CPU time of some calls on one thread (of a frame, on average, for the odometry: 90 rendered frames of 512 x 256),
and that over what the smallest size would make it if cost were proportional.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterator
from functools import partial

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read once, when OpenMP starts

import torch

from accuracy import measure, settings
from bad_days import rendered
from peers import make_pairs, ours
from ratios import dense
from torchvo360.backends import BACKENDS, backend, linearize
from torchvo360.residuals.weights import LossConfig

Call = Callable[[], object]
PARTS = ("kernel", "align", "odometry")
ODOMETRY = {"map.points": (500, 1000, 2000, 4000), "window.keyframes": (4, 6, 8, 10)}
"""Settings of the odometry and their values."""


def least_ms(call: Call, seconds: float) -> float:
    """Return the least CPU time of a call."""
    call()
    best, end, count = float("inf"), time.perf_counter() + seconds, 0
    while count < 3 or time.perf_counter() < end:
        began = time.process_time()
        call()
        best, count = min(best, time.process_time() - began), count + 1
    return 1e3 * best


def kernels() -> Iterator[tuple[str, int, Call]]:
    """Yield the kernel's calls: what they are, how large, and the call."""
    loss = LossConfig()
    for width in (128, 256, 512, 1024, 2048):
        yield "pixels of one pair, all", width * width // 2, partial(linearize, *dense(1, width, width // 2), loss)
    reference, target, T, affine = dense(1, 640, 320)
    shuffled = torch.randperm(640 * 320, generator=torch.Generator().manual_seed(0))
    for count in (1000, 3000, 10000, 30000):
        at = shuffled[:count]
        points = type(reference)(
            reference.ray[..., at], reference.rho[:, at], reference.value[..., at], reference.weight[:, at]
        )
        yield "points of a pair of 640 x 320", count, partial(linearize, points, target, T, affine, loss)
    for batch in (1, 2, 4, 8, 16, 32):
        yield "pairs of 256 x 128, all pixels", batch, partial(linearize, *dense(batch, 256, 128), loss)


def alignments(name: str) -> Iterator[tuple[str, int, Call]]:
    """Yield calls of `align`, likewise."""
    for width in (128, 256, 512):
        yield "align, pixels of one pair", width * width // 2, partial(ours(name), make_pairs(1, width, width // 2))
    for batch in (1, 2, 4, 8, 16):
        yield "align, pairs of 256 x 128", batch, partial(ours(name), make_pairs(batch, 256, 128))


def frames_ms(key: str, value: int) -> float:
    """Return the CPU time of a frame of the odometry with one setting changed."""
    config = settings("default", [f"vo.{key}={value}"], clean=True)
    row, _ = measure(rendered(world="room", seed=0, frames=90, width=512, height=256), config)
    return 1e3 / row.cpu_fps


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", choices=BACKENDS, default="auto")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seconds", type=float, default=1.0, help="time spent on each size")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"torch {torch.__version__}, one thread, backend {arguments.backend}\n")
    print("| what | how many | CPU ms | to proportional |\n| --- | --- | --- | --- |")
    first: dict[str, tuple[int, float]] = {}

    def row(what: str, size: int, ms: float) -> None:
        least, ms_of_least = first.setdefault(what, (size, ms))
        print(f"| {what} | {size} | {ms:.2f} | {ms / (ms_of_least * size / least):.2f} |", flush=True)

    with torch.no_grad(), backend(arguments.backend):
        calls = [*(kernels() if "kernel" in arguments.only else ())]
        calls += alignments(arguments.backend) if "align" in arguments.only else ()
        for what, size, call in calls:
            row(what, size, least_ms(call, arguments.seconds))
        for key, values in ODOMETRY.items() if "odometry" in arguments.only else ():
            for value in values:
                row(f"odometry, vo.{key}", value, frames_ms(key, value))


if __name__ == "__main__":
    main()
