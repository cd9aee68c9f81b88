"""What `align` costs beside other solvers of the same problem: PyPose, Theseus and plain torch with `jacfwd`.

    python benchmarks/peers.py [--only eager numba jacfwd ...] [--batch 8] [--size 256x128] [--repeat 3]

Eight pairs of panoramas in textured boxes, each with a motion of 2 to 4 deg and 3 to 7 cm and a change of brightness;
every solver starts from the identity, has eight parameters a pair and is given the same images, inverse ranges and
weights by solid angle. The peers take the images as they are, without a pyramid, by Levenberg-Marquardt, and stop where
the cost falls by less than 1e-5 of itself. Each row is a process of its own, on one thread:

    CPU s           least CPU time of all pairs, of some runs
    rot deg, t mm   largest errors over the pairs
    steps           of the slowest pair; of `align`, over all levels of the pyramid
    peak MB         memory over what was taken before

Theseus and PyPose are no dependencies: rows of what is not installed are left out. How they are installed:
docs/benchmarks.md.
"""

import argparse
import importlib.util
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read once, when OpenMP starts

import torch
from jaxtyping import Float
from torch import Tensor

from torchvo360 import AlignConfig, Equirectangular, align, lie
from torchvo360.backends import backend

ROOM_M = torch.tensor([2.0, 1.2, 2.6], dtype=torch.float64)
"""Half the sides of the box."""
NOISE = 0.002
TOLERANCE = 1e-5
MOST_STEPS = 30


@dataclass(frozen=True)
class Pairs:
    """What is aligned, and the truth."""

    camera: Equirectangular
    ref: Float[Tensor, "B 1 H W"]
    tgt: Float[Tensor, "B 1 H W"]
    rho: Float[Tensor, "B H W"]
    T_tgt_ref: Float[Tensor, "B 4 4"]


@dataclass(frozen=True)
class Solved:
    """What a solver says."""

    T_tgt_ref: Float[Tensor, "B 4 4"]
    steps: int


Solver = Callable[[Pairs], Solved]


# What is aligned


def make_pairs(batch: int, width: int, height: int, seed: int = 0) -> Pairs:
    """Render pairs inside textured boxes."""
    camera = Equirectangular(width, height)
    generator = torch.Generator().manual_seed(seed)
    ray = camera.ray_grid(dtype=torch.float64)
    parts = [_render(ray, generator) for _ in range(batch)]
    ref, tgt, rho, T = (torch.stack(part) for part in zip(*parts, strict=True))
    return Pairs(camera, ref[:, None].float(), tgt[:, None].float(), rho.float(), T)


def _render(ray: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    def uniform(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator, dtype=torch.float64)

    def direction(*size: int) -> Tensor:
        vector = torch.randn(*size, 3, generator=generator, dtype=torch.float64)
        return torch.nn.functional.normalize(vector, dim=-1)

    xi = torch.cat([direction() * (0.03 + 0.04 * uniform(1)), direction() * torch.deg2rad(2 + 2 * uniform(1))])
    T_tgt_ref = lie.se3_exp(xi)
    length_m, wave, phase = 0.6 * 5 ** uniform(28), direction(28), math.tau * uniform(28)
    amplitude = length_m.sqrt() / (length_m.sum() / 2).sqrt()

    def seen(T_room_cam: Tensor) -> tuple[Tensor, Tensor]:
        way, at = ray @ T_room_cam[:3, :3].mT, T_room_cam[:3, 3]
        wall = torch.where(way > 0, ROOM_M, -ROOM_M)
        range_m = ((wall - at) / way).nan_to_num(nan=math.inf).amin(-1)
        point = at + range_m[..., None] * way
        value = ((point @ (wave * (math.tau / length_m)[:, None]).T + phase).sin() * amplitude).sum(-1)
        noise = NOISE * torch.randn(value.shape, generator=generator, dtype=torch.float64)
        return 0.5 + 0.15 * value + noise, 1 / range_m

    T_room_ref = lie.se3(torch.eye(3, dtype=torch.float64), 0.8 * (uniform(3) - 0.5))
    ref, rho = seen(T_room_ref)
    tgt, _ = seen(T_room_ref @ lie.se3_inverse(T_tgt_ref))
    gain, offset = (0.3 * (uniform(1) - 0.5)).exp(), 0.1 * (uniform(1) - 0.5)
    return ref, gain * tgt + offset, rho, T_tgt_ref


# This library


def ours(name: str) -> Solver:
    """Return `align` with its defaults but for gradients, on a backend."""

    def run(pairs: Pairs) -> Solved:
        with backend(name):
            result = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera, config=AlignConfig(backward="none"))
        return Solved(result.T_tgt_ref, int(result.steps.max()))

    return run


