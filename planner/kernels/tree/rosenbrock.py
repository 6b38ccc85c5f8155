"""A Rosenbrock method of second order that takes the joints' damping implicitly: a step, and its chain rule.

For rates of 1e5 per s, a finger of a gram with the damping of an arm, which an explicit method would follow in steps
of 1e-5 s. It is ROS2 (Verwer, Spee, Blom and Hundsdorfer, SIAM J. Sci. Comput. 20, 1999): with f the rates, A those of
damping alone (dq/dt = v, dv/dt = -D v / M, D diagonal) and g = 1 - 1/sqrt(2),

    (1 - g h A) k1 = f(x),   (1 - g h A) k2 = f(x + h k1) - 2 k1,   x+ = x + 3/2 h k1 + 1/2 h k2.

It is of second order for any A and L-stable for the true one. With a = k1 and w = k2 + 2 k1 of the velocities it reads

    (M + g h D) a = forces(q, v)                     as if the armature were heavier by g h D
    (M + g h D) w = forces(q2, v2) + 2 g h D a       q2 = q + h v + g h^2 a,   v2 = v + h a
    v+ = v + h/2 (a + w),                            q+ = q + h v + h^2/2 ((1 - g) a + g w)

and turns follow their rotation vector, q+ less q. Activations go by Heun's method. D is the damping of each joint with
what couples it to others, summed by size, which is never less than the true one: then |R| <= 1 for these, too.

The derivatives are those of accelerations at a and w, with the heavier armature; dw has 2 g h D da / (M + g h D) more.
"""

from __future__ import annotations

from planner.kernels.algebra.tiles import four_rows
from planner.kernels.numba.jit import part
from planner.kernels.numba.lanes import WIDTH, at, floats, integers, lanes, load, load4, spread, store, store4
from planner.kernels.tree.integrator_chain_rule import (
    activation_rows,
    add_activations,
    add_product,
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

GAMMA = 0.2928932188134524  # 1 - 1 / sqrt(2)


@part
def begin_implicit(m, r, dt):
    """What the first stage of a step of dt (a V4) adds to armatures and forces."""
    implicit, behind, damping = lanes(r, MEMORY.implicit), lanes(r, MEMORY.behind), floats(m, TREE.implicit_damping)
    for i in range(m[TREE.nv]):
        store(implicit, i, GAMMA * dt * load(damping, i))
        store(behind, i, spread(0.0))


@part
def forget_implicit(m, r):
    """Accelerations are the machine's own again."""
    implicit, behind = lanes(r, MEMORY.implicit), lanes(r, MEMORY.behind)
    for i in range(m[TREE.nv]):
        store(implicit, i, spread(0.0))
        store(behind, i, spread(0.0))


@part
def add_implicit(m, r, M, ld):
    """The heavier armatures onto a mass matrix M (nv, ld)."""
    implicit = lanes(r, MEMORY.implicit)
    for i in range(m[TREE.nv]):
        store(M, i * ld + i, load(M, i * ld + i) + load(implicit, i))


@part
def second_stage(m, r, x, a, dt):
    """Velocities v_stages[1], displacement theta and forces of the second stage, from the first accelerations."""
    nv, v, theta = m[TREE.nv], at(x, m[TREE.nq]), lanes(r, MEMORY.theta)
    v2, implicit, behind = at(lanes(r, MEMORY.v_stages), nv), lanes(r, MEMORY.implicit), lanes(r, MEMORY.behind)
    for i in range(nv):
        store(v2, i, load(v, i) + dt * load(a, i))
        store(theta, i, dt * (load(v, i) + GAMMA * dt * load(a, i)))
        store(behind, i, 2.0 * load(implicit, i) * load(a, i))


@part
def end_displacement(m, r, x, a, dt):
    """The displacement theta over the whole step, from the accelerations of both stages."""
    nv, v, theta, half = m[TREE.nv], at(x, m[TREE.nq]), lanes(r, MEMORY.theta), 0.5 * dt
    for i in range(nv):
        later = (1.0 - GAMMA) * load(a, i) + GAMMA * load(a, nv + i)
        store(theta, i, dt * (load(v, i) + half * later))


@part
def end_velocity(m, x, a, dt, x_next):
    """Velocities at the end of a step; x_next may be x."""
    nv, v, v_next, half = m[TREE.nv], at(x, m[TREE.nq]), at(x_next, m[TREE.nq]), 0.5 * dt
    for i in range(nv):
        store(v_next, i, load(v, i) + half * (load(a, i) + load(a, nv + i)))


@part
def behind_matrix(m, r, ld):
    """MEMORY.M, which holds (M + g h D)^-1 (nv, ld) of the second stage, becomes 2 g D times it: its columns."""
    M, damping, prescribed = lanes(r, MEMORY.M), floats(m, TREE.implicit_damping), integers(m, TREE.prescribed)
    for i in range(m[TREE.nv]):
        for j in range(m[TREE.nv]):
            factor = 2.0 * GAMMA * load(damping, j) if load(prescribed, j) < 0 else 0.0
            store(M, i * ld + j, factor * load(M, i * ld + j))


@part
def rosenbrock(m, r, dt, lane, width, F):
    """The rows F of (B | A) of a step, from D of its two stages, the rotations and the matrix behind, all kept."""
    nv, block, Xa, at_q, ld = m[TREE.nv], r[MEMORY.block], floats(r, MEMORY.Xa), r[MEMORY.first], r[MEMORY.ld]
    at_v, A0 = at_q + nv, floats(r, MEMORY.chained)
    D1, D2, A1 = (
        at(floats(r, MEMORY.direct), lane * block),
        at(floats(r, MEMORY.direct), (WIDTH + lane) * block),
        at(A0, block),
    )
    behind = at(floats(r, MEMORY.behind_rows), lane * ld * ld)
    begin_activations(m, Xa)
    sum_activations(m, Xa, 1.0)
    copy_with(D1, A0, width, nv, at_q, 0.0)
    copy_with(D2, A1, width, nv, at_q, dt)
    if m[TREE.nballs] > 0:
        turn_columns(m, r, 1, lane, (dt, 0.0), D2, A1, width)
    stage_activations(m, Xa, dt)
    sum_activations(m, Xa, 1.0)
    add_activations(m, Xa, A1, width, at_q)
    add_product(A1, D2, at_v, A0, dt, nv, width)
    add_product(A1, D2, at_q, A0, GAMMA * dt * dt, nv, width)
    for i in range(0, nv, WIDTH):
        C = (A1, i * width, width)
        four_rows(C, (behind, i * ld, 1, ld), (A0, 0, width), nv, dt, width, C, True)
    half = 0.5 * dt
    for i in range(nv):
        q, v = i * width, (nv + i) * width
        for j in range(0, width, WIDTH):
            first, second = load4(A0, q + j), load4(A1, q + j)
            store4(F, q + j, (dt * half) * ((1.0 - GAMMA) * first + GAMMA * second))
            store4(F, v + j, half * (first + second))
        add_unit(F, q + at_v + i, dt)
        add_unit(F, v + at_v + i, 1.0)
    if m[TREE.nballs] > 0:
        turn_balls(m, r, 4, lane, width, F)
    add_unit_rows(m, F, width, at_q)
    end_activations(m, Xa, half)
    activation_rows(m, Xa, at(F, 2 * nv * width), width, at_q)
