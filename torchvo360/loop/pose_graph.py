"""Robust Sim(3) pose graph: keyframes whose loops close, and loops that are refused.

    minimise over S_world_key    sum_e w_e r_e^T Omega_e r_e,    r_e = Log(S_j_world S_world_i S_j_i^-1)

An edge measures S_j_i, X_j = S_j_i X_i, with an information by left tangents in frame j. The sum is minimised by
Levenberg-Marquardt with the sparse Cholesky of `sparse`; nothing is dense but what many loops have tied together.

Loops may be false, and then bend a graph so far that no reweighting finds back. So they are let in by what the rest
knows: a loop counts once it fits what odometry and the loops that count already allow between its ends, by the rise of
the whole chi2, `r^T (Omega^-1 + J H^-1 J^T)^-1 r`; the best half of those that fit at a time. After each solve the loop
whose deletion would lower chi2 most, `r^T (Omega^-1 - J H^-1 J^T)^-1 r`, is refused for good if that is too much. What
counts is weighted by Geman and McClure, w = (c / (chi2 + c))^2. Annealed weights from all loops at once (graduated
non-convexity) lost the trajectory with 5 false loops among 15; this way 300 among 330 do no harm.

Source: Strasdat, Montiel and Davison, Scale drift-aware large scale monocular SLAM (2010); Latif, Cadena and Neira,
Robust loop closing over time (2013), for the consistency tests; Baarda (1968) for the deletion.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from torchvo360.checks import InputError, check_finite_number
from torchvo360.loop.graph import GraphSystem, PoseGraph, check_graph, edge_chi2, edge_jacobians, residuals
from torchvo360.loop.sparse import Factor, factorise
from torchvo360.solve import Status

MAX_DAMPING = 1e6
NO_WEIGHT = 1e-9
"""Weight of a refused loop while nodes are still found by it: a part of the graph that hangs on it stays defined."""
REWEIGHTINGS = 1
"""Solves with robust weights after each in which the loops that count have their full weight."""
LOOPS_AT_ONCE = 64
"""Loops tested in one solve with many right sides, so that memory stays bounded."""


@dataclass(kw_only=True)
class PoseGraphConfig:
    """Settings of pose graph optimisation."""

    gate: float = 50.0
    """Rise of chi2 by a loop up to which it counts (seven degrees of freedom: 24 in one of a thousand, were all errors
    as the information says); also Geman and McClure's constant."""
    max_steps: int = 30
    """Most steps of one solve."""
    tolerance: float = 1e-8
    """Relative fall of the cost below which a solve has converged."""

    def __post_init__(self) -> None:
        if self.max_steps < 1:
            raise InputError(f"max_steps: expected at least 1, got {self.max_steps}.")
        check_finite_number("gate", self.gate, above=0)
        check_finite_number("tolerance", self.tolerance, above=0)


@dataclass(frozen=True)
class PoseGraphResult:
    """The optimised graph."""

    S_world_key: Float64[Tensor, "K 4 4"]
    weight: Float64[Tensor, "E"]
    """Of each edge, 0 to 1: 1 for odometry, near 0 for a loop that was refused."""
    chi2: Float64[Tensor, "E"]
    """Squared residual of each edge by its information."""
    status: Status
    """CONVERGED, MAX_STEPS, STALLED or SINGULAR; the nodes are the best found in any case."""
    steps: int


def _factor(system: GraphSystem, S: Tensor, r: Tensor, weight: Tensor, damping: float) -> tuple[Factor, Tensor, Tensor]:
    """Return the factorised system, the gradient, and every edge's J."""
    J = edge_jacobians(system.graph, S, r)
    weighted = J.mT @ system.graph.information * weight[:, None, None]
    diagonal, blocks = system.blocks(weighted @ J)
    diagonal = diagonal + damping * torch.diag_embed(diagonal.diagonal(dim1=-2, dim2=-1))
    return factorise(system.plan, diagonal, blocks), system.gather((weighted @ r[..., None])[..., 0]), J


def _minimise(
    system: GraphSystem, S: Float64[Tensor, "K 4 4"], weight: Float64[Tensor, "E"], config: PoseGraphConfig
) -> tuple[Float64[Tensor, "K 4 4"], Status, int]:
    """Take Levenberg-Marquardt steps at fixed weights."""
    damping = 1e-9
    r = residuals(system.graph, S)
    cost = float((weight * edge_chi2(system.graph, r)).sum())
    for step in range(1, config.max_steps + 1):
        factor, g, _ = _factor(system, S, r, weight, damping)
        proposed = system.moved(S, -factor.solve(g[..., None])[..., 0])
        proposed_r = residuals(system.graph, proposed)
        proposed_cost = float((weight * edge_chi2(system.graph, proposed_r)).sum())
        if factor.ok and proposed_cost <= cost:
            little = cost - proposed_cost <= config.tolerance * cost
            S, r, cost, damping = proposed, proposed_r, proposed_cost, max(damping / 10, 1e-9)
            if little:
                return S, Status.CONVERGED, step
        elif damping >= MAX_DAMPING:
            return S, Status.STALLED if factor.ok else Status.SINGULAR, step
        else:
            damping = max(damping * 10, 1e-6)
    return S, Status.MAX_STEPS, config.max_steps


