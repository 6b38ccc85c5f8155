"""The leapfrog method, one evaluation a step: half the way, the velocities, the other half; and its chain rule.

With h the step and the forces those of the middle of the step,

    v+ = v + h a(q + h/2 v, v, act + h/2 dact/dt),   q+ = q + h/2 (v + v+),

which is of second order where forces do not depend on velocities. Damping, friction loss and laws with a lead feel the
velocity v + h/2 a, of the middle too: with D the damping, M + h/2 D is in place of M, and the lead is h/2 longer
(model.passive_forces.damped_later). So these are of second order as well, and stable for any damping: it is the
implicit midpoint rule for them. Velocity products have the v of the start, so that their part of the error, and with
it the method, is of first order.
Rotations follow one vector over the whole step, h/2 (v + v+). Activations go by the midpoint method.
"""

from __future__ import annotations

from planner.kernels.integrators import MAX_STAGES
from planner.kernels.numba.jit import part
from planner.kernels.numba.lanes import WIDTH, at, floats, lanes, load, load4, store, store4
from planner.kernels.tree.integrator_chain_rule import (
    activation_rows,
    add_activations,
    add_unit,
    add_unit_rows,
    begin_activations,
    copy_with,
    end_activations,
    stage_activations,
    sum_activations,
    turn_balls,
    turn_columns,
)
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY


@part
def half_way(m, r, x, rates, dt):
    """The displacement theta and the activations act_stage of the middle of a step, from the rates (na) at x."""
    nq, nv, na = m[TREE.nq], m[TREE.nv], m[TREE.na]
    theta, act_stage, half = lanes(r, MEMORY.theta), lanes(r, MEMORY.act_stage), 0.5 * dt
    for i in range(nv):
        store(theta, i, half * load(x, nq + i))
    for k in range(na):
        store(act_stage, k, load(x, nq + nv + k) + half * load(rates, k))


@part
def whole_way(m, r, x, a, dt):
    """The displacement theta of the whole step."""
    nq, theta, half = m[TREE.nq], lanes(r, MEMORY.theta), 0.5 * dt
    for i in range(m[TREE.nv]):
        store(theta, i, dt * (load(x, nq + i) + half * load(a, i)))


@part
def end_rates(m, x, a, rates, dt, x_next):
    """Velocities and activations at the end of a step, from the rates (na) in its middle; x_next may be x."""
    nq, nv = m[TREE.nq], m[TREE.nv]
    for i in range(nv):
        store(x_next, nq + i, load(x, nq + i) + dt * load(a, i))
    for k in range(m[TREE.na]):
        store(x_next, nq + nv + k, load(x, nq + nv + k) + dt * load(rates, k))


@part
def leapfrog(m, r, dt, lane, width, F):
    """The rows F of (B | A) of a step, from D of its middle and the rotations of half and of the whole way, kept."""
    nv, Xa, at_q, half = m[TREE.nv], floats(r, MEMORY.Xa), r[MEMORY.first], 0.5 * dt
    D, A, at_v = at(floats(r, MEMORY.direct), lane * r[MEMORY.block]), floats(r, MEMORY.chained), at_q + nv
    begin_activations(m, Xa)
    stage_activations(m, Xa, half)
    sum_activations(m, Xa, 1.0)
    copy_with(D, A, width, nv, at_q, half)
    if m[TREE.nballs] > 0:
        turn_columns(m, r, 0, lane, (half, 0.0), D, A, width)
    add_activations(m, Xa, A, width, at_q)
    for i in range(nv):
        q, v = i * width, (nv + i) * width
        for j in range(0, width, WIDTH):
            x = dt * load4(A, q + j)
            store4(F, v + j, x)
            store4(F, q + j, half * x)
        add_unit(F, q + at_v + i, dt)
        add_unit(F, v + at_v + i, 1.0)
    turn_balls(m, r, MAX_STAGES, lane, width, F)
    add_unit_rows(m, F, width, at_q)
    end_activations(m, Xa, dt)
    activation_rows(m, Xa, at(F, 2 * nv * width), width, at_q)
