"""Train a small network through the alignment layer: it learns features that a change of light does not touch.

The target's light is changed by a gamma, which gain and offset cannot undo. The loss is the error of the pose that
`Align` finds from the network's maps, and its gradient reaches the network by the implicit function theorem.

    python examples/02_layer_in_a_model.py
"""

import torch
from torch import Tensor, nn

from torchvo360 import Align, AlignConfig, AlignResult, Equirectangular, lie
from torchvo360.data.synthetic import Pairs, sample_pairs
from torchvo360.learn.sphere_conv import SphericalConv2d
from torchvo360.residuals.weights import LossConfig

STEPS = 20


class Model(nn.Module):
    """Features and confidence from two layers, and the pose from their alignment."""

    def __init__(self, camera: Equirectangular) -> None:
        super().__init__()
        self.net = nn.Sequential(SphericalConv2d(1, 8, 3), nn.Tanh(), SphericalConv2d(8, 4, 3))
        config = AlignConfig(affine=False, saturation=None, loss=LossConfig(scale=0.2), min_agreement=0.0)
        self.align = Align(camera, config)

    def forward(self, ref: Tensor, tgt: Tensor, rho: Tensor) -> AlignResult:
        a, b = self.net(ref), self.net(tgt)
        weight = b[:, 0].sigmoid()
        return self.align(a[:, 1:], b[:, 1:], rho, weight_ref=a[:, 0].sigmoid(), weight_tgt=weight)


def error_deg(result: AlignResult, pairs: Pairs) -> Tensor:
    """Return the distance of the motions found from the true ones: rotation, and translation at 1 m, degrees."""
    xi = lie.se3_log(result.T_tgt_ref @ lie.se3_inverse(pairs.T_tgt_ref_true))
    return torch.linalg.vector_norm(xi, dim=-1).rad2deg()


def main() -> None:
    """Train, and compare before and after on pairs that were not trained on."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    train, test = (
        sample_pairs(8, seed=seed, width=128, height=64, gray=True, max_rotation_deg=2.0, affine=False)
        for seed in (1, 2)
    )
    model = Model(train.camera)
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    with torch.no_grad():
        before = error_deg(model(test.ref, test.tgt**1.8, test.rho), test).median()
    for step in range(STEPS):
        result = model(train.ref, train.tgt**1.8, train.rho)
        # Pairs that did not converge have no gradient, and say so.
        loss = (error_deg(result, train) * result.differentiable).sum() / result.differentiable.sum().clamp_min(1)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 5 == 0:
            print(f"step {step}: {loss.item():.3f} deg, {int(result.differentiable.sum())} of 8 pairs converged")
    with torch.no_grad():
        after = error_deg(model(test.ref, test.tgt**1.8, test.rho), test).median()
    print(f"median error on other pairs: {before:.3f} deg before, {after:.3f} deg after")


if __name__ == "__main__":
    main()
