"""The C++ yardstick that benchmarks compare with: its module, its data as the library's types, and timing in turn."""

import importlib.util
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Protocol

from torch import Tensor

from torchvo360 import Equirectangular, lie
from torchvo360.residuals.direct import Reference, Target, make_target

YARDSTICK = Path(__file__).parents[1] / ".." / "shared" / "yardstick"


def load_yardstick(folder: Path) -> ModuleType:
    """Import the yardstick's module, which is no package, without leaving compiled files beside it."""
    sys.dont_write_bytecode = True
    spec = importlib.util.spec_from_file_location("yardstick_common", folder / "common.py")
    if spec is None or spec.loader is None or not (folder / "kernel.cpp").is_file():
        raise SystemExit(f"--yardstick: expected a folder with common.py and kernel.cpp, got {folder}.")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class YardstickData(Protocol):
    """Pairs as the yardstick makes them, float32."""

    B: int
    H: int
    W: int
    N: int
    I1: Tensor
    I2: Tensor
    rho: Tensor
    R: Tensor
    t: Tensor
    ab: Tensor


def library_problem(data: YardstickData) -> tuple[Reference, Target, Tensor, Tensor]:
    """Put the yardstick's pairs into the library's types, with their solid angles as weights."""
    camera = Equirectangular(data.W, data.H)
    area = camera.solid_angle(camera.pixel_grid())
    reference = Reference(
        ray=camera.ray_grid().permute(2, 0, 1).reshape(1, 3, -1).contiguous(),
        rho=data.rho.reshape(data.B, -1),
        value=data.I1.reshape(data.B, 1, -1),
        weight=(area / area.mean()).flatten().expand(data.B, -1).contiguous(),
    )
    T = lie.se3(data.R.double(), data.t.double())
    return reference, make_target(data.I2[:, None], camera), T, data.ab.double()


def alternate(first: Callable[[], object], second: Callable[[], object], seconds: float) -> list[tuple[float, float]]:
    """Time two calls in turn, in milliseconds of CPU: what else the machine does hardly changes them."""
    for _ in range(3):
        first()
        second()
    times: list[tuple[float, float]] = []
    end = time.perf_counter() + seconds
    while len(times) < 15 or time.perf_counter() < end:
        a = time.process_time()
        first()
        b = time.process_time()
        second()
        times.append(((b - a) * 1e3, (time.process_time() - b) * 1e3))
    return times
