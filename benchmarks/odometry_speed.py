"""Frames a second of whole runs, decoding and output included; the memory they take; batches of odometries.

    python benchmarks/odometry_speed.py runs walk.mp4 --override camera.fit=stretch mask=below:-18
    python benchmarks/odometry_speed.py memory walk.mp4
    python benchmarks/odometry_speed.py batch

`runs` starts the command once for each preset and backend and takes its whole time, starting Python included;
`memory` samples the resident memory of one run; `batch` advances 1, 2, 4 and 8 synthetic walks together. All print
markdown rows.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from torchvo360 import OdometryBatch, VisualOdometry
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence


def run(path: str, overrides: list[str]) -> tuple[int, float, float, float]:
    """Run the command; return frames, seconds of the whole process, frames a second as it says, and peak MB."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        command = [sys.executable, "-m", "torchvo360", f"input={path}", f"out={out}", "progress=false", *overrides]
        began = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - began
        summary = json.loads((out / "summary.json").read_text())
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return summary["frames"], seconds, summary["fps"], peak


def runs(path: str, overrides: list[str], presets: list[str], backends: list[str]) -> None:
    """Time the command."""
    print("| preset | backend | frames | whole run, frames a second | reading and stepping | overlap | peak MB |")
    for preset in presets:
        for backend in backends:
            for overlap in ("true", "false"):
                given = [f"vo={preset}", f"backend={backend}", f"vo.overlap={overlap}", *overrides]
                frames, seconds, fps, peak = run(path, given)
                row = [preset, backend, frames, f"{frames / seconds:.1f}", f"{fps:.1f}", overlap, f"{peak:.0f}"]
                print("|", " | ".join(map(str, row)), "|", flush=True)


def memory(path: str, overrides: list[str]) -> None:
    """Sample the resident memory of a run by its frames."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "torchvo360", f"input={path}", f"out={folder}/out", *overrides]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        samples, began = [], time.perf_counter()
        while process.poll() is None:
            lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
            resident = next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS")), 0.0)
            samples.append((time.perf_counter() - began, resident))
            time.sleep(0.2)
        frames = json.loads(Path(f"{folder}/out/summary.json").read_text())["frames"]
    peak = max(resident for _, resident in samples)
    # The run's time is taken as even: start and output are a few percent of it.
    first = next(resident for at, resident in samples if at > samples[-1][0] * 300 / frames)
    last = next(resident for at, resident in reversed(samples) if at < samples[-1][0] * 0.9)
    growth = (last - first) / (0.9 * frames - 300)
    print(f"| {frames} frames | peak {peak:.0f} MB | after 300 frames {growth:.3f} MB a frame |")


def batch(sizes: list[int], frames: int) -> None:
    """Advance synthetic walks together; frames are rendered before."""
    torch.set_num_threads(1)
    walks = [SyntheticSequence(SyntheticConfig(width=512, height=256, frames=frames, seed=seed)) for seed in range(8)]
    rendered = [list(walk) for walk in walks[: max(sizes)]]
    print("| odometries | frames a second, all together |")
    for size in sizes:
        odometries = [VisualOdometry(walk.camera) for walk in walks[:size]]
        began = time.perf_counter()
        with torch.inference_mode():
            OdometryBatch(odometries).run(rendered[:size])
        print(f"| {size} | {size * frames / (time.perf_counter() - began):.1f} |", flush=True)


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["runs", "memory", "batch"])
    parser.add_argument("input", nargs="?", default="clip")
    parser.add_argument("--override", nargs="*", default=[])
    parser.add_argument("--presets", nargs="*", default=["default", "fast"])
    parser.add_argument("--backends", nargs="*", default=["auto"])
    parser.add_argument("--sizes", nargs="*", type=int, default=[1, 2, 4, 8])
    parser.add_argument("--frames", type=int, default=80)
    given = parser.parse_args()
    if given.what == "runs":
        runs(given.input, given.override, given.presets, given.backends)
    elif given.what == "memory":
        memory(given.input, given.override)
    else:
        batch(given.sizes, given.frames)


if __name__ == "__main__":
    main()
