"""What one linearisation costs against a hand-written AVX-512 pass in C++, in one run, on one thread.

    python benchmarks/bench_linearize.py --yardstick ../shared/yardstick

The yardstick's folder holds `common.py` (the problem and the C++ calls) and `kernel.cpp`, which is compiled into a
temporary folder with g++. Both passes linearise the same pairs: spherical, eight parameters, Huber loss; the yardstick
samples a precomputed gradient field with the image, the library takes the derivative of the bilinear interpolant from
the image itself. Errors of H and g are against float64 sums of the same numbers. Timings alternate, so that both meet
the same load; the ratios of neighbouring timings are what to trust.
"""

import argparse
import os
import statistics
import tempfile
from dataclasses import replace
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # read once, when OpenMP starts

import torch
from torch import Tensor

from torchvo360.backends import linearize
from torchvo360.residuals.direct import Reference, Target
from torchvo360.residuals.weights import LossConfig
from yardstick import YARDSTICK, alternate, library_problem, load_yardstick


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


def error_of(problem: tuple[Reference, Target, Tensor, Tensor], loss: LossConfig) -> tuple[float, float]:
    """Return the largest relative errors of H and g over the batch against float64."""
    reference, target, T, affine = problem
    found, truth = linearize(*problem, loss), linearize(*in_float64(reference, target), T, affine, loss)
    H, g = (
        float(((a - b).flatten(1).norm(dim=1) / b.flatten(1).norm(dim=1)).max())
        for a, b in ((found.H, truth.H), (found.g, truth.g))
    )
    return H, g


def main() -> None:
    """Print a row for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--yardstick", type=Path, default=YARDSTICK, help="folder with common.py and kernel.cpp")
    parser.add_argument("--seconds", type=float, default=4.0, help="time spent on each size")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    common = load_yardstick(arguments.yardstick.resolve())
    with tempfile.TemporaryDirectory() as folder:
        # The yardstick names its library and its source by one folder: join that of the source with an absolute path.
        library = common.build(name=str(Path(folder) / "libkernel.so"))
        print(f"torch {torch.__version__}, one thread, load {os.getloadavg()[0]:.1f}")
        print("B x H x W     | C++ ms min, med | library ms     | ratio     | error of H, g (cell borders too)")
        for B, H, W in common.SIZES:
            data = common.Data(B, H, W)
            loss = LossConfig(scale=data.k)
            native = common.Cpp(library, data, 0)
            problem = library_problem(data)
            times = alternate(native, lambda problem=problem, loss=loss: linearize(*problem, loss), arguments.seconds)
            plain = error_of(problem, loss)
            inner = error_of((off_cell_borders(problem[0], problem[1], problem[2]), *problem[1:]), loss)

            cpp, ours = zip(*times, strict=True)
            middle = statistics.median
            print(
                f"{B:2} x {H:3} x {W:4} | {min(cpp):6.2f} {middle(cpp):6.2f} | {min(ours):6.2f} {middle(ours):6.2f} | "
                f"{min(ours) / min(cpp):4.1f} {middle(b / a for a, b in times):4.1f} | "
                f"{inner[0]:.0e} {inner[1]:.0e} ({plain[0]:.0e} {plain[1]:.0e})",
                flush=True,
            )


if __name__ == "__main__":
    main()
