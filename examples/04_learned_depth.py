"""Odometry in metres from the first frame on: a depth network gives the ranges that one camera cannot know.

python examples/04_learned_depth.py
"""

import torch

from torchvo360 import VisualOdometry, evaluate
from torchvo360.data.synthetic import SyntheticConfig, SyntheticSequence
from torchvo360.learn import load_checkpoint
from torchvo360.learn.checkpoint import SHIPPED_DEPTH

torch.set_num_threads(1)
walk = SyntheticSequence(SyntheticConfig(world="room", seed=12, frames=40, width=512, height=256))
frames = list(walk)
truth = walk.truth
assert truth is not None

for name, network in (("with the network", load_checkpoint(SHIPPED_DEPTH)), ("without", None)):
    odometry = VisualOdometry(walk.camera, depth=network)
    with torch.inference_mode():
        states = [odometry.step(frame).state for frame in frames]
    waiting = sum(state == "initialising" for state in states)
    found = evaluate(odometry.finish().trajectory, truth)
    # `scale` turns the trajectory's unit into metres.
    print(
        f"{name}: {waiting} frames without a map, unit {found.scale:.3f} m, error {found.ate_percent:.3f} % of the path"
    )
