"""The pose graph: derivatives, the sparse solver, drift, false loops, and graphs that hang together badly."""

import math
import time

import pytest
import torch
from torch import Tensor

from torchvo360 import lie
from torchvo360.checks import InputError, ShapeError
from torchvo360.loop import (
    PoseGraph,
    PoseGraphConfig,
    carry_poses,
    odometry_information,
    optimise_pose_graph,
)
from torchvo360.loop.graph import edge_jacobians, residuals
from torchvo360.loop.sparse import factorise, plan_elimination
from torchvo360.solve import Status

NOISE = torch.tensor([0.005] * 3 + [0.001] * 3 + [0.005], dtype=torch.float64)


def circle(count: int, laps: int = 1) -> Tensor:
    """T_world_key around a circle of 5 m, facing along it."""
    angle = torch.arange(count, dtype=torch.float64) / count * math.tau * laps
    zero = torch.zeros_like(angle)
    position = torch.stack([5 * angle.sin(), 0.1 * (3 * angle).sin(), 5 * angle.cos()], -1)
    return lie.se3(lie.so3_exp(torch.stack([zero, angle, zero], -1)), position)


def measured(T: Tensor, i: Tensor, j: Tensor, generator: torch.Generator) -> Tensor:
    noise = lie.sim3_exp(torch.randn(len(i), 7, generator=generator, dtype=torch.float64) * NOISE)
    return noise @ lie.se3_inverse(T[j]) @ T[i]


