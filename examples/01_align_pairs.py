"""Align a batch of rendered pairs, and look at more than the poses: history, maps and covariance.

python examples/01_align_pairs.py
"""

import torch

from torchvo360 import Status, align, lie
from torchvo360.data.synthetic import sample_pairs

torch.set_num_threads(1)
pairs = sample_pairs(4, width=256, height=128, gray=True)  # with exact inverse range and motion
result = align(pairs.ref, pairs.tgt, pairs.rho, pairs.camera, outputs=("history", "maps"))
assert result.history is not None
assert result.maps is not None

error = result.T_tgt_ref @ lie.se3_inverse(pairs.T_tgt_ref_true)
angle_deg = lie.so3_angle(error[:, :3, :3]).rad2deg()
distance_mm = 1e3 * (result.T_tgt_ref - pairs.T_tgt_ref_true)[:, :3, 3].norm(dim=-1)
sigma_mm = 1e3 * result.covariance().diagonal(dim1=-2, dim2=-1)[:, :3].sum(-1).sqrt()
for k, status in enumerate(result.status.tolist()):
    print(
        f"pair {k}: {Status(status).name}, off by {angle_deg[k]:.3f} deg and {distance_mm[k]:.1f} mm "
        f"(expected at least {sigma_mm[k]:.1f}); gain {result.a[k].exp():.2f} (true {pairs.gain[k]:.2f})"
    )
for level in result.history:  # the coarsest first
    print(f"pair 0, cost step by step: {' '.join(f'{cost:.2e}' for cost in level.cost[0][level.tried[0]].tolist())}")
print(
    f"mean absolute residual: {result.maps.residual.abs().mean():.4f}, seen: {result.maps.visible.float().mean():.0%}"
)