# The residual as its users would write it for a library that differentiates it


@dataclass(frozen=True)
class Problem:
    """Points, intensities and roots of weights, flat, float32."""

    point: Float[Tensor, "B N 3"]
    value: Float[Tensor, "B N"]
    wrapped: Float[Tensor, "B H W+2"]
    root: Float[Tensor, "N"]

    @classmethod
    def of(cls, pairs: Pairs) -> "Problem":
        """Put points at their ranges, and a column of the other side on each side of the targets."""
        camera, tgt = pairs.camera, pairs.tgt[:, 0]
        area = camera.solid_angle(camera.pixel_grid())
        return cls(
            point=(camera.ray_grid() / pairs.rho[..., None]).flatten(1, 2),
            value=pairs.ref.flatten(1),
            wrapped=torch.cat([tgt[..., -1:], tgt, tgt[..., :1]], -1),
            root=(area / area.mean()).sqrt().flatten(),
        )

    def residual(self, R: Tensor, t: Tensor, ab: Tensor, k: int) -> Float[Tensor, "N"]:
        """Return the weighted residuals of a pair."""
        return residual(R, t, ab, self.point[k], self.value[k], self.wrapped[k], self.root)


def residual(
    R: Tensor, t: Tensor, ab: Tensor, point: Tensor, value: Tensor, wrapped: Tensor, root: Tensor
) -> Float[Tensor, "N"]:
    """Return the weighted residuals of one pair: project, look up bilinearly, compare."""
    height, width = wrapped.shape[0], wrapped.shape[1] - 2
    x, y, z = (point @ R.mT + t).unbind(-1)
    u = (torch.atan2(x, z) / math.tau + 0.5) * width + 0.5
    v = (torch.atan2(y, (x * x + z * z + 1e-12).sqrt()) / math.pi + 0.5) * height - 0.5
    v = v.clamp(0.0, height - 1.001)
    left, top = u.detach().floor(), v.detach().floor()
    corner = top.long() * (width + 2) + left.long().clamp(0, width)
    flat = wrapped.reshape(-1)
    across, down = u - left, v - top
    upper = torch.lerp(flat[corner], flat[corner + 1], across)
    lower = torch.lerp(flat[corner + width + 2], flat[corner + width + 3], across)
    return root * (torch.lerp(upper, lower, down) - ab[0].exp() * value - ab[1])


def moved(step: Float[Tensor, "6"], R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return exp(step) T to the second order in the rotation's angle, whose derivative at 0 is exact."""
    v, w = step[:3], step[3:]
    zero = torch.zeros_like(w[0])
    W = torch.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).view(3, 3)
    eye = torch.eye(3, dtype=step.dtype)
    dR = eye + W + W @ W / 2
    return dR @ R, dR @ t + v


def jacfwd(pairs: Pairs) -> Solved:
    """Solve by Jacobians of `torch.func.jacfwd`, one matrix product and `torch.linalg.solve`, damped for each pair."""
    problem = Problem.of(pairs)
    B = len(pairs.ref)

    def local(step: Tensor, R: Tensor, t: Tensor, ab: Tensor, point: Tensor, value: Tensor, image: Tensor) -> Tensor:
        return residual(*moved(step[:6], R, t), ab + step[6:], point, value, image, problem.root)

    residuals, jacobians = torch.func.vmap(local), torch.func.vmap(torch.func.jacfwd(local))
    data = (problem.point, problem.value, problem.wrapped)
    T, ab = torch.eye(4).repeat(B, 1, 1), torch.zeros(B, 2)
    damping, going = torch.full((B,), 1e-4), torch.ones(B, dtype=torch.bool)
    steps, zero = 0, torch.zeros(B, 8)
    with torch.no_grad():
        while going.any() and steps < MOST_STEPS:
            steps += 1
            state = (T[:, :3, :3], T[:, :3, 3], ab)
            r, J = residuals(zero, *state, *data), jacobians(zero, *state, *data)
            H, g, cost = J.mT @ J, (J.mT @ r[..., None])[..., 0], r.square().sum(-1)
            step = -torch.linalg.solve(H + torch.diag_embed(damping[:, None] * H.diagonal(dim1=1, dim2=2)), g)
            T_new, ab_new = (lie.se3_exp(step[:, :6].double()) @ T.double()).float(), ab + step[:, 6:]
            new_cost = residuals(zero, T_new[:, :3, :3], T_new[:, :3, 3], ab_new, *data).square().sum(-1)
            better = going & (new_cost < cost)
            T, ab = torch.where(better[:, None, None], T_new, T), torch.where(better[:, None], ab_new, ab)
            damping = torch.where(better, damping / 10, damping * 10)
            going = going & (cost - new_cost > TOLERANCE * cost)
    return Solved(T, steps)