def graph_of(
    count: int, *, drift: float = 1.0, true: int = 3, false: int = 0, seed: int = 0, laps: int = 1
) -> tuple[PoseGraph, Tensor]:
    """A chain around a circle whose scale drifts by a factor, with true and false loops."""
    generator = torch.Generator().manual_seed(seed)
    T = circle(count, laps)
    i = torch.arange(count - 1)
    chain = measured(T, i, i + 1, generator)
    chain[:, :3, :3] *= drift ** (-1 / (count - 1))
    chain[:, :3, 3] *= drift ** (-1 / (count - 1))
    nodes = [T[0]]
    for step in chain:
        nodes.append(nodes[-1] @ lie.sim3_inverse(step))
    a = torch.arange(true)
    b = count - true + a if laps == 1 else a + count // laps
    astray = torch.Generator().manual_seed(seed + 1)
    wrong = torch.randint(count // 2, (false,), generator=astray)
    wild = lie.sim3_exp(0.3 * torch.randn(false, 7, generator=astray, dtype=torch.float64))
    graph = PoseGraph(
        torch.stack(nodes),
        torch.cat([i, a, wrong]),
        torch.cat([i + 1, b, wrong + count // 3]),
        torch.cat([chain, measured(T, a, b, generator), wild]),
        torch.cat([odometry_information(chain), torch.diag(NOISE**-2).expand(true + false, 7, 7)]),
        torch.arange(count - 1 + true + false) >= count - 1,
        torch.arange(count) == 0,
    )
    return graph, T


def position_error(S: Tensor, T: Tensor) -> float:
    return float((S[:, :3, 3] - T[:, :3, 3]).norm(dim=-1).max())


def scales(S: Tensor) -> Tensor:
    return torch.linalg.det(S[:, :3, :3]) ** (1 / 3)


def test_the_jacobian_is_that_of_finite_differences():
    g = torch.Generator().manual_seed(0)
    S = lie.sim3_exp(0.7 * torch.randn(6, 7, generator=g, dtype=torch.float64))
    i, j = torch.tensor([0, 1, 2, 5]), torch.tensor([3, 0, 4, 1])
    far = lie.sim3_exp(0.5 * torch.randn(4, 7, generator=g, dtype=torch.float64))
    exact = lie.sim3_inverse(S[j]) @ S[i]
    eye = torch.eye(7, dtype=torch.float64)
    for S_j_i in (exact, far @ exact):
        graph = PoseGraph(S, i, j, S_j_i, eye.expand(4, 7, 7), torch.zeros(4).bool(), torch.zeros(6).bool())
        J = edge_jacobians(graph, S, residuals(graph, S))
        for k in range(4):
            for end, sign in ((i, 1.0), (j, -1.0)):

                def moved(d, node=int(end[k]), edge=k, graph=graph):
                    nodes = S.clone()
                    nodes[node] = lie.sim3_exp(d) @ S[node]
                    return residuals(graph, nodes)[edge]

                numeric = torch.stack([(moved(1e-6 * e) - moved(-1e-6 * e)) / 2e-6 for e in eye], -1)
                torch.testing.assert_close(sign * numeric, J[k], atol=1e-7, rtol=1e-6)


def test_exact_measurements_leave_nothing_to_do():
    T = circle(30)
    i, j = torch.arange(29), torch.arange(1, 30)
    S_j_i = lie.se3_inverse(T[j]) @ T[i]
    held = torch.arange(30) == 0
    graph = PoseGraph(T, i, j, S_j_i, odometry_information(S_j_i), torch.zeros(29).bool(), held)
    result = optimise_pose_graph(graph)
    torch.testing.assert_close(result.S_world_key, T, atol=1e-9, rtol=0)
    assert float(result.chi2.max()) < 1e-9


@pytest.mark.parametrize("count", [40, 120])
def test_a_scale_drift_of_1_3_over_a_closed_loop_is_removed(count):
    graph, T = graph_of(count, drift=1.3)
    assert float(scales(graph.S_world_key)[-1]) == pytest.approx(1.3, rel=0.1)
    result = optimise_pose_graph(graph)
    assert result.status is Status.CONVERGED
    assert position_error(result.S_world_key, T) < 0.3 * position_error(graph.S_world_key, T)
    assert float((scales(result.S_world_key) - 1).abs().max()) < 0.06
    assert float(result.weight.min()) > 0.7


@pytest.mark.parametrize(("true", "false"), [(0, 1), (1, 1), (3, 1), (5, 20)])
def test_false_loops_among_true_ones_are_refused_and_bend_nothing(true, false):
    graph, T = graph_of(100, drift=1.1, true=true, false=false)
    without, _ = graph_of(100, drift=1.1, true=true)
    result, expected = optimise_pose_graph(graph), optimise_pose_graph(without)
    assert float(result.weight[99 + true :].max()) < 1e-3
    torch.testing.assert_close(result.S_world_key, expected.S_world_key, atol=1e-3, rtol=0)
    if true:
        assert float(result.weight[99 : 99 + true].min()) > 0.5
        assert position_error(result.S_world_key, T) < position_error(graph.S_world_key, T)


def test_400_keyframes_take_less_than_three_seconds():
    graph, T = graph_of(400, drift=1.3, true=20, false=3)
    start = time.process_time()
    result = optimise_pose_graph(graph)
    assert time.process_time() - start < 3.0
    assert position_error(result.S_world_key, T) < 0.3
    assert float(result.weight[-3:].max()) < 1e-3


def test_many_laps_agree():
    graph, T = graph_of(150, drift=1.2, true=50, laps=3)
    result = optimise_pose_graph(graph)
    assert position_error(result.S_world_key, T) < 0.4 * position_error(graph.S_world_key, T)
    assert float(result.weight.min()) > 0.9


def test_isolated_nodes_and_parts_without_a_held_node_stay_where_they_belong():
    graph, _ = graph_of(30, drift=1.2, true=2)
    S = torch.cat([graph.S_world_key, graph.S_world_key + 0.0, graph.S_world_key[:1]])
    twice = PoseGraph(
        S,
        torch.cat([graph.i, graph.i + 30]),
        torch.cat([graph.j, graph.j + 30]),
        graph.S_j_i.repeat(2, 1, 1),
        graph.information.repeat(2, 1, 1),
        graph.is_loop.repeat(2),
        torch.cat([graph.held, torch.zeros(31).bool()]),
    )
    result = optimise_pose_graph(twice)
    alone = optimise_pose_graph(graph)
    torch.testing.assert_close(result.S_world_key[:30], alone.S_world_key, atol=1e-4, rtol=0)
    torch.testing.assert_close(result.S_world_key[30:60], alone.S_world_key, atol=1e-4, rtol=0)
    torch.testing.assert_close(result.S_world_key[60], S[60], atol=0, rtol=0)


def test_parts_that_only_a_loop_joins_are_put_together():
    graph, T = graph_of(40, true=0)
    keep = graph.i != 19
    cut = PoseGraph(
        torch.cat([graph.S_world_key[:20], lie.sim3_exp(torch.ones(7).double() * 0.3) @ graph.S_world_key[20:]]),
        torch.cat([graph.i[keep], torch.tensor([5])]),
        torch.cat([graph.j[keep], torch.tensor([30])]),
        torch.cat([graph.S_j_i[keep], (lie.se3_inverse(T[30]) @ T[5])[None]]),
        torch.cat([graph.information[keep], torch.diag(NOISE**-2)[None]]),
        torch.cat([graph.is_loop[keep], torch.tensor([True])]),
        graph.held,
    )
    result = optimise_pose_graph(cut)
    assert float(result.weight[-1]) > 0.9
    assert position_error(result.S_world_key, T) < 0.2


def test_held_nodes_stay_to_the_bit():
    graph, _ = graph_of(30, drift=1.2, true=2)
    held = graph.held.clone()
    held[:7] = True
    result = optimise_pose_graph(PoseGraph(*[*vars(graph).values()][:-1], held))
    assert torch.equal(result.S_world_key[:7], graph.S_world_key[:7])


def test_graphs_of_nothing_are_solved():
    eye = torch.eye(4, dtype=torch.float64)
    none = torch.zeros(0, dtype=torch.int64)
    empty = (torch.zeros(0, 4, 4).double(), torch.zeros(0, 7, 7).double(), torch.zeros(0).bool())
    for K in (0, 1, 3):
        result = optimise_pose_graph(PoseGraph(eye.expand(K, 4, 4), none, none, *empty, torch.zeros(K).bool()))
        assert torch.equal(result.S_world_key, eye.expand(K, 4, 4))


def test_without_information_nothing_moves_and_it_is_said():
    graph, _ = graph_of(30, drift=1.2, true=1)
    broken = PoseGraph(
        graph.S_world_key, graph.i, graph.j, graph.S_j_i, 0 * graph.information, graph.is_loop, graph.held
    )
    result = optimise_pose_graph(broken)
    assert result.status in (Status.SINGULAR, Status.STALLED)
    torch.testing.assert_close(result.S_world_key, graph.S_world_key)


def test_the_same_graph_gives_the_same_bits():
    graph, _ = graph_of(60, drift=1.2, true=3, false=2)
    first, second = optimise_pose_graph(graph), optimise_pose_graph(graph)
    assert torch.equal(first.S_world_key, second.S_world_key)


def test_bad_graphs_are_refused_with_the_name():
    graph, _ = graph_of(10)
    parts = vars(graph)
    with pytest.raises(InputError, match="i, j"):
        optimise_pose_graph(PoseGraph(**{**parts, "j": graph.i}))
    with pytest.raises(InputError, match="i, j"):
        optimise_pose_graph(PoseGraph(**{**parts, "j": graph.j + 9}))
    with pytest.raises(InputError, match="S_j_i"):
        optimise_pose_graph(PoseGraph(**{**parts, "S_j_i": graph.S_j_i * torch.nan}))
    with pytest.raises(ShapeError, match="information"):
        optimise_pose_graph(PoseGraph(**{**parts, "information": graph.information[1:]}))
    with pytest.raises(InputError, match="gate"):
        PoseGraphConfig(gate=0.0)


# The sparse solver


@pytest.mark.parametrize("loops", [0, 5, 60, 400])
def test_the_sparse_solver_is_the_dense_one(loops):
    g = torch.Generator().manual_seed(loops)
    K = 70
    chain = {(k, k + 1) for k in range(K - 1) if k != 33}
    ends = torch.randint(K, (loops, 2), generator=g).tolist()
    pairs = sorted(chain | {(min(e), max(e)) for e in ends if e[0] != e[1]})
    blocks = torch.randn(len(pairs), 7, 7, generator=g, dtype=torch.float64)
    dense = torch.zeros(K, K, 7, 7, dtype=torch.float64)
    for (i, j), block in zip(pairs, blocks, strict=True):
        dense[i, j], dense[j, i] = block, block.mT
    diagonal = (50 + 10 * loops / 10) * torch.eye(7, dtype=torch.float64).expand(K, 7, 7)
    dense[torch.arange(K), torch.arange(K)] = diagonal
    H = dense.movedim(2, 1).reshape(7 * K, 7 * K)
    b = torch.randn(K, 7, 2, generator=g, dtype=torch.float64)
    factor = factorise(plan_elimination(K, pairs), diagonal, blocks)
    assert factor.ok
    torch.testing.assert_close(factor.solve(b).reshape(-1, 2), torch.linalg.solve(H, b.reshape(-1, 2)))
    broken = factorise(plan_elimination(K, pairs), -diagonal, blocks)
    assert not broken.ok
    assert bool((broken.solve(b) == 0).all())


# What is around the graph


def test_frames_follow_their_keyframe_with_its_scale():
    g = torch.Generator().manual_seed(0)
    S = lie.sim3_exp(torch.randn(4, 7, generator=g, dtype=torch.float64))
    T = lie.se3_exp(torch.randn(9, 6, generator=g, dtype=torch.float64))
    key = torch.tensor([0, 0, 1, 1, 1, 2, 3, 3, 3])
    out = carry_poses(S, key, T)
    s = scales(S)[key]
    torch.testing.assert_close(out[:, :3, 3], (S[key] @ T)[:, :3, 3])
    torch.testing.assert_close(out[:, :3, :3] * s[:, None, None], (S[key] @ T)[:, :3, :3])
    torch.testing.assert_close(carry_poses(T[:4], key, T), T[:4][key] @ T)
    with pytest.raises(InputError, match="key"):
        carry_poses(S, key + 1, T)


def test_odometry_is_finite_and_positive_for_a_standing_camera_too():
    eye = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
    for S_j_i in (eye, eye[:0]):
        information = odometry_information(S_j_i)
        assert bool(information.isfinite().all())
        assert bool((torch.linalg.eigvalsh(information) > 0).all())
