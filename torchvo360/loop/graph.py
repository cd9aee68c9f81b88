"""The graph of keyframes: its residuals, their derivatives, and the normal equations put together from them.

    r_e = Log(S_j_world S_world_i S_j_i^-1),   d r_e = J (d_i - d_j),   J = J_l^-1(r) Ad(S_j_world)

with left steps d of the nodes in the world: one matrix an edge, so that H is a weighted graph Laplacian.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from torchvo360 import lie
from torchvo360.checks import InputError, check_shape
from torchvo360.loop.sparse import plan_elimination


@dataclass(frozen=True)
class PoseGraph:
    """Keyframes and what is known between them."""

    S_world_key: Float64[Tensor, "K 4 4"]
    i: Int64[Tensor, "E"]
    j: Int64[Tensor, "E"]
    S_j_i: Float64[Tensor, "E 4 4"]
    information: Float64[Tensor, "E 7 7"]
    """By (v, w, sigma) in `S_true = exp(xi) S_j_i`."""
    is_loop: Bool[Tensor, "E"]
    """Edges that may be false; the others always count."""
    held: Bool[Tensor, "K"]
    """Keyframes that stay. Of a part of the graph where none is held the first is."""


def residuals(graph: PoseGraph, S_world_key: Float64[Tensor, "K 4 4"]) -> Float64[Tensor, "E 7"]:
    """Return r_e of every edge."""
    S_j_i = lie.sim3_inverse(S_world_key[graph.j]) @ S_world_key[graph.i]
    return lie.sim3_log(S_j_i @ lie.sim3_inverse(graph.S_j_i))


def edge_jacobians(
    graph: PoseGraph, S_world_key: Float64[Tensor, "K 4 4"], r: Float64[Tensor, "E 7"]
) -> Float64[Tensor, "E 7 7"]:
    """Return J of every edge: dr / dd_i, and -dr / dd_j, by left steps of the nodes."""
    adjoint = lie.sim3_adjoint(lie.sim3_inverse(S_world_key[graph.j]))
    return torch.linalg.solve(lie.sim3_left_jacobian(r), adjoint)


class GraphSystem:
    """The normal equations of the nodes that are not held, and how they are put together."""

    def __init__(self, graph: PoseGraph) -> None:
        self.graph = graph
        K = len(graph.S_world_key)
        held = graph.held | _first_of_parts(graph)
        self.free = (~held).nonzero()[:, 0]
        number = torch.full((K,), -1, dtype=torch.int64)
        number[self.free] = torch.arange(len(self.free))
        a, b = number[graph.i], number[graph.j]
        self.a, self.b = torch.where(a < 0, len(self.free), a), torch.where(b < 0, len(self.free), b)
        self.inner = ((a >= 0) & (b >= 0)).nonzero()[:, 0]
        low, high = torch.minimum(a, b)[self.inner], torch.maximum(a, b)[self.inner]
        code, self.block = torch.unique(low * max(K, 1) + high, return_inverse=True)
        pairs = [(int(c) // max(K, 1), int(c) % max(K, 1)) for c in code.tolist()]
        self.plan = plan_elimination(len(self.free), pairs)
        self.pairs = len(pairs)

    def blocks(self, M: Float64[Tensor, "E 7 7"]) -> tuple[Float64[Tensor, "F 7 7"], Float64[Tensor, "P 7 7"]]:
        """Return H's diagonal and its stored blocks, from each edge's J^T Omega J."""
        diagonal = M.new_zeros(len(self.free) + 1, 7, 7).index_add_(0, self.a, M).index_add_(0, self.b, M)
        blocks = M.new_zeros(self.pairs, 7, 7).index_add_(0, self.block, M[self.inner], alpha=-1)
        return diagonal[:-1], blocks

    def gather(self, pull: Float64[Tensor, "E 7"]) -> Float64[Tensor, "F 7"]:
        """Return the gradient, from each edge's J^T Omega r."""
        g = pull.new_zeros(len(self.free) + 1, 7).index_add_(0, self.a, pull).index_add_(0, self.b, pull, alpha=-1)
        return g[:-1]

    def moved(self, S_world_key: Float64[Tensor, "K 4 4"], step: Float64[Tensor, "F 7"]) -> Float64[Tensor, "K 4 4"]:
        """Return the keyframes after left steps of the free ones."""
        out = S_world_key.clone()
        out[self.free] = lie.sim3_exp(step) @ S_world_key[self.free]
        return out


def _first_of_parts(graph: PoseGraph) -> Bool[Tensor, "K"]:
    """Return the first node of every connected part in which none is held."""
    K = len(graph.S_world_key)
    root = list(range(K))

    def find(node: int) -> int:
        while root[node] != node:
            root[node] = root[root[node]]
            node = root[node]
        return node

    for i, j in zip(graph.i.tolist(), graph.j.tolist(), strict=True):
        first, second = sorted((find(i), find(j)))
        root[second] = first
    part = torch.tensor([find(node) for node in range(K)], dtype=torch.int64)
    anchored = torch.zeros(K, dtype=torch.bool)
    anchored[part[graph.held]] = True
    return (part == torch.arange(K)) & ~anchored


def edge_chi2(graph: PoseGraph, r: Float64[Tensor, "E 7"]) -> Float64[Tensor, "E"]:
    """Return every residual's square by its information."""
    return (r * (graph.information @ r[..., None])[..., 0]).sum(-1)


def check_graph(graph: PoseGraph) -> None:
    """Refuse a graph that is none.

    Raises:
        ShapeError: Shapes do not match.
        InputError: An edge leads nowhere or to itself, or a number is not finite.
    """
    K, E = len(graph.S_world_key), len(graph.i)
    check_shape("S_world_key", graph.S_world_key, "K 4 4")
    for name, value, pattern in (
        ("j", graph.j, f"{E}"),
        ("S_j_i", graph.S_j_i, f"{E} 4 4"),
        ("information", graph.information, f"{E} 7 7"),
        ("is_loop", graph.is_loop, f"{E}"),
        ("held", graph.held, f"{K}"),
    ):
        check_shape(name, value, pattern)
    for name, value in (("S_world_key", graph.S_world_key), ("S_j_i", graph.S_j_i), ("information", graph.information)):
        if not bool(torch.isfinite(value).all()):
            raise InputError(f"{name}: expected finite numbers, got others.")
    ends = torch.cat([graph.i, graph.j])
    if bool(((ends < 0) | (ends >= K)).any()):
        raise InputError(f"i, j: expected keyframes from 0 to {K - 1}, got others.")
    if bool((graph.i == graph.j).any()):
        raise InputError("i, j: expected two keyframes of each edge, got the same one twice.")
