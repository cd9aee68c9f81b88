"""Align panoramas from starts far beyond the reach of brightness, by the features that come with the package.

The starts are 120 deg off, and in the second row the target's light is another one.

    python examples/03_learned_features.py
"""

import math

import torch
from torch import Tensor

from torchvo360 import AlignConfig, Status, align, lie
from torchvo360.data.synthetic import sample_pairs
from torchvo360.learn import load_checkpoint
from torchvo360.learn.checkpoint import SHIPPED_FEATURES
from torchvo360.learn.features import align_features, pair_features

torch.set_num_threads(1)
pairs = sample_pairs(6, seed=77, width=128, height=64, world="courtyard", affine=False)
axis = torch.nn.functional.normalize(torch.randn(6, 3, generator=torch.Generator().manual_seed(0)).double(), dim=-1)
away = lie.se3(lie.so3_exp(math.radians(120) * axis), torch.zeros(6, 3, dtype=torch.float64))
start = away @ pairs.T_tgt_ref_true
network = load_checkpoint(SHIPPED_FEATURES)


def found(T: Tensor, status: Tensor) -> str:
    """Count the pairs that are called converged, and give their largest error."""
    converged = status == int(Status.CONVERGED)
    if not bool(converged.any()):
        return "none of 6 converges"
    error = lie.so3_angle((T @ lie.se3_inverse(pairs.T_tgt_ref_true))[converged, :3, :3]).rad2deg()
    return f"{int(converged.sum())} of 6 converge, within {error.max():.2f} deg"


for name, target in (("the same light", pairs.tgt), ("another light", 0.6 * pairs.tgt**1.6 + 0.05)):
    with torch.no_grad():
        learned = align_features(*pair_features(network, pairs.ref, target), pairs.rho, T_tgt_ref=start)
        config = AlignConfig(coarsest_width=16)
        plain = align(pairs.ref, target, pairs.rho, pairs.camera, T_tgt_ref=start, config=config)
    print(f"{name}: by features {found(learned.T_tgt_ref, learned.status)}")
    print(f"{name}: by colours {found(plain.T_tgt_ref, plain.status)}")