def optimise_pose_graph(graph: PoseGraph, config: PoseGraphConfig | None = None) -> PoseGraphResult:
    """Move the keyframes to where odometry and true loops agree best.

    Args:
        graph: Keyframes, edges, and which may be false.
        config: Settings.

    Returns:
        Always finite; nodes without edges, and all of a graph that cannot be solved, stay where they were.

    Raises:
        ShapeError: Shapes do not match.
        InputError: An edge leads nowhere or to itself, or a number is not finite.
    """
    config = PoseGraphConfig() if config is None else config
    check_graph(graph)
    system = GraphSystem(graph)
    loop = graph.is_loop
    counted, refused = torch.zeros_like(loop), torch.zeros_like(loop)
    S, weight, status, steps = _solve_with(system, graph.S_world_key, counted, config)
    while True:
        chi2, _ = _tests(system, S, weight, counted)
        fitting = (loop & ~counted & ~refused & (chi2 <= config.gate)).nonzero()[:, 0]
        if len(fitting) == 0:
            break
        # The better half at a time: what they settle may show others to be false.
        best = fitting[chi2[fitting].argsort(stable=True)[: (len(fitting) + 1) // 2]]
        counted = counted.index_fill(0, best, True)
        S, weight, status, taken = _solve_with(system, S, counted, config)
        steps += taken
        while True:
            _, fall = _tests(system, S, weight, counted)
            worst = int(fall.argmax())
            if not float(fall[worst]) > config.gate:
                break
            counted, refused = counted.clone(), refused.clone()
            counted[worst], refused[worst] = False, True
            S, weight, status, taken = _solve_with(system, S, counted, config)
            steps += taken
    return PoseGraphResult(S, weight, edge_chi2(graph, residuals(graph, S)), status, steps)


def _solve_with(
    system: GraphSystem, S: Float64[Tensor, "K 4 4"], counted: Bool[Tensor, "E"], config: PoseGraphConfig
) -> tuple[Float64[Tensor, "K 4 4"], Float64[Tensor, "E"], Status, int]:
    """Solve with odometry and some of the loops, robustly; the weights of the others are 0."""
    graph = system.graph
    weight = torch.where(graph.is_loop & ~counted, NO_WEIGHT, 1.0).double()
    S, status, steps = _minimise(system, S, weight, config)
    for _ in range(REWEIGHTINGS if bool(counted.any()) else 0):
        robust = (config.gate / (config.gate + edge_chi2(graph, residuals(graph, S)))).square()
        weight = torch.where(counted, robust, weight)
        S, status, taken = _minimise(system, S, weight, config)
        steps += taken
    return S, torch.where(graph.is_loop & ~counted, 0.0, weight), status, steps


def _tests(
    system: GraphSystem, S: Float64[Tensor, "K 4 4"], weight: Float64[Tensor, "E"], counted: Bool[Tensor, "E"]
) -> tuple[Float64[Tensor, "E"], Float64[Tensor, "E"]]:
    """Return by how much chi2 would rise with each loop that does not count, and fall without each that does.

    Both to first order; infinite for the first and 0 for the second where a test does not apply or cannot be made.
    """
    graph = system.graph
    rise = torch.full_like(weight, torch.inf)
    fall = torch.zeros_like(weight)
    loop = graph.is_loop.nonzero()[:, 0]
    r = residuals(graph, S)
    factor, _, J = _factor(system, S, r, weight.clamp_min(NO_WEIGHT), 0.0)
    if len(loop) == 0 or not factor.ok:
        return rise, fall
    for edge in loop.split(LOOPS_AT_ONCE):
        spread = _predicted_covariance(system, factor, J, edge)
        inside = counted[edge]
        scaled = torch.where(inside, weight[edge], 1.0).clamp_min(NO_WEIGHT)
        own = torch.linalg.inv(graph.information[edge] * scaled[:, None, None])
        # A loop that alone holds a part of the graph leaves no residual and no redundancy: the floor keeps 0 / 0 at 0.
        total = own + torch.where(inside[:, None, None], 1e-9 * own - spread, spread)
        chi2 = (r[edge] * torch.linalg.solve_ex(total, r[edge][..., None])[0][..., 0]).sum(-1)
        usable = torch.isfinite(chi2)
        rise[edge] = torch.where(~inside & usable, chi2, torch.inf)
        fall[edge] = torch.where(inside & usable, chi2, 0.0)
    return rise, fall


def _predicted_covariance(
    system: GraphSystem, factor: Factor, J: Float64[Tensor, "E 7 7"], edge: Int64[Tensor, "L"]
) -> Float64[Tensor, "L 7 7"]:
    """Return J H^-1 J^T of some edges: how well the graph knows what they measure."""
    L, F = len(edge), len(system.free)
    k = torch.arange(L)
    right = J.new_zeros(F + 1, L, 7, 7)
    right[system.a[edge], k] += J[edge].mT
    right[system.b[edge], k] -= J[edge].mT
    known = factor.solve(right[:-1].movedim(2, 1).reshape(F, 7, L * 7)).reshape(F, 7, L, 7).movedim(2, 1)
    known = torch.cat([known, known.new_zeros(1, L, 7, 7)])
    return J[edge] @ (known[system.a[edge], k] - known[system.b[edge], k])
