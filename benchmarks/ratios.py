"""Ratios of costs that mean the same on every machine: to the eager kernel, to OpenCV's remap, to plain torch.

    python benchmarks/ratios.py                 # a row for each, beside the baseline
    python benchmarks/ratios.py --write         # measure the baseline anew: tests/benchmarks/baseline.json

Two calls are timed in turn on one thread, by their CPU time; the ratio is that of the least times. `remap` is OpenCV's
bilinear look-up of one image of the same size at random small shifts: what the kernel's look-up alone costs in C++.
`jacfwd` is the alignment of benchmarks/peers.py in plain torch. Memory is the most that a call takes over what was
there before, in units of one of its images, and what five hundred calls of changing sizes leave behind, in MB.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read once, when OpenMP starts

import cv2
import numpy as np
import torch
from torch import Tensor

from peers import jacfwd, make_pairs, memory_mb, ours
from torchvo360 import Equirectangular, lie
from torchvo360.backends import eager, numba
from torchvo360.backends.select import has_numba
from torchvo360.residuals.direct import Reference, Target, make_target
from torchvo360.residuals.weights import LossConfig
from yardstick import alternate

BASELINE = Path(__file__).parents[1] / "tests" / "benchmarks" / "baseline.json"
Call = Callable[[], object]
Problem = tuple[Reference, Target, Tensor, Tensor]


def dense(B: int, width: int, height: int) -> Problem:
    """Return pairs of random panoramas, all of whose pixels count."""
    camera, generator = Equirectangular(width, height), torch.Generator().manual_seed(0)
    value = torch.rand(B, 1, height, width, generator=generator)
    reference = Reference(
        camera.ray_grid().permute(2, 0, 1).flatten(1)[None].contiguous(),
        torch.rand(B, width * height, generator=generator),
        value.flatten(2),
        torch.ones(B, width * height),
    )
    xi = 0.05 * torch.randn(B, 6, generator=generator, dtype=torch.float64)
    return reference, make_target(value, camera), lie.se3_exp(xi), torch.zeros(B, 2).double()


def remap(width: int, height: int) -> Call:
    """Return OpenCV's bilinear look-up of one image of this size."""
    random = np.random.default_rng(0)
    image = random.random((height, width), np.float32)
    v, u = np.mgrid[:height, :width].astype(np.float32)
    u, v = (grid + random.random(grid.shape, np.float32) for grid in (u, v))
    return partial(cv2.remap, image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def cases() -> dict[str, tuple[Call, Call]]:
    """Return what is compared, by name: a call of this library, and the one that it is measured against."""
    loss = LossConfig()
    one, small, several = dense(1, 512, 256), dense(1, 256, 128), dense(8, 256, 128)
    pairs = make_pairs(2, 128, 64)
    found: dict[str, tuple[Call, Call]] = {
        "eager kernel / remap, 1 x 256 x 512": (partial(eager.linearize, *one, loss), remap(512, 256)),
        "eager align / jacfwd, 2 x 64 x 128": (partial(ours("eager"), pairs), partial(jacfwd, pairs)),
    }
    if has_numba():
        found |= {
            f"numba kernel / eager kernel, {size}": (
                partial(numba.linearize, *problem, loss),
                partial(eager.linearize, *problem, loss),
            )
            for size, problem in (("1 x 256 x 512", one), ("1 x 128 x 256", small), ("8 x 128 x 256", several))
        }
        found["numba kernel / remap, 1 x 256 x 512"] = (partial(numba.linearize, *one, loss), remap(512, 256))
        found["numba align / jacfwd, 2 x 64 x 128"] = (partial(ours("auto"), pairs), partial(jacfwd, pairs))
    return found


def ratio_of(name: str, seconds: float = 2.0) -> float:
    """Measure one of the cases."""
    call, other = cases()[name]
    with torch.no_grad():
        times = alternate(other, call, seconds)
    theirs, mine = (min(column) for column in zip(*times, strict=True))
    return mine / theirs


def peak_images() -> float:
    """Return the most memory that the eager kernel takes for a pair of 1024 x 512, in float32 images of that size.

    It is measured in a process of its own that has given back what lay free in it.
    """
    code = """if True:
        import ctypes, torch
        from peers import memory_mb, reset_peak
        from ratios import LossConfig, dense, eager
        torch.set_num_threads(1)
        torch.set_grad_enabled(False)
        problem = dense(1, 1024, 512)
        eager.linearize(*dense(1, 64, 32), LossConfig())
        ctypes.CDLL(None).malloc_trim(0)
        reset_peak()
        before_mb = memory_mb("VmRSS")
        eager.linearize(*problem, LossConfig())
        print((memory_mb("VmHWM") - before_mb) / 2)
    """
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, check=True, capture_output=True)
    return float(done.stdout)


def grown_mb() -> float:
    """Return what five hundred eager linearisations of changing sizes leave behind, after as many before."""
    loss = LossConfig()
    reference, target, T, affine = dense(1, 512, 256)
    generator = torch.Generator().manual_seed(1)
    before_mb = 0.0
    with torch.no_grad():
        for call in range(1000):
            if call == 500:
                before_mb = memory_mb("VmRSS")
            count = int(torch.randint(1000, 20000, (), generator=generator))
            eager.linearize(reference.chunk(0, count), target, T, affine, loss)
    return memory_mb("VmRSS") - before_mb


def main() -> None:
    """Print all ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="make these the baseline")
    parser.add_argument("--seconds", type=float, default=4.0, help="time spent on each")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    baseline = json.loads(BASELINE.read_text(encoding="utf-8")) if BASELINE.is_file() else {}
    found = {name: round(ratio_of(name, arguments.seconds), 3) for name in cases()}
    print("| ratio | now | baseline |\n| --- | --- | --- |")
    for name, ratio in found.items():
        print(f"| {name} | {ratio:.2f} | {baseline.get(name, float('nan')):.2f} |")
    print(f"\npeak of the eager kernel at 1024 x 512: {peak_images():.1f} images of that size")
    print(f"growth over 500 calls of changing sizes: {grown_mb():.1f} MB")
    if arguments.write:
        BASELINE.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
