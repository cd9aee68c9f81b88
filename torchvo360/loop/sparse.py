"""Symmetric positive definite systems of 7 x 7 blocks, sparse as a pose graph is: block Cholesky in batched rounds.

Each round eliminates many nodes at once: of few neighbours, no two of them neighbours of each other, so that their
factorisations and updates are one batch. A chain of K nodes is gone after about log2 K rounds; what is left when nodes
have many neighbours is solved densely. Which nodes, and where their updates go, depends on the edges alone and is
worked out once for all steps of a solve.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

D = 7
DENSE_NODES = 24
"""So few nodes are solved densely."""
MAX_NEIGHBOURS = 12
"""Nodes of more neighbours than this are left to the dense solve."""


class _Round(NamedTuple):
    """Nodes that are eliminated together; paddings point behind the last node or block."""

    node: Int64[Tensor, "M"]
    neighbour: Int64[Tensor, "M P"]
    block: Int64[Tensor, "M P"]
    """Numbers of the blocks between node and neighbours."""
    below: Tensor
    """[M, P], whether the block is stored as H[neighbour, node]."""
    source: Int64[Tensor, "U 3"]
    """Updates of blocks: the row, and two of its neighbours' columns, in the order in which the block is stored."""
    goal: Int64[Tensor, "U"]
    """The blocks that they are taken from."""


@dataclass(frozen=True)
class Elimination:
    """The order of elimination of a graph, for `factorise`."""

    nodes: int
    pair: Int64[Tensor, "P 2"]
    """Blocks that are stored, H[pair[0], pair[1]] with pair[0] < pair[1]: those of the edges first, then fill-in."""
    rounds: list[_Round]
    rest: Int64[Tensor, "R"]
    """Nodes left to the dense solve."""


def plan_elimination(nodes: int, pairs: list[tuple[int, int]]) -> Elimination:
    """Work out the order of elimination.

    Args:
        nodes: Number of nodes.
        pairs: Distinct pairs (i, j), i < j, of nodes with a block.
    """
    number = {pair: k for k, pair in enumerate(pairs)}
    near: list[set[int]] = [set() for _ in range(nodes)]
    for i, j in pairs:
        near[i].add(j)
        near[j].add(i)
    left, rounds = set(range(nodes)), []
    while len(left) > DENSE_NODES:
        order = sorted(left, key=lambda node: (len(near[node]), node))
        limit = max(2, len(near[order[0]]))
        if limit > MAX_NEIGHBOURS:
            break
        chosen: list[int] = []
        barred: set[int] = set()
        for node in order:
            if len(near[node]) > limit:
                break
            if node not in barred:
                chosen.append(node)
                barred |= near[node]
        rounds.append(_plan_round(chosen, near, number))
        left.difference_update(chosen)
    pair = torch.tensor(list(number), dtype=torch.int64).reshape(-1, 2)
    # The number of blocks grows while rounds are planned: only now is it known where paddings point.
    rounds = [
        r._replace(
            neighbour=torch.where(r.neighbour < 0, nodes, r.neighbour),
            block=torch.where(r.block < 0, len(pair), r.block),
        )
        for r in rounds
    ]
    return Elimination(nodes, pair, rounds, torch.tensor(sorted(left), dtype=torch.int64))


def _plan_round(chosen: list[int], near: list[set[int]], number: dict[tuple[int, int], int]) -> _Round:
    """Take nodes out of the graph, and join their neighbours."""
    width = max((len(near[node]) for node in chosen), default=0)
    neighbour, block, below, source, goal = [], [], [], [], []
    for row, node in enumerate(chosen):
        ring = sorted(near[node])
        padding = [-1] * (width - len(ring))
        neighbour.append(ring + padding)
        block.append([number[min(node, n), max(node, n)] for n in ring] + padding)
        below.append([n < node for n in ring] + [False] * len(padding))
        for p, first in enumerate(ring):
            near[first].discard(node)
            for q in range(p + 1, len(ring)):
                second = ring[q]
                near[first].add(second)
                near[second].add(first)
                source.append((row, p, q))
                goal.append(number.setdefault((first, second), len(number)))
    return _Round(
        torch.tensor(chosen, dtype=torch.int64),
        torch.tensor(neighbour, dtype=torch.int64).reshape(len(chosen), width),
        torch.tensor(block, dtype=torch.int64).reshape(len(chosen), width),
        torch.tensor(below, dtype=torch.bool).reshape(len(chosen), width),
        torch.tensor(source, dtype=torch.int64).reshape(-1, 3),
        torch.tensor(goal, dtype=torch.int64),
    )


