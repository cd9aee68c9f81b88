"""The window's normal equations are those of its residuals, by an independent evaluation and automatic derivatives."""

import math

import pytest
import torch
from torch import Tensor
from window_scenes import random_target

from torchvo360 import lie
from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.image.sampling import sample
from torchvo360.residuals.weights import LossConfig
from torchvo360.solve.schur import back_substitute, reduce
from torchvo360.window import WindowConfig, WindowPoints, make_points
from torchvo360.window.energy import linearize_window
from torchvo360.window.state import PER_FRAME, Estimate
from torchvo360.window.stereo import Other

CAMERAS = {"sphere": Equirectangular(64, 32), "pinhole": Pinhole(48, 36, 40.0, 42.0, 23.1, 17.4)}
on_every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
PLAIN = WindowConfig(loss=LossConfig(name="none"))
FREE = 1e9
"""A threshold that refuses nothing."""
K = 3


def rays_of(camera: Camera, host: int) -> Tensor:
    """Unit rays all over the image, and on a sphere beside the seam and both poles."""
    g = torch.Generator().manual_seed(host)
    if not camera.wraps:
        uv = 8 + torch.rand(14, 2, generator=g, dtype=torch.float64) * torch.tensor([32.0, 20.0])
        ray = camera.ray(uv)
        return (ray / ray.norm(dim=-1, keepdim=True)).T
    ray = torch.randn(14, 3, generator=g, dtype=torch.float64)
    hard = torch.tensor([[0.03, 0.2, -1.0], [-0.03, -0.4, -1.0], [0.2, 1.0, 0.1], [-0.1, -1.0, 0.25]])
    ray = torch.cat([ray, hard.double()])
    return (ray / ray.norm(dim=-1, keepdim=True)).T


