"""What the layer's implicit backward pass costs, and that its memory does not depend on the steps.

    python benchmarks/bench_backward.py --yardstick ../shared/yardstick

First table: one implicit backward pass (gradients of the pose by both images, the inverse ranges and the weights)
against the C++ pass that linearises the same pairs forward, in turn, in one run, on one thread. Second table: `align`
with 5 and with 50 steps, forward and backward: what the graph keeps between the passes, and the most memory that the
process took, in a process of its own.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # read once, when OpenMP starts

import torch
from torch import Tensor

from torchvo360 import AlignConfig, Equirectangular, align
from torchvo360.alignment.backward import attach_solution
from torchvo360.alignment.pyramid import Level
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import LMConfig
from yardstick import YARDSTICK, YardstickData, alternate, library_problem, load_yardstick

SIZE = (256, 512)
"""Height and width of the images whose memory is measured."""


def backward_of(data: YardstickData) -> tuple[Tensor, list[Tensor]]:
    """Return poses with their implicit gradients, and what these flow to."""
    reference, target, T, affine = library_problem(data)
    leaves = [value.clone().requires_grad_() for value in (reference.value, reference.rho, reference.weight)]
    image = target.padded.clone().requires_grad_()
    value, rho, weight = leaves
    level = Level(replace(reference, value=value, rho=rho, weight=weight), replace(target, padded=image))
    everything = torch.ones(data.B, dtype=torch.bool)
    free = torch.ones(8, dtype=torch.bool)
    found = attach_solution(level, (T, affine), everything, AlignConfig(loss=LossConfig(scale=data.k)), free)
    return found[0], [*leaves, image]


def print_costs(folder: Path, seconds: float) -> None:
    """Print a row for each size."""
    common = load_yardstick(folder)
    with tempfile.TemporaryDirectory() as scratch:
        library = common.build(name=str(Path(scratch) / "libkernel.so"))
        print(f"torch {torch.__version__}, one thread, load {os.getloadavg()[0]:.1f}")
        print("B x H x W     | C++ ms med | backward ms med | ratio min, med")
        for B, H, W in common.SIZES:
            data = common.Data(B, H, W)
            native = common.Cpp(library, data, 0)
            T, leaves = backward_of(data)
            mix = torch.linspace(-1, 1, T.numel(), dtype=T.dtype).reshape(T.shape)

            def backward(T: Tensor = T, mix: Tensor = mix, leaves: list[Tensor] = leaves) -> None:
                torch.autograd.grad((T * mix).sum(), leaves, retain_graph=True)

            cpp, ours = zip(*alternate(native, backward, seconds), strict=True)
            middle = statistics.median
            ratio = middle(b / a for a, b in zip(cpp, ours, strict=True))
            print(
                f"{B:2} x {H:3} x {W:4} | {middle(cpp):10.2f} | {middle(ours):15.2f} | "
                f"{min(ours) / min(cpp):4.1f} {ratio:4.1f}",
                flush=True,
            )


def print_memory(steps: int, backward: str) -> None:
    """Align a noisy pair with so many steps, go back, and print what it took."""
    height, width = SIZE
    camera = Equirectangular(width, height)
    ray = camera.ray_grid()
    generator = torch.Generator().manual_seed(0)
    wave = (ray @ (6 * torch.randn(3, 40, generator=generator))).sin().mean(-1)
    noise = 0.1 * torch.randn(2, height, width, generator=generator)
    ref, tgt = (0.5 + wave + noise)[:, None].requires_grad_().split(1)
    rho = torch.full((1, height, width), 0.4, requires_grad=True)
    # All steps are worked through, whatever they gain.
    config = AlignConfig(
        levels=1,
        backward=backward,
        steps_by_level=[steps],
        min_agreement=0.0,
        solver=LMConfig(fixed_steps=True, step_tolerance=1e-12, cost_tolerance=1e-15),
    )
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        result = align(ref, tgt, rho, camera, config=config)
    result.T_tgt_ref.sum().backward()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{backward:9} | {steps:5} | {sum(kept.values()) / 2**20:14.1f} | {peak:11.0f}", flush=True)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--yardstick", type=Path, default=YARDSTICK, help="folder with common.py and kernel.cpp")
    parser.add_argument("--seconds", type=float, default=4.0, help="time spent on each size")
    parser.add_argument("--memory", nargs=2, metavar=("MODE", "STEPS"), help="only measure this process' memory")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.memory is not None:
        print_memory(int(arguments.memory[1]), arguments.memory[0])
        return
    print_costs(arguments.yardstick.resolve(), arguments.seconds)
    print("\nbackward  | steps | graph keeps MB | peak RSS MB", flush=True)
    for mode in ("implicit", "unroll"):
        for steps in ("5", "50"):
            subprocess.run([sys.executable, __file__, "--memory", mode, steps], check=True)


if __name__ == "__main__":
    main()
