"""What one linearisation costs against a hand-written AVX-512 pass in C++, in one run, on one thread.

    python benchmarks/bench_linearize.py --yardstick ../shared/yardstick [--compiled]

The yardstick's folder holds `common.py` (the problem and the C++ calls) and `kernel.cpp`, which is compiled into a
temporary folder with g++. Both passes linearise the same pairs: spherical, eight parameters, Huber loss; the yardstick
samples a precomputed gradient field with the image, the library takes the derivative of the bilinear interpolant from
the image itself. Errors of H and g are against float64 sums of the same numbers. Timings alternate, so that both meet
the same load; the ratios of neighbouring timings are what to trust. Where numba is installed, its kernel has columns of
its own; its start is timed in a process of its own, and how it serves the few points of tracking against the eager one.
--compiled adds the kernel of torch.compile, after a minute or two of compiling. Times are of CPU.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # read once, when OpenMP starts

import torch
from torch import Tensor

from torchvo360 import Equirectangular
from torchvo360.backends import compiled, eager, numba
from torchvo360.backends.select import has_numba
from torchvo360.residuals.direct import Reference, Target, make_target
from torchvo360.residuals.normal import NormalEquations
from torchvo360.residuals.weights import LossConfig
from yardstick import YARDSTICK, alternate, library_problem, load_yardstick

Problem = tuple[Reference, Target, Tensor, Tensor]
Linearize = Callable[..., NormalEquations]


def in_float64(reference: Reference, target: Target) -> tuple[Reference, Target]:
    """Return the same numbers in float64."""
    points = Reference(
        reference.ray.double(), reference.rho.double(), reference.value.double(), reference.weight.double()
    )
    return points, Target(target.camera, target.padded.double())


def off_cell_borders(reference: Reference, target: Target, T: Tensor) -> Reference:
    """Take the weight of points within 1e-4 px of the border of two of the interpolant's cells.

    Its slope jumps there, and rounding decides on which side a float32 pixel falls.
    """
    Y = T[:, :3, :3] @ reference.ray.double() + reference.rho.double()[:, None] * T[:, :3, 3:]
    uv = torch.stack(target.camera.pixel_of(*Y.unbind(1)), -1)
    inside = ((uv + 0.5) % 1 - 0.5).abs().amax(-1) < 0.5 - 1e-4
    return replace(reference, weight=reference.weight * inside)


def error_of(linearize: Linearize, problem: Problem, loss: LossConfig) -> tuple[float, float]:
    """Return the largest relative errors of H and g over the batch against float64."""
    reference, target, T, affine = problem
    found, truth = linearize(*problem, loss), eager.linearize(*in_float64(reference, target), T, affine, loss)
    H, g = (
        float(((a - b).flatten(1).norm(dim=1) / b.flatten(1).norm(dim=1)).max())
        for a, b in ((found.H, truth.H), (found.g, truth.g))
    )
    return H, g


def few_points(B: int, count: int) -> Problem:
    """Return random points of random panoramas of 640 x 320: as few as tracking has."""
    camera, generator = Equirectangular(640, 320), torch.Generator().manual_seed(0)
    ray = camera.ray(torch.rand(count, 2, generator=generator) * torch.tensor([640.0, 320.0])).T[None].contiguous()
    rho, value = torch.rand(B, count, generator=generator), torch.rand(B, 1, count, generator=generator)
    target = make_target(torch.rand(B, 1, 320, 640, generator=generator), camera)
    T, affine = torch.eye(4).double().repeat(B, 1, 1), torch.zeros(B, 2).double()
    return Reference(ray, rho, value, torch.ones(B, count)), target, T, affine


def seconds_to_start() -> tuple[float, float]:
    """Return the seconds of wall and of CPU that numba's first call takes in a new process, from its cache."""
    code = """if True:
        import time, torch
        torch.set_num_threads(1)
        from bench_linearize import few_points, LossConfig, numba
        problem, loss = few_points(1, 3000), LossConfig()
        wall, cpu = time.perf_counter(), time.process_time()
        numba.linearize(*problem, loss)
        print(time.perf_counter() - wall, time.process_time() - cpu)
    """
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, check=True, capture_output=True)
    wall, cpu = map(float, done.stdout.split())
    return wall, cpu


def main() -> None:
    """Print a row for each size and kernel."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--yardstick", type=Path, default=YARDSTICK, help="folder with common.py and kernel.cpp")
    parser.add_argument("--seconds", type=float, default=4.0, help="time spent on each size and kernel")
    parser.add_argument("--compiled", action="store_true", help="measure torch.compile's kernel, too")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    kernels: dict[str, Linearize] = {"eager": eager.linearize}
    if has_numba():
        kernels["numba"] = numba.linearize
    if arguments.compiled:
        kernels["compiled"] = compiled.linearize
    common = load_yardstick(arguments.yardstick.resolve())
    middle = statistics.median
    with tempfile.TemporaryDirectory() as folder:
        # The yardstick names its library and its source by one folder: join that of the source with an absolute path.
        library = common.build(name=str(Path(folder) / "libkernel.so"))
        print(f"torch {torch.__version__}, one thread, load {os.getloadavg()[0]:.1f}")
        print(
            "B x H x W     | kernel   | C++ ms min, med | kernel ms      | ratio     | error of H, g (cell borders too)"
        )
        for B, H, W in common.SIZES:
            data = common.Data(B, H, W)
            loss = LossConfig(scale=data.k)
            native = common.Cpp(library, data, 0)
            problem = library_problem(data)
            inside = (off_cell_borders(problem[0], problem[1], problem[2]), *problem[1:])
            for name, linearize in kernels.items():
                times = alternate(native, partial(linearize, *problem, loss), arguments.seconds)
                cpp, ours = zip(*times, strict=True)
                outer, inner = error_of(linearize, problem, loss), error_of(linearize, inside, loss)
                print(
                    f"{B:2} x {H:3} x {W:4} | {name:8} | {min(cpp):6.2f} {middle(cpp):6.2f} | "
                    f"{min(ours):6.2f} {middle(ours):6.2f} | "
                    f"{min(ours) / min(cpp):4.1f} {middle(b / a for a, b in times):4.1f} | "
                    f"{inner[0]:.0e} {inner[1]:.0e} ({outer[0]:.0e} {outer[1]:.0e})",
                    flush=True,
                )
    if "numba" not in kernels:
        return
    for B in (1, 8):
        problem = few_points(B, 3000)
        plain, fast = (partial(kernels[name], *problem, LossConfig()) for name in ("eager", "numba"))
        times = alternate(plain, fast, arguments.seconds)
        torchs, ours = (min(column) * 1e3 for column in zip(*times, strict=True))
        print(f"{B} x 3000 points: eager {torchs:.0f} us, numba {ours:.0f} us, ratio {ours / torchs:.2f}")
    starts = [seconds_to_start() for _ in range(5)]
    wall, cpu = (min(column) for column in zip(*starts, strict=True))
    print(f"numba's first call, from its cache: {wall:.2f} s, of CPU {cpu:.2f} s")


if __name__ == "__main__":
    main()
