"""Joint photometric refinement of a start: poses, brightness and inverse ranges together, by a Schur complement.

One host frame, K target frames, N points, each seen through a pattern of 8 pixels. Each residual depends on one frame's
(pose, a, b) and one point's rho; the inverse ranges are eliminated, because their block is diagonal (mathematics.md,
section 6). The unit is held by the length of the last frame's translation: with the scale free, two-frame refinement
accepts no step (measured).
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from torchvo360 import lie
from torchvo360.residuals.direct import Reference, Target, by_rho, look_up, system_rows
from torchvo360.residuals.weights import LossConfig, robust
from torchvo360.solve import solve_ldl
from torchvo360.solve.schur import back_substitute, reduce

COUPLING = 1e-3
"""Weight of the prior that holds each rho to its start, relative to the points' mean curvature."""


class JointState(NamedTuple):
    """K poses and brightnesses, N inverse ranges, and the cost with its prior."""

    T_tgt_ref: Float64[Tensor, "K 4 4"]
    affine: Float64[Tensor, "K 2"]
    rho: Float[Tensor, "N"]
    cost: float


class _System(NamedTuple):
    H: Float64[Tensor, "K 8 8"]
    g: Float64[Tensor, "K 8"]
    by_point: Float64[Tensor, "K 8 N"]
    H_rho: Float64[Tensor, "N"]
    g_rho: Float64[Tensor, "N"]
    cost: float


def _linearize(
    ray: Tensor, rho: Tensor, value: Tensor, targets: Target, T: Tensor, affine: Tensor, loss: LossConfig
) -> _System:
    K, (N, P) = T.shape[0], value.shape
    each = rho.repeat_interleave(P).expand(K, -1)
    flat = value.reshape(1, 1, -1).expand(K, -1, -1)
    # Beyond the edge of a camera that does not wrap there is no value, and no weight.
    known = torch.isfinite(flat)
    reference = Reference(ray.reshape(1, 3, -1), each, flat.nan_to_num(nan=0.0), known[:, 0].to(rho.dtype))
    samples = look_up(reference, targets, T.to(ray.dtype), affine.to(ray.dtype))
    weight, cost = robust(samples.residual, loss)
    weight = weight * samples.weight
    rows = system_rows(samples, weight.sqrt()).double()
    along = (by_rho(samples, T[:, :3, 3].to(ray.dtype)) * weight.sqrt())[:, 0].double()
    jacobian, residual = rows[:, :8], rows[:, 8]
    return _System(
        H=jacobian @ jacobian.mT,
        g=(jacobian @ residual[..., None])[..., 0],
        by_point=(jacobian * along[:, None]).view(K, 8, N, P).sum(-1),
        H_rho=along.square().sum(0).view(N, P).sum(-1),
        g_rho=(along * residual).sum(0).view(N, P).sum(-1),
        cost=float((cost * samples.weight).sum()),
    )


def refine_jointly(
    ray: Float[Tensor, "3 N P"],
    rho: Float[Tensor, "N"],
    value: Float[Tensor, "N P"],
    targets: Target,
    T_tgt_ref: Float64[Tensor, "K 4 4"],
    affine: Float64[Tensor, "K 2"],
    loss: LossConfig,
    *,
    max_steps: int = 15,
) -> JointState:
    """Refine a start by Levenberg-Marquardt until the cost falls by less than 0.1 % or the steps are spent.

    Args:
        ray: The host's unit rays, P for each point.
        rho: The points' inverse ranges to start from.
        value: The rays' intensities; NaN where the host does not see them.
        targets: The K target images.
        T_tgt_ref: Poses to start from; the last one's translation keeps its length.
        affine: (a, b) of each target to start from.
        loss: The robust loss.
        max_steps: Most steps, refused ones included.
    """
    K = T_tgt_ref.shape[0]
    T, ab, damping, prior_rho = T_tgt_ref.to(ray.device), affine.to(ray.device), 1e-2, rho.double()
    length = torch.linalg.vector_norm(T[-1, :3, 3])
    system = _linearize(ray, rho, value, targets, T, ab, loss)
    coupling = COUPLING * system.H_rho.mean()

    def with_prior(state: _System, at: Tensor) -> float:
        return state.cost + 0.5 * float(coupling * (at.double() - prior_rho).square().sum())

    cost = with_prior(system, rho)
    for _ in range(max_steps):
        H_rho = (system.H_rho + coupling) * (1 + damping)
        g_rho = system.g_rho + coupling * (rho.double() - prior_rho)
        blocks = torch.block_diag(*system.H.unbind(0))
        cross = system.by_point.reshape(K * 8, -1).mT
        # Weak priors on (a, b), and the last translation held along its own direction: that is the unit.
        extra = torch.zeros(K, 8, 8, dtype=torch.float64, device=T.device)
        extra[:, 6, 6] = extra[:, 7, 7] = 1e-3 * system.H[:, 7, 7]
        along = T[-1, :3, 3] / length
        extra[-1, :3, :3] += 1e3 * system.H.diagonal(dim1=1, dim2=2).amax() * torch.outer(along, along)
        H = blocks + torch.block_diag(*extra.unbind(0)) + torch.diag(blocks.diagonal() * damping)
        delta, ok = solve_ldl(*reduce(H, system.g.reshape(-1), cross, H_rho, g_rho))
        step = back_substitute(delta, cross, H_rho, g_rho)
        limit = 0.5 * rho.double()
        new_rho = (rho.double() + step.clamp(-limit, limit)).to(rho.dtype)
        each = delta.view(K, 8)
        new_T, new_ab = lie.se3_exp(each[:, :6]) @ T, ab + each[:, 6:]
        # The unit exactly: all translations and ranges are scaled back together.
        scale = length / torch.linalg.vector_norm(new_T[-1, :3, 3]).clamp_min(1e-12)
        new_T = lie.se3(new_T[:, :3, :3], new_T[:, :3, 3] * scale)
        new_rho = new_rho / float(scale)
        proposed = _linearize(ray, new_rho, value, targets, new_T, new_ab, loss)
        new_cost = with_prior(proposed, new_rho)
        if bool(ok) and new_cost < cost:
            small = cost - new_cost < 1e-3 * cost
            T, ab, rho, system, cost = new_T, new_ab, new_rho, proposed, new_cost
            damping = max(damping * 0.3, 1e-6)
            if small:
                break
        else:
            damping *= 8
            if damping > 1e4:
                break
    return JointState(T.to(T_tgt_ref.device), ab.to(affine.device), rho, cost)
