"""Odometry in metres without a truth to scale it by: rigs of two cameras, and single cameras with an IMU.

    python benchmarks/metric.py stereo
    python benchmarks/metric.py inertial --seeds 0 1 2

The IMU has EuRoC-grade noise, unknown biases, a lever arm and a turn against the camera. Errors are of SE(3): the
scale is the odometry's own.
"""

import argparse
import math
from dataclasses import dataclass

import cv2
import torch

from torchvo360.data.registration import similarity_from_points
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.evaluation import evaluate
from torchvo360.vo import OdometryConfig, OdometryResult, VisualOdometry

WORLDS = ("room", "pillars", "courtyard")
PANORAMA = {"width": 512, "height": 256}
PINHOLE = {"camera": "pinhole", "width": 320, "height": 240}
DOWN = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)


@dataclass(frozen=True)
class Row:
    """What one run came to."""

    name: str
    seed: int
    scale_percent: float
    ate_percent: float
    worst_cm: float
    gravity_deg: float
    dark_cm: float
    maps: int

    HEADER = f"{'name':28} seed  scale %   ATE %  worst cm  gravity deg  dark cm  maps"

    def __str__(self) -> str:
        return (
            f"{self.name:28} {self.seed:4d} {self.scale_percent:8.3f} {self.ate_percent:7.4f} {self.worst_cm:9.2f} "
            f"{self.gravity_deg:12.4f} {self.dark_cm:8.2f} {self.maps:5d}"
        )


def measure(name: str, settings: SyntheticConfig) -> Row:
    """Run the odometry over a synthetic sequence with whatever it brings beside its images."""
    sequence = SyntheticSequence(settings)
    odometry = VisualOdometry(sequence.camera, OdometryConfig(blur_px=0.5), rig=sequence.rig, imu=sequence.imu)
    with torch.inference_mode():
        dark = [estimate.reason == "bad_frame_black" for estimate in map(odometry.step, sequence)]
        result = odometry.finish()
    found, true = result.trajectory.positions, sequence.truth.positions
    T = similarity_from_points(found, true, with_scale=False)
    assert T is not None
    off = torch.linalg.vector_norm(found @ T[:3, :3].mT + T[:3, 3] - true, dim=-1)
    bridged = 100 * float(off[torch.tensor(dark)].max()) if any(dark) else math.nan
    return Row(
        name=name,
        seed=settings.seed,
        scale_percent=100 * (evaluate(result.trajectory, sequence.truth).scale - 1),
        ate_percent=100 * float(off.square().mean().sqrt()) / sequence.truth.path_length,
        worst_cm=100 * float(off.max()),
        gravity_deg=_gravity_error_deg(result, sequence),
        dark_cm=bridged,
        maps=result.maps,
    )


def _gravity_error_deg(result: OdometryResult, sequence: SyntheticSequence) -> float:
    if result.gravity is None:
        return math.nan
    gravity = torch.tensor(result.gravity, dtype=torch.float64)
    down = sequence.pose(0)[:3, :3].mT @ DOWN
    return math.degrees(math.acos(min(1.0, float(down @ gravity / gravity.norm()))))


def runs(suite: str, seeds: list[int]) -> list[tuple[str, SyntheticConfig]]:
    """Return the runs of a suite, by name."""
    out = []
    for world in WORLDS:
        for seed in seeds:
            both = {"world": world, "seed": seed}
            if suite == "stereo":
                out.append((f"{world}, panoramas", {**both, **PANORAMA, "stereo_baseline": 0.2, "stereo_axis": "y"}))
                out.append((f"{world}, pinholes", {**both, **PINHOLE, "stereo_baseline": 0.1}))
            else:
                inertial = {**both, "imu_rate": 200.0, "frames": 300}
                out.append((f"{world}, panorama", {**inertial, **PANORAMA}))
                out.append((f"{world}, panorama, 2 s dark", {**inertial, **PANORAMA, "blackout_s": 2.0}))
                out.append((f"{world}, pinhole", {**inertial, **PINHOLE}))
    return [(name, SyntheticConfig(**settings)) for name, settings in out]


def main() -> None:
    """Print a row for every run of a suite."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", choices=("stereo", "inertial"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    print(Row.HEADER)
    for name, settings in runs(arguments.suite, arguments.seeds):
        print(measure(name, settings), flush=True)


if __name__ == "__main__":
    main()
