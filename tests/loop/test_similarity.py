"""The joint problem: its derivatives against finite differences, its parts, and the range comparison."""

import torch

from torchvo360 import lie
from torchvo360.loop.config import VerifyConfig
from torchvo360.loop.ranges import RangePoints, pair_ranges
from torchvo360.loop.similarity import LevelPair, directions, linearize_similarity, rigid, solve_similarity
from torchvo360.residuals.weights import LossConfig


def level_pair(a, b, level: int) -> LevelPair:
    image_a, image_b = a.target(level), b.target(level)
    return LevelPair(a.points(image_a, 800), b.points(image_b, 800), image_a, image_b, 400)


def shell(radius, seed: int, count: int = 4000) -> RangePoints:
    ray = torch.randn(3, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    ray = ray / ray.norm(dim=0)
    rho = torch.full((count,), 1 / radius, dtype=torch.float64)
    return RangePoints(ray, rho, (0.05 * rho) ** 2)


def test_ranges_of_one_sphere_in_two_scales_differ_by_the_scale():
    S = lie.sim3_exp(torch.tensor([[0.0, 0.0, 0.0, 0.3, -1.2, 0.4, 0.6]], dtype=torch.float64))
    pairs = pair_ranges(shell(2.0, 0), shell(2.0, 1), S)
    paired = pairs.weight > 0
    assert float(paired.double().mean()) > 0.5
    torch.testing.assert_close(pairs.difference[paired], torch.full_like(pairs.difference[paired], -0.6))


def test_the_derivative_of_a_range_is_that_of_finite_differences():
    points = shell(2.0, 0, 50)
    near = RangePoints(torch.cat([points.ray, -points.ray], 1), torch.ones(100).double(), torch.zeros(100).double())
    S = lie.sim3_exp(torch.tensor([[0.01, 0.02, -0.01, 0.003, -0.002, 0.004, 0.6]], dtype=torch.float64))
    step = 1e-6 * torch.eye(7, dtype=torch.float64)
    ahead = pair_ranges(points, near, lie.sim3_exp(step) @ S).difference
    behind = pair_ranges(points, near, lie.sim3_exp(-step) @ S).difference
    torch.testing.assert_close(((ahead - behind) / 2e-6).mT, pair_ranges(points, near, S).J[0], atol=1e-6, rtol=1e-6)


def test_points_behind_and_without_neighbours_do_not_count():
    half = shell(2.0, 0)
    up = half.ray[1] < -0.2
    near = RangePoints(half.ray[:, up], half.rho[up], half.variance[up])
    pairs = pair_ranges(half, near, torch.eye(4, dtype=torch.float64)[None])
    assert bool((pairs.weight[0][half.ray[1] > 0] == 0).all())
    assert bool((pairs.weight[0][up] > 0).all())


def test_the_gradient_is_that_of_the_cost(room):
    """Without robust losses and range variances g is the exact derivative, but for neighbours that change."""
    a, b = room.frame(room.pose()), room.frame(room.pose((0.1, 0.05, 0.0), yaw=0.4), scale=1.3, seed=1)
    pair = level_pair(a, b, 1)
    none = LossConfig(name="none")
    exact = LevelPair(
        *(
            type(p)(p.ray.double(), p.rho.double(), p.value.double(), p.weight.double())
            for p in (pair.points_a, pair.points_b)
        ),
        *(type(t)(t.camera, t.padded.double()) for t in (pair.image_a, pair.image_b)),
        400,
    )
    T = lie.se3_inverse(b.T_world_cam) @ a.T_world_cam
    S = T.clone()
    S[:3] *= 1.25
    affine = torch.tensor([[0.1, 0.02, -0.05, 0.01]], dtype=torch.float64)

    def cost(delta):
        moved = lie.sim3_exp(delta[:, :7]) @ S
        return linearize_similarity(exact, moved, affine + delta[:, 7:], none, 1e-3).cost

    # noise of 1e-3 makes the photometric part outweigh the ranges' robust one, whose neighbours jump
    eye = 1e-6 * torch.eye(11, dtype=torch.float64)
    numeric = (cost(eye) - cost(-eye)) / 2e-6
    g = linearize_similarity(exact, S[None], affine, none, 1e-3).g[0]
    torch.testing.assert_close(g, numeric, rtol=2e-3, atol=2e-4 * float(numeric.abs().max()))


def test_the_rigid_part_forgets_the_scale():
    S = lie.sim3_exp(torch.randn(5, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    T, scale = rigid(S)
    torch.testing.assert_close(scale, torch.linalg.det(S[:, :3, :3]) ** (1 / 3))
    torch.testing.assert_close(T[:, :3, :3] @ T[:, :3, :3].mT, torch.eye(3, dtype=torch.float64).expand(5, 3, 3))
    torch.testing.assert_close(T[:, :3, 3] * scale[:, None], S[:, :3, 3])


def test_starts_are_solved_each_for_itself(room):
    a, b = room.frame(room.pose()), room.frame(room.pose((0.1, 0.05, 0.0), yaw=0.4), seed=1)
    pair = level_pair(a, b, 2)
    true = (lie.se3_inverse(b.T_world_cam) @ a.T_world_cam)[None]
    wild = lie.sim3_exp(torch.tensor([[3.0, 0.0, 2.0, 2.0, 1.0, 0.0, 1.5]], dtype=torch.float64)) @ true
    config = VerifyConfig().align_config(coarsest=True)
    zeros = torch.zeros(2, 4, dtype=torch.float64)
    alone = solve_similarity(pair, true, zeros[:1], config, 8).state[0]
    among = solve_similarity(pair, torch.cat([wild, true]), zeros, config, 8).state[0]
    torch.testing.assert_close(among[1:], alone, atol=1e-4, rtol=0)
    assert min(way.agreement for way in directions(pair, alone, zeros[:1])) > 0.6