# Libraries


def pypose_jointly(pairs: Pairs) -> Solved:
    """Solve all pairs in one of PyPose's modules, whose Jacobian holds every pair by every other's parameters."""
    import pypose as pp

    problem, B = Problem.of(pairs), len(pairs.ref)

    class Model(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.step = torch.nn.Parameter(torch.zeros(B, 6))
            self.ab = torch.nn.Parameter(torch.zeros(B, 2))

        def forward(self, _: Tensor) -> Tensor:
            poses = [full_motion(step) for step in self.step]
            return torch.stack([problem.residual(*poses[k], self.ab[k], k) for k in range(B)])[..., None]

    model = Model()
    strategy = pp.optim.strategy.Adaptive(damping=1e-4)
    optimizer = pp.optim.LM(model, solver=pp.optim.solver.Cholesky(), strategy=strategy)
    optimizer.jackwargs = {"vectorize": True, "strategy": "forward-mode"}
    steps, last = 0, math.inf
    while steps < MOST_STEPS:
        steps += 1
        cost = float(optimizer.step(torch.zeros(1)))
        if last - cost <= TOLERANCE * cost:
            break
        last = cost
    with torch.no_grad():
        motions = [full_motion(step) for step in model.step]
    return Solved(torch.stack([lie.se3(R.double(), t.double()) for R, t in motions]), steps)


def full_motion(xi: Float[Tensor, "6"]) -> tuple[Tensor, Tensor]:
    """Return exp(xi) as rotation and translation, by its series: for angles below one."""
    v, w = xi[:3], xi[3:]
    zero, square = torch.zeros_like(w[0]), w @ w
    W = torch.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).view(3, 3)
    a = 1 - square / 6 + square**2 / 120
    b = 0.5 - square / 24 + square**2 / 720
    c = 1 / 6 - square / 120 + square**2 / 5040
    eye = torch.eye(3)
    return eye + a * W + b * W @ W, (eye + b * W + c * W @ W) @ v


def pypose_one_by_one(pairs: Pairs) -> Solved:
    """Solve pair after pair."""
    parts = [
        pypose_jointly(Pairs(pairs.camera, pairs.ref[k], pairs.tgt[k], pairs.rho[k], pairs.T_tgt_ref[k]))
        for k in torch.arange(len(pairs.ref)).split(1)
    ]
    return Solved(torch.cat([part.T_tgt_ref for part in parts]), max(part.steps for part in parts))


def theseus(mode: str) -> Solver:
    """Return Theseus' Levenberg-Marquardt, differentiating by itself in a mode."""

    def run(pairs: Pairs) -> Solved:
        import theseus as th  # pyright: ignore[reportMissingImports]: optional

        problem, B = Problem.of(pairs), len(pairs.ref)
        N = problem.value.shape[1]
        T = th.SE3(tensor=torch.eye(4)[:3].repeat(B, 1, 1), name="T")
        ab = th.Vector(tensor=torch.zeros(B, 2), name="ab")
        data = [th.Variable(getattr(problem, name), name=name) for name in ("point", "value", "wrapped")]

        def error(optim_vars: list, aux_vars: list) -> Tensor:
            pose, affine = (variable.tensor for variable in optim_vars)
            point, value, wrapped = (variable.tensor for variable in aux_vars)
            return torch.stack(
                [
                    residual(pose[k, :, :3], pose[k, :, 3], affine[k], point[k], value[k], wrapped[k], problem.root)
                    for k in range(len(pose))
                ]
            )

        dense = {"autograd_vectorize": True, "autograd_strategy": "forward-mode", "autograd_create_graph": False}
        options = {"autograd_mode": mode, **(dense if mode == "dense" else {})}
        weight = th.ScaleCostWeight(1.0)
        cost = th.AutoDiffCostFunction([T, ab], error, N, aux_vars=data, cost_weight=weight, name="direct", **options)
        objective = th.Objective()
        objective.add(cost)
        optimizer = th.LevenbergMarquardt(
            objective,
            linear_solver_cls=th.CholeskyDenseSolver,
            vectorize=False,
            max_iterations=MOST_STEPS,
            abs_err_tolerance=0.0,
            rel_err_tolerance=TOLERANCE,
        )
        layer = th.TheseusLayer(optimizer, vectorize=False)
        damped = {"damping": 1e-4, "adaptive_damping": True, "ellipsoidal_damping": True}
        with torch.no_grad():
            found, info = layer.forward({"T": T.tensor.clone(), "ab": ab.tensor.clone()}, optimizer_kwargs=damped)
        last = info.converged_iter
        steps = int(last.max()) if bool((last >= 0).all()) else MOST_STEPS
        pose = found["T"].double()
        return Solved(lie.se3(pose[:, :, :3], pose[:, :, 3]), steps)

    return run


