"""One Levenberg-Marquardt step of a pair: proposed, and judged once its candidate has been linearised.

A pair's normal equations of D parameters lie in one row: H row by row, g, cost, weight and square.

What is decided is what `solve.step` and `solve.damping` decide, where they tell why.
"""

import math

import numpy as np

from torchvo360.backends.numba.kernels.jit import inlined
from torchvo360.backends.numba.kernels.rigid import multiply, se3_exp
from torchvo360.backends.numba.kernels.symmetric import solve_ldl

# What becomes of a proposed step.
TO_JUDGE, UNSOLVABLE, ARRIVED = 0, 1, 2


@inlined()
def places(D):
    """Return where g, cost, weight and square lie in a row."""
    return D * D, D * D + D, D * D + D + 1, D * D + D + 2


@inlined()
def begin(b, state, free, rules, outcomes):
    """Judge a pair's start; return whether it goes on."""
    _, _, equations, damping, status, steps = state
    row = equations[b]
    at_g, at_cost, at_weight, _ = places(len(free))
    finite = math.isfinite(row[at_cost])
    for p in range(len(free)):
        finite = finite and math.isfinite(row[at_g + p])
    going_on, _, _, _, _, too_few, diverged = outcomes
    status[b] = (going_on if finite else diverged) if row[at_weight] >= rules[7] else too_few
    damping[b, 0], damping[b, 1] = rules[2], 2.0
    steps[b] = 0
    return status[b] == going_on


@inlined()
def copy_motion(T, affine, T_out, affine_out):
    """Copy a pose and brightness, by loops: numba compiles assignments of whole arrays for seconds."""
    for i in range(4):
        for j in range(4):
            T_out[i, j] = T[i, j]
    for m in range(len(affine)):
        affine_out[m] = affine[m]


@inlined()
def retract(T, affine, delta, T_new, affine_new, farthest, most_gain):
    """Apply a step (v, w, a, b) to a pose and brightness; write them as they were where it leads nowhere sensible."""
    multiply(se3_exp(delta[:6]), T, T_new)
    affine_new[0], affine_new[1] = affine[0] + delta[6], affine[1] + delta[7]
    sensible = abs(affine_new[0]) < most_gain and math.isfinite(affine_new[1])
    for i in range(3):
        sensible = sensible and abs(T_new[i, 3]) < farthest
        for j in range(3):
            sensible = sensible and math.isfinite(T_new[i, j])
    if not sensible:
        copy_motion(T, affine, T_new, affine_new)


@inlined()
def find_step(b, state, delta, free, rules):
    """Find the damped Gauss-Newton step of a pair; return whether there is one."""
    _, _, equations, damping, _, steps = state
    steps[b] += 1
    D = len(free)
    at_g, _, at_weight, _ = places(D)
    A, x, row = np.empty((D, D)), delta[b], equations[b]
    for p in range(D):
        for q in range(p + 1):
            A[p, q] = row[p * D + q] / row[at_weight] * (free[p] * free[q])
        A[p, p] += 1.0 - free[p]
        A[p, p] += damping[b, 0] * A[p, p]
        x[p] = -row[at_g + p] / row[at_weight] * free[p]
    return solve_ldl(A, x, rules[10])


@inlined()
def has_arrived(b, state, delta, scale, rules):
    """Return whether a step is so short that it is taken and ends the solve."""
    length2 = 0.0
    for p in range(delta.shape[1]):
        length2 += (delta[b, p] * scale[b, p]) ** 2
    return math.sqrt(length2) < rules[4] and state[3][b, 0] <= 1.0


@inlined()
def propose(b, state, candidate, scale, free, rules):
    """Take the damped Gauss-Newton step of a pair; return TO_JUDGE, UNSOLVABLE or ARRIVED."""
    T, affine, delta = state[0], state[1], candidate[3]
    if not find_step(b, state, delta, free, rules):
        return UNSOLVABLE
    retract(T[b], affine[b], delta[b], candidate[0][b], candidate[1][b], rules[8], rules[9])
    return ARRIVED if has_arrived(b, state, delta, scale, rules) else TO_JUDGE


@inlined()
def promised_fall(row, delta, free):
    """Return by how much the linear model said the mean cost would fall."""
    D, fall = len(free), 0.0
    at_g, _, at_weight, _ = places(D)
    for p in range(D):
        slope = row[at_g + p]
        for q in range(D):
            slope += 0.5 * row[p * D + q] * (delta[q] * free[q])
        fall -= delta[p] * free[p] * slope
    return fall / row[at_weight]


@inlined()
def next_damping(value, growth, accepted, gain, by_gain):
    """Return the damping and its growth after a step, by Nielsen's rule or by LSD-SLAM's."""
    if not accepted:
        return 0.2 if value == 0.0 else value * growth, growth * 2.0
    if by_gain:
        shrink = max(1.0 - (2.0 * min(max(gain, 0.0), 1.0) - 1.0) ** 3, 1.0 / 3.0)
        return max(value * shrink, 1e-9), 2.0
    return 0.0 if value <= 0.2 else value / 2.0, 2.0


@inlined()
def judge(b, solvable, state, candidate, free, rules, outcomes):
    """Accept or refuse a pair's step, of which a solvable one has been evaluated; return whether the pair goes on."""
    T, affine, equations, damping, status, steps = state
    T_new, affine_new, proposed, delta = candidate
    max_steps, by_gain, _, max_damping, _, cost_tolerance, least, min_weight, _, _, _ = rules
    going_on, converged, out_of_steps, stalled, singular, _, _ = outcomes
    row, value = equations[b], damping[b, 0]
    _, at_cost, at_weight, _ = places(len(free))
    accepted, gained, promised = False, 0.0, 0.0
    outcome = out_of_steps if steps[b] >= max_steps else going_on
    if solvable:
        cost = row[at_cost] / row[at_weight]
        new_cost = proposed[b, at_cost] / max(proposed[b, at_weight], min_weight)
        promised, gained = promised_fall(row, delta[b], free), cost - new_cost
        accepted = math.isfinite(new_cost) and proposed[b, at_weight] >= min_weight and gained > 0.0
        little = gained <= cost_tolerance * cost if accepted else promised <= least * cost
        arrived = little and (accepted or promised >= 0.0) and value <= 1.0
    else:
        arrived = False
    if not accepted and value >= max_damping:
        outcome = stalled
    if not solvable and value >= 1.0:
        outcome = singular
    if arrived:
        outcome = converged
    gain = gained / max(promised, 2.2250738585072014e-308)
    damping[b, 0], damping[b, 1] = next_damping(value, damping[b, 1], accepted, gain, by_gain)
    if accepted:
        copy_motion(T_new[b], affine_new[b], T[b], affine[b])
        for m in range(len(row)):
            row[m] = proposed[b, m]
    status[b] = outcome
    return outcome == going_on


@inlined()
def find_candidate(b, state, candidate, scale, free, rules, outcomes):
    """Propose steps of a pair until one is to be evaluated; return False where the pair has ended before."""
    while True:
        proposed = propose(b, state, candidate, scale, free, rules)
        if proposed == TO_JUDGE:
            return True
        if proposed == ARRIVED:
            # So short a step is taken without being evaluated.
            copy_motion(candidate[0][b], candidate[1][b], state[0][b], state[1][b])
            state[4][b] = outcomes[1]
            return False
        if not judge(b, proposed == TO_JUDGE, state, candidate, free, rules, outcomes):
            return False
