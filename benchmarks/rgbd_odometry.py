"""Measure the odometry with a depth sensor: scale, errors in metres, and what is left without the sensor.

    python benchmarks/rgbd_odometry.py [--seeds 0 1] [--frames 100]

Walks of a pinhole (320 x 240) and of a panorama (512 x 256) through three worlds; the sensor has 1 % of noise and sees
nothing in 40 % of the image. In the last runs frames 20 to 59 have no depth at all. Positions are compared after the
best rigid motion: the scale is the odometry's own. A line is:

    scale %         error of the scale
    ATE mm, %       root mean square of the positions' errors, and in percent of the path
    rot deg         median after the best constant rotation of the world
    states          initialising, tracking, weak, lost, relocalised
    fps             frames a second of one thread's own time, the odometry alone
"""

import argparse
import itertools
import os
import time
from collections import Counter
from dataclasses import replace

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read once, when OpenMP starts

import cv2
import torch

from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.evaluation import evaluate
from torchvo360.vo import OdometryConfig, State, VisualOdometry

WORLDS = ("room", "pillars", "courtyard")
CAMERAS = {"pinhole": (320, 240), "equirectangular": (512, 256)}
BLIND = range(20, 60)


def measure(name: str, settings: SyntheticConfig, blind: range) -> str:
    """Run the odometry over a walk and return its line."""
    sequence, seconds = SyntheticSequence(settings), 0.0
    odometry = VisualOdometry(sequence.camera, OdometryConfig(blur_px=0.5))
    with torch.inference_mode():
        for frame in sequence:
            given = replace(frame, depth=None) if frame.index in blind else frame
            began = time.process_time()
            odometry.step(given)
            seconds += time.process_time() - began
        result = odometry.finish()
    rigid = evaluate(result.trajectory, sequence.truth, align="se3")
    scale = evaluate(result.trajectory, sequence.truth).scale
    counts = Counter(estimate.state for estimate in result.frames)
    states = "/".join(str(counts[state]) for state in State)
    return (
        f"{name:40} {settings.seed:4d} {100 * (scale - 1):8.3f} {1e3 * rigid.ate_rmse_m:7.2f} {rigid.ate_percent:7.3f} "
        f"{rigid.rotation_median_deg:8.4f}  {states:>14} {len(result.frames) / seconds:6.1f}"
    )


def main() -> None:
    """Print a line for each camera, world and seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--frames", type=int, default=100)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    print(f"{'':40} seed  scale %  ATE mm   ATE %  rot deg          states    fps")
    for (camera, (width, height)), blind in itertools.product(CAMERAS.items(), (range(0), BLIND)):
        for world in WORLDS:
            for seed in arguments.seeds:
                settings = SyntheticConfig(
                    camera=camera,
                    world=world,
                    seed=seed,
                    frames=arguments.frames,
                    width=width,
                    height=height,
                    depth_noise=0.01,
                    depth_holes=0.4,
                )
                print(measure(f"{camera}, {world}{', blind' if blind else ''}", settings, blind), flush=True)


if __name__ == "__main__":
    main()
