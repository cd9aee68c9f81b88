"""The rows by shared intrinsics equal central differences of the residual, host's rays and target moving with one k.

Only the residual's value is differenced: the host's rays by `Camera.ray(uv, k)`, the target looked up with the same k.
"""

import math

import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.lie import se3_exp
from torchvo360.residuals.direct import Reference, Samples, Target, by_intrinsics, look_up, make_target

SPHERE = Equirectangular(64, 32)
CAMERAS = {
    "sphere": SPHERE,
    "sphere, turned": Equirectangular(64, 32, cx=11.3),
    "part of a sphere": Equirectangular(41, 30, 30.0, -28.0, 18.5, 16.2),
    "pinhole": Pinhole(48, 36, 40.0, 42.0, 23.1, 17.4),
    "pinhole, v up": Pinhole(48, 36, 40.0, -42.0, 23.1, 17.4),
}
on_every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
BATCH = 3
STEP = 1e-5
"""Of the central differences, pixels."""


def pixels_of(camera: Camera) -> Float[Tensor, "N 2"]:
    """Pixels all over the image, and on a sphere beside the seam and both poles."""
    generator = torch.Generator().manual_seed(11)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    uv = size * torch.rand(150, 2, generator=generator, dtype=torch.float64)
    if camera.wraps:
        seam = torch.tensor([[0.01, 9.3], [0.4, 20.2], [63.7, 9.3], [63.99, 25.8], [31.9, 16.1]], dtype=torch.float64)
        poles = torch.tensor([[5.2, 0.2], [40.3, 0.8], [12.7, 1.3], [20.1, 31.9], [60.4, 31.3]], dtype=torch.float64)
        uv = torch.cat([uv, seam, poles])
    return uv


def poses_of(camera: Camera, seed: int) -> Float[Tensor, "B 4 4"]:
    """Random poses: any rotation for a full sphere."""
    generator = torch.Generator().manual_seed(seed)
    xi = torch.randn(BATCH, 6, generator=generator, dtype=torch.float64)
    return se3_exp(xi * torch.tensor([0.2] * 3 + [1.0 if camera.wraps else 0.05] * 3, dtype=torch.float64))


class Problem:
    """Pixels of hosts seen in targets, as a function of k."""

    def __init__(self, camera: Camera, T_tgt_host: Float[Tensor, "B 4 4"], *, unit: bool) -> None:
        self.camera, self.T_tgt_host, self.unit = camera, T_tgt_host, unit
        self.uv = pixels_of(camera)
        generator = torch.Generator().manual_seed(2)
        self.rho = torch.rand(BATCH, len(self.uv), generator=generator, dtype=torch.float64)
        self.rho[:, ::4] = 0.0
        self.image = torch.rand(BATCH, 2, camera.height, camera.width, generator=generator, dtype=torch.float64)
        self.value = torch.rand(BATCH, 2, len(self.uv), generator=generator, dtype=torch.float64)
        moved = torch.randn(BATCH, 4, generator=generator, dtype=torch.float64)
        # Not the camera's own: k stands in for it, another one for each element.
        self.k = torch.tensor(camera.intrinsics, dtype=torch.float64) + 0.1 * moved

    def target(self, k: Float[Tensor, "B 4"]) -> Target:
        return make_target(self.image, self.camera, intrinsics=k)

    def look_up(self, k_host: Float[Tensor, "B 4"], k_tgt: Float[Tensor, "B 4"]) -> Samples:
        fx, fy, cx, cy = k_host[:, :, None].unbind(1)
        rays = self.camera.ray(self.uv, (fx, fy, cx, cy))
        if self.unit:
            rays = rays / rays.norm(dim=-1, keepdim=True)
        reference = Reference(rays.mT, self.rho, self.value, torch.ones_like(self.rho))
        return look_up(reference, self.target(k_tgt), self.T_tgt_host, torch.zeros(BATCH, 2, dtype=torch.float64))

    def dray_tgt(self) -> Float[Tensor, "B 3 4 N"]:
        fx, fy, cx, cy = self.k[:, :, None].unbind(1)
        camera = self.camera
        jacobian = camera.unit_ray_jacobian_intrinsics if self.unit else camera.ray_jacobian_intrinsics
        return torch.einsum("bij,bnjk->bikn", self.T_tgt_host[:, :3, :3], jacobian(self.uv, (fx, fy, cx, cy)))

    def central_differences(self, *, host: bool) -> Float[Tensor, "B 4 C N"]:
        columns = []
        for step in STEP * torch.eye(4, dtype=torch.float64):
            ahead, behind = (
                self.look_up(self.k + sign * step * host, self.k + sign * step).residual for sign in (1, -1)
            )
            columns.append((ahead - behind) / (2 * STEP))
        return torch.stack(columns, 1)

    def regular(self, samples: Samples) -> Bool[Tensor, "B N"]:
        """Points in view, off the edges of the interpolant's cells, off the seam and not where G is held back."""
        camera, (x, y, z) = self.camera, (part[:, 0] for part in samples.ray)
        fx, fy, cx, cy = self.k[:, :, None].unbind(1)
        u, v = camera.pixel_of(x, y, z, (fx, fy, cx, cy))
        inside = torch.stack([(part + 0.5).frac() - 0.5 for part in (u, v)]).abs().amax(0) < 0.499
        inside &= (u > 0.5) & (u < camera.width - 0.5) & (v > 0.5) & (v < camera.height - 0.5) | camera.wraps
        if isinstance(camera, Equirectangular):
            inside &= torch.hypot(x, z) > 1.001 * math.sin(0.5 / abs(camera.intrinsics[1]))
            inside &= torch.atan2(x, z).abs() < math.pi - 1e-3
            inside &= (v > 0) & (v < camera.height)  # k puts a pole inside the image: beyond are other pixels' values
        return inside & (samples.weight[:, 0] > 0)


