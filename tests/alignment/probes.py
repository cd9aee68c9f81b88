"""Small pairs whose exact solution is known, at the sphere's hard points."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchvo360 import AlignConfig, AlignResult, Equirectangular, Pinhole, align, lie
from torchvo360.cameras import Camera
from torchvo360.image import interpolate, locate, pad_image
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve import LMConfig

TIGHT = AlignConfig(
    levels=1,
    blur_px=0.0,
    saturation=None,
    loss=LossConfig(scale=0.2),
    solver=LMConfig(step_tolerance=1e-7, cost_tolerance=1e-30, initial_damping=1e-7),
    steps_by_level=[40],
    min_agreement=0.0,
)
"""Goes on to the last digits, so that finite differences of its answers mean something."""

NAMES = ("ref", "tgt", "rho", "weight_ref", "weight_tgt", "rho_variance", "intrinsics", "T_tgt_ref")


@dataclass(frozen=True)
class Layer:
    """Two pairs of two channels, float64, as everything that `align` takes."""

    camera: Camera
    values: dict[str, Tensor]

    def solve(self, config: AlignConfig, values: dict[str, Tensor] | None = None, **options) -> AlignResult:
        arguments = dict(self.values if values is None else values)
        ref, tgt, rho = (arguments.pop(name) for name in ("ref", "tgt", "rho"))
        return align(ref, tgt, rho, self.camera, config=config, **arguments, **options)

    def leaves(self) -> dict[str, Tensor]:
        return {name: value.clone().requires_grad_() for name, value in self.values.items()}

    def to(self, dtype: torch.dtype) -> "Layer":
        return replace(self, values={name: value.to(dtype) for name, value in self.values.items()})

    def element(self, index: Tensor) -> "Layer":
        return replace(self, values={name: value[index] for name, value in self.values.items()})


def probe(result: AlignResult) -> Tensor:
    """A number for each element that depends on everything that was solved for."""
    T = result.T_tgt_ref
    mix = torch.linspace(0.7, 1.9, 16, dtype=T.dtype).reshape(4, 4)
    return (T * mix).sum((-2, -1)) + 1.3 * result.a - 0.8 * result.b


def smooth_images(camera: Camera, count: int, generator: torch.Generator) -> Tensor:
    """Sums of waves on the sphere, without seam or pole."""
    ray = torch.nn.functional.normalize(camera.ray_grid(dtype=torch.float64), dim=-1)
    wave = 2 * torch.randn(count, 2, 6, 3, generator=generator, dtype=torch.float64)
    phase = math.tau * torch.rand(count, 2, 6, 1, 1, generator=generator, dtype=torch.float64)
    return (torch.einsum("bckd,hwd->bckhw", wave, ray) + phase).sin().mean(2) * 0.4 + 0.5


def make_layer(camera: Camera, *, residual: float, rho_zero: bool = False, start: float = 0.02) -> Layer:
    generator = torch.Generator().manual_seed(7)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    H, W = camera.height, camera.width
    tgt = smooth_images(camera, 2, generator)
    rho = 0.3 + 0.3 * rand(2, H, W)
    if rho_zero:
        rho[:, :, ::2] = 0.0
    xi = torch.tensor([[0.05, 0.03, -0.06, 0.04, 0.1, -0.05], [-0.04, 0.05, 0.03, -0.08, 0.06, 0.03]]).double()
    T = lie.se3_exp(xi if camera.wraps else 0.3 * xi)
    Y = (
        camera.ray_grid(dtype=torch.float64).reshape(-1, 3) @ T[:, :3, :3].mT
        + rho.flatten(1)[..., None] * T[:, None, :3, 3]
    )
    u, v = camera.pixel_of(*Y.unbind(-1))
    seen = interpolate(pad_image(tgt, camera, 1).contiguous(), locate(u, v, camera)).value.view_as(tgt)
    ref = (seen - 0.03) / 0.9 + residual * (rand(2, 2, H, W) - 0.5)
    values = {
        "ref": ref,
        "tgt": tgt,
        "rho": rho,
        "weight_ref": 0.5 + rand(2, H, W),
        "weight_tgt": 0.5 + rand(2, H, W),
        "rho_variance": 0.01 * rand(2, H, W),
        "intrinsics": torch.tensor([camera.intrinsics] * 2, dtype=torch.float64),
    }
    if start:
        values["T_tgt_ref"] = lie.se3_exp(start * torch.randn(2, 6, generator=generator, dtype=torch.float64))
    return Layer(camera, values)


SPHERE = Equirectangular(32, 16)
PINHOLE = Pinhole(28, 20, 22.0, 21.0, 13.6, 10.3)

CASES: dict[str, Callable[[], Layer]] = {
    # The whole sphere has the seam and both poles in view.
    "sphere": lambda: make_layer(SPHERE, residual=1e-3),
    "zero residual": lambda: make_layer(SPHERE, residual=0.0),
    "identity start": lambda: make_layer(SPHERE, residual=0.0, start=0.0),
    "rho = 0": lambda: make_layer(SPHERE, residual=0.0, rho_zero=True),
    "pinhole": lambda: make_layer(PINHOLE, residual=0.0),
}