SOLVERS: dict[str, tuple[str, Solver]] = {
    "eager": ("torch", ours("eager")),
    "numba": ("numba", ours("auto")),
    "jacfwd": ("torch", jacfwd),
    "pypose": ("pypose", pypose_jointly),
    "pypose_loop": ("pypose", pypose_one_by_one),
    "theseus": ("theseus", theseus("dense")),
}
"""By name: the module that it needs, and what solves."""


# Measurement


def measure(name: str, pairs: Pairs, repeat: int) -> dict[str, float]:
    """Return the figures of a row."""
    solver = SOLVERS[name][1]
    solver(make_pairs(1, 64, 32))  # imports, thread pools and compiled kernels
    before_mb, seconds, solved = memory_mb("VmRSS"), math.inf, None
    reset_peak()
    for _ in range(repeat):
        began = time.process_time()
        solved = solver(pairs)
        seconds = min(seconds, time.process_time() - began)
    assert solved is not None
    E = lie.se3_inverse(pairs.T_tgt_ref) @ solved.T_tgt_ref.double()
    return {
        "seconds": seconds,
        "rotation_deg": math.degrees(float(lie.so3_angle(E[:, :3, :3]).max())),
        "translation_mm": 1e3 * float((solved.T_tgt_ref.double() - pairs.T_tgt_ref)[:, :3, 3].norm(dim=-1).max()),
        "steps": solved.steps,
        "peak_mb": memory_mb("VmHWM") - before_mb,
    }


def memory_mb(name: str) -> float:
    """Return a figure of /proc/self/status, as VmRSS."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(name + ":"))


def reset_peak() -> None:
    """Begin VmHWM, the most memory so far, anew."""
    Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")


def main() -> None:
    """Print a row for each solver that is installed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=SOLVERS, default=list(SOLVERS))
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--size", default="256x128", help="width and height of the panoramas")
    parser.add_argument("--repeat", type=int, default=3, help="runs of each solver, of which the fastest counts")
    parser.add_argument("--row", choices=SOLVERS, help="only measure this solver, in this process")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.row is not None:
        width, height = map(int, arguments.size.split("x"))
        print(json.dumps(measure(arguments.row, make_pairs(arguments.batch, width, height), arguments.repeat)))
        return
    print(f"{arguments.batch} pairs of {arguments.size}, torch {torch.__version__}, one thread\n")
    print("| solver | CPU s | to the first | rot deg (worst) | t mm (worst) | steps | peak MB |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    first = None
    for name in arguments.only:
        if importlib.util.find_spec(SOLVERS[name][0]) is None:
            print(f"{name}: {SOLVERS[name][0]} is not installed, so that it is left out.", flush=True)
            continue
        passed = ["--batch", str(arguments.batch), "--size", arguments.size, "--repeat", str(arguments.repeat)]
        command = [sys.executable, "-W", "ignore", __file__, "--row", name, *passed]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        row = json.loads(done.stdout.splitlines()[-1])
        first = first or row["seconds"]
        print(
            f"| {name} | {row['seconds']:.3f} | {row['seconds'] / first:.1f} | {row['rotation_deg']:.4f} | "
            f"{row['translation_mm']:.2f} | {row['steps']} | {row['peak_mb']:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