@on_every_camera
@pytest.mark.parametrize("unit", [False, True], ids=["rays", "unit rays"])
@pytest.mark.parametrize("host", [True, False], ids=["shared", "target's only"])
@pytest.mark.parametrize("seed", range(3))
def test_rows_by_intrinsics_are_the_central_differences_of_the_residual(camera, unit, host, seed):
    problem = Problem(camera, poses_of(camera, seed), unit=unit)
    samples = problem.look_up(problem.k, problem.k)
    rows = by_intrinsics(samples, problem.target(problem.k), problem.dray_tgt() if host else None)
    assert rows.shape == (BATCH, 4, 2 * len(problem.uv))
    regular = problem.regular(samples)
    assert regular.sum() > (0.9 if camera.wraps else 0.5) * regular.numel()
    actual = rows.unflatten(2, (2, -1)).movedim(3, 1)[regular]
    expected = problem.central_differences(host=host).movedim(3, 1)[regular]
    assert expected.abs().amax((0, 2)).min() > 0.05
    torch.testing.assert_close(actual, expected, atol=1e-7, rtol=1e-6)


@on_every_camera
def test_autograd_through_rays_and_look_up_gives_the_rows(camera):
    problem = Problem(camera, poses_of(camera, 5), unit=True)
    samples = problem.look_up(problem.k, problem.k)
    pull = torch.rand(samples.residual.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    pull = pull * problem.regular(samples)[:, None]
    k = problem.k.clone().requires_grad_()
    (expected,) = torch.autograd.grad(problem.look_up(k, k).residual, k, pull)
    rows = by_intrinsics(samples, problem.target(problem.k), problem.dray_tgt())
    torch.testing.assert_close(rows @ pull.flatten(1)[..., None], expected[..., None], atol=1e-8, rtol=1e-9)


@pytest.mark.parametrize("camera", [SPHERE, CAMERAS["pinhole"], CAMERAS["part of a sphere"]])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_where_host_and_target_are_one_view_no_k_matters(camera, dtype):
    # The first rows of a panorama, where rows are held back, are among the pixels.
    uv = camera.pixel_grid(dtype=torch.float64).flatten(0, 1)
    image = torch.rand(1, 1, camera.height, camera.width, generator=torch.Generator().manual_seed(0)).to(dtype)
    reference = Reference(
        camera.ray(uv).mT[None].to(dtype), torch.zeros(1, len(uv)), image.flatten(2), torch.ones(1, len(uv))
    )
    target = make_target(image, camera)
    T, ab = torch.eye(4, dtype=dtype)[None], torch.zeros(1, 2, dtype=dtype)
    samples = look_up(reference, target, T, ab)
    rows = by_intrinsics(samples, target, camera.ray_jacobian_intrinsics(uv).movedim(0, -1)[None].to(dtype))
    rows = rows[..., samples.weight[0, 0] > 0]
    assert rows.shape[-1] > 0.85 * len(uv)
    torch.testing.assert_close(rows, torch.zeros_like(rows), atol=2e-5 if dtype == torch.float32 else 1e-12, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_at_the_poles_and_behind_rows_by_intrinsics_are_finite(dtype):
    towards = torch.tensor(
        [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1e-9, 1.0, 0.0], [0.0, -1.0, 1e-30], [0.0, 0.0, -1.0], [1e-30, 0.0, -1.0]]
    )
    for camera in CAMERAS.values():
        image = torch.rand(1, 1, camera.height, camera.width, generator=torch.Generator().manual_seed(0)).to(dtype)
        reference = Reference(
            towards.mT[None].to(dtype), torch.zeros(1, 6), torch.zeros(1, 1, 6, dtype=dtype), torch.ones(1, 6)
        )
        target = make_target(image, camera)
        samples = look_up(reference, target, torch.eye(4, dtype=dtype)[None], torch.zeros(1, 2, dtype=dtype))
        rows = by_intrinsics(samples, target, torch.ones(1, 3, 4, 6, dtype=dtype))
        assert torch.isfinite(rows).all()
        if camera.wraps:
            assert by_intrinsics(samples, target)[..., :2].abs().max() == 0