class Small:
    """Three keyframes of random images, with points in all of them."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.targets = [random_target(camera, seed) for seed in range(K)]
        g = torch.Generator().manual_seed(7)
        xi = torch.randn(K, 6, generator=g, dtype=torch.float64) * torch.tensor([0.1] * 3 + [0.04] * 3)
        points: WindowPoints | None = None
        for host, target in enumerate(self.targets):
            rays = rays_of(camera, host)
            rho = torch.rand(rays.shape[1], generator=g, dtype=torch.float64)
            rho[::5] = 0.0
            pixel = torch.arange(rays.shape[1])
            own = make_points(target, pixel, rays, rho, PLAIN, host, information=0.1 + rho)
            points = own if points is None else points.joined(own)
        assert points is not None
        points.rho_prior = points.rho + 0.3
        self.points = points
        self.k = torch.tensor(camera.intrinsics, dtype=torch.float64)
        self.estimate = Estimate(
            lie.se3_exp(xi), 0.2 * torch.randn(K, 2, generator=g, dtype=torch.float64), points.rho, self.k
        )
        T = lie.se3_exp(torch.tensor([0.15, 0.02, -0.03, 0.01, -0.02, 0.03], dtype=torch.float64))
        self.other = Other(1, random_target(camera, 9), T, torch.tensor([0.1, -0.05], dtype=torch.float64))

    def seen(self, target: Tensor, Y: Tensor, value: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        """The residual of rays and values in an image, and whether they are in view."""
        fx, fy, cx, cy = k
        u, v = self.camera.pixel_of(*Y.unbind(-1), (fx, fy, cx, cy))
        inside = (u > 0.5) & (u < self.camera.width - 0.5) & (v > 0.5) & (v < self.camera.height - 0.5)
        ok = torch.ones_like(inside) if self.camera.wraps else inside & (Y[..., 2] > 1e-9)
        image = target[:, :, 1:-1, 1:-1]
        return sample(image, torch.stack([u, v], -1).reshape(1, -1, 2), self.camera).view(u.shape) - value, ok

    def residuals(self, step: Tensor) -> tuple[Tensor, Tensor]:
        """All residuals after a step of all unknowns, times the roots of their weights; and of stereo alone."""
        p, N = self.points, len(self.points)
        each = step[: PER_FRAME * K].view(K, PER_FRAME)
        k = self.k + step[PER_FRAME * K : PER_FRAME * K + 4]
        rho = self.estimate.rho + step[PER_FRAME * K + 4 :]
        T = lie.se3_exp(each[:, :6]) @ self.estimate.T_cam_world
        a, b = (self.estimate.affine + each[:, 6:]).unbind(1)
        rays = self.camera.ray(p.uv.movedim(0, -1), tuple(k))
        rays = rays / rays.norm(dim=-1, keepdim=True)
        out = []
        for j in range(K):
            T_j_i = T[j] @ torch.linalg.inv(T[p.host])
            Y = (T_j_i[:, None, :3, :3] @ rays[..., None])[..., 0] + (rho[:, None] * T_j_i[:, :3, 3])[:, None]
            value = b[j] + (a[j] - a[p.host]).exp()[:, None] * (p.value - b[p.host][:, None])
            residual, ok = self.seen(self.targets[j].padded, Y, value, k)
            weight = p.weight * ok
            enough = weight.sum(1) > 0.5 * p.weight.sum(1)
            out.append(residual * (weight * (enough & (p.host != j))[:, None]).sqrt())
        prior = p.information.sqrt() * (rho - p.rho_prior)
        Y = (self.other.T_other_host[:3, :3] @ rays[..., None])[..., 0]
        Y = Y + (rho[:, None] * self.other.T_other_host[:3, 3])[:, None]
        gain, offset = self.other.affine
        residual, ok = self.seen(self.other.target.padded, Y, gain.exp() * p.value + offset, self.k)
        weight = p.weight * ok * (p.host == self.other.host)[:, None]
        enough = weight.sum(1) > 0.5 * p.weight.sum(1)
        stereo = residual * (weight * enough[:, None]).sqrt()
        assert len(prior) == N
        return torch.cat([*(part.flatten() for part in out), prior]), stereo.flatten()

    @property
    def size(self) -> int:
        return PER_FRAME * K + 4 + len(self.points)


def agree(actual: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(actual, expected, atol=1e-8 * float(expected.abs().max()), rtol=1e-7)


@on_every_camera
def test_the_normal_equations_are_those_of_the_residuals_by_all_unknowns(camera):
    small = Small(camera)
    zero = torch.zeros(small.size, dtype=torch.float64)
    residual, _ = small.residuals(zero)
    (J, _) = torch.func.jacrev(small.residuals)(zero)
    system = linearize_window(
        small.targets, small.points, small.estimate, PLAIN, thresholds=torch.full((K,), FREE, dtype=torch.float64)
    )
    D = PER_FRAME * K + 4
    assert system.edges > 0.6 * 2 * len(small.points)
    assert abs(system.energy - 0.5 * float(residual.square().sum())) < 1e-9 * system.energy
    agree(system.H, J[:, :D].T @ J[:, :D])
    agree(system.g, J[:, :D].T @ residual)
    agree(system.cross, J[:, D:].T @ J[:, :D])
    agree(system.curvature, J[:, D:].square().sum(0))
    agree(system.slope, J[:, D:].T @ residual)
    assert bool((system.H.diagonal() > 0).all())
    assert bool((J[:, D:].T @ J[:, D:]).fill_diagonal_(0).eq(0).all())


@on_every_camera
def test_without_intrinsics_the_other_unknowns_equations_are_the_same(camera):
    small = Small(camera)
    free = torch.full((K,), FREE, dtype=torch.float64)
    all_of_them = linearize_window(small.targets, small.points, small.estimate, PLAIN, thresholds=free)
    without = small.estimate._replace(intrinsics=None)
    system = linearize_window(small.targets, small.points, without, PLAIN, thresholds=free)
    D = PER_FRAME * K
    agree(system.H, all_of_them.H[:D, :D])
    agree(system.g, all_of_them.g[:D])
    agree(system.cross, all_of_them.cross[:, :D])


@on_every_camera
@pytest.mark.parametrize("coupling", [1.0, 3.0])
def test_static_stereo_adds_its_rows_to_its_hosts_points_alone(camera, coupling):
    small = Small(camera)
    config = WindowConfig(loss=LossConfig(name="none"), stereo_coupling=coupling)
    estimate = small.estimate._replace(intrinsics=None)
    free = torch.full((K + 1,), FREE, dtype=torch.float64)
    alone = linearize_window(small.targets, small.points, estimate, config, thresholds=free[:K])
    system = linearize_window(small.targets, small.points, estimate, config, thresholds=free, others=[small.other])
    zero = torch.zeros(small.size, dtype=torch.float64)
    _, residual = small.residuals(zero)
    (_, J) = torch.func.jacrev(small.residuals)(zero)
    J = J[:, PER_FRAME * K + 4 :]
    agree(system.curvature - alone.curvature, coupling * J.square().sum(0))
    agree(system.slope - alone.slope, coupling * J.T @ residual)
    assert system.energy - alone.energy == pytest.approx(coupling * 0.5 * float(residual.square().sum()))
    for name in ("H", "g", "cross"):
        assert torch.equal(getattr(system, name), getattr(alone, name))
    hosted = small.points.host == small.other.host
    assert bool((system.inliers > alone.inliers)[hosted].any())
    assert torch.equal(system.inliers[~hosted], alone.inliers[~hosted])


def test_first_estimates_take_the_derivatives_where_they_say():
    small = Small(CAMERAS["sphere"])
    free = torch.full((K,), FREE, dtype=torch.float64)
    T, k = small.estimate.T_cam_world, small.k
    here = linearize_window(small.targets, small.points, small.estimate, PLAIN, thresholds=free)
    same = linearize_window(small.targets, small.points, small.estimate, PLAIN, T_first=T, k_first=k, thresholds=free)
    agree(same.H, here.H)
    agree(same.cross, here.cross)
    moved = lie.se3_exp(torch.full((K, 6), 0.02, dtype=torch.float64)) @ T
    there = linearize_window(
        small.targets, small.points, small.estimate, PLAIN, T_first=moved, k_first=k + 0.5, thresholds=free
    )
    assert there.energy == here.energy
    assert float((there.H - here.H).abs().max()) > 1e-3 * float(here.H.abs().max())


@on_every_camera
def test_the_reduced_step_is_that_of_the_whole_system(camera):
    small = Small(camera)
    system = linearize_window(
        small.targets, small.points, small.estimate, PLAIN, thresholds=torch.full((K,), FREE, dtype=torch.float64)
    )
    D = len(system.g)
    H = system.H + torch.eye(D, dtype=torch.float64)
    whole = torch.cat([torch.cat([H, system.cross.T], 1), torch.cat([system.cross, torch.diag(system.curvature)], 1)])
    step = torch.linalg.solve(whole, -torch.cat([system.g, system.slope]))
    A, b = reduce(H, system.g, system.cross, system.curvature, system.slope)
    x = torch.linalg.solve(A, b)
    torch.testing.assert_close(x, step[:D], atol=1e-9, rtol=1e-7)
    y = back_substitute(x, system.cross, system.curvature, system.slope)
    torch.testing.assert_close(y, step[D:], atol=1e-9, rtol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_at_the_poles_the_seam_and_infinity_everything_is_finite(dtype):
    camera = CAMERAS["sphere"]
    towards = torch.tensor([[0.0, 1, 0], [0, -1, 0], [0, 0, -1], [1e-30, 0, -1], [-1e-30, 0.5, -1]], dtype=dtype)
    rays = (towards / towards.norm(dim=-1, keepdim=True)).T
    targets = [random_target(camera, seed) for seed in range(2)]
    for target in targets:
        object.__setattr__(target, "padded", target.padded.to(dtype))
    points = make_points(targets[0], torch.arange(5), rays, torch.tensor([0, 1, 0, 1, 1e6], dtype=dtype), PLAIN)
    T = torch.stack([torch.eye(4), lie.se3_exp(torch.tensor([0.0, 0.3, 0, 0, 0, 0]))]).double()
    estimate = Estimate(T, torch.zeros(2, 2, dtype=torch.float64), points.rho, None)
    system = linearize_window(targets, points, estimate, WindowConfig())
    for name in ("H", "g", "cross", "curvature", "slope"):
        assert bool(torch.isfinite(getattr(system, name)).all())
    assert math.isfinite(system.energy)
    assert system.edges == 5