@dataclass(frozen=True)
class Factor:
    """A factorised system."""

    plan: Elimination
    lower: list[Float64[Tensor, "M 7 7"]]
    """Cholesky factors of the eliminated nodes, of each round."""
    across: list[Float64[Tensor, "M P 7 7"]]
    """Blocks H[node, neighbour] at the time of elimination."""
    dense: Float64[Tensor, "N N"]
    """Cholesky factor of what was left."""
    ok: bool
    """Whether the system is positive definite; otherwise solutions are zero."""

    def solve(self, b: Float64[Tensor, "K 7 C"]) -> Float64[Tensor, "K 7 C"]:
        """Return x with H x = b, for C right sides."""
        if not self.ok:
            return torch.zeros_like(b)
        C = b.shape[-1]
        x = torch.cat([b, b.new_zeros(1, D, C)])
        for r, lower, across in zip(self.plan.rounds, self.lower, self.across, strict=True):
            own = torch.cholesky_solve(x[r.node], lower)
            x[r.node] = own
            x.index_add_(0, r.neighbour.flatten(), (across.mT @ own[:, None]).flatten(0, 1), alpha=-1)
            x[-1] = 0
        rest = self.plan.rest
        x[rest] = torch.cholesky_solve(x[rest].reshape(-1, C), self.dense).reshape(-1, D, C)
        for r, lower, across in zip(self.plan.rounds[::-1], self.lower[::-1], self.across[::-1], strict=True):
            x[r.node] -= torch.cholesky_solve((across @ x[r.neighbour]).sum(1), lower)
        return x[:-1]


def factorise(plan: Elimination, diagonal: Float64[Tensor, "K 7 7"], blocks: Float64[Tensor, "E 7 7"]) -> Factor:
    """Factorise a system.

    Args:
        plan: From `plan_elimination`.
        diagonal: Blocks H[i, i].
        blocks: Blocks H[i, j] of the plan's pairs, without its fill-in.
    """
    diagonal = torch.cat([diagonal, diagonal.new_zeros(1, D, D)])
    store = torch.cat([blocks, blocks.new_zeros(len(plan.pair) + 1 - len(blocks), D, D)])
    lowers, acrosses, ok = [], [], True
    for r in plan.rounds:
        lower, info = torch.linalg.cholesky_ex(diagonal[r.node])
        ok = ok and not bool(info.any())
        across = store[r.block]
        across = torch.where(r.below[..., None, None], across.mT, across)
        M, P = r.block.shape
        solved = torch.cholesky_solve(across.movedim(1, 2).reshape(M, D, P * D), lower)
        solved = solved.reshape(M, D, P, D).movedim(2, 1)
        diagonal.index_add_(0, r.neighbour.flatten(), (across.mT @ solved).flatten(0, 1), alpha=-1)
        diagonal[-1] = 0
        row, p, q = r.source.unbind(-1)
        store.index_add_(0, r.goal, across[row, p].mT @ solved[row, q], alpha=-1)
        lowers.append(lower)
        acrosses.append(across)
    dense, fine = _factorise_rest(plan, diagonal, store)
    return Factor(plan, lowers, acrosses, dense, ok and fine)


def _factorise_rest(
    plan: Elimination, diagonal: Float64[Tensor, "K1 7 7"], store: Float64[Tensor, "P1 7 7"]
) -> tuple[Float64[Tensor, "N N"], bool]:
    R = len(plan.rest)
    place = torch.full((plan.nodes,), -1, dtype=torch.int64)
    place[plan.rest] = torch.arange(R)
    i, j = place[plan.pair].unbind(-1)
    inner = ((i >= 0) & (j >= 0)).nonzero()[:, 0]
    i, j = i[inner], j[inner]
    grid = diagonal.new_zeros(R, R, D, D)
    grid[torch.arange(R), torch.arange(R)] = diagonal[plan.rest]
    grid[i, j] = store[inner]
    grid[j, i] = store[inner].mT
    dense, info = torch.linalg.cholesky_ex(grid.movedim(2, 1).reshape(R * D, R * D))
    return dense, not bool(info)
