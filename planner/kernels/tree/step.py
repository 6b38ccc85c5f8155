"""One stage of a tree on four lanes, by an Euler, Runge-Kutta, Rosenbrock or leapfrog method.

Quaternions follow their rotation vector: Q+ = Q exp(theta). For RK4 to be of fourth order on them, the stages carry
Munthe-Kaas' commutators (Iserles et al., Acta Numerica 2000, section 6): with K_i = dt omega_i in the body frame,

    theta_2 = K_1 / 2,   theta_3 = K_2 / 2 + K_1 x K_2 / 8,   theta_4 = K_3,
    theta   = (K_1 + 2 K_2 + 2 K_3 + K_4) / 6 + K_1 x K_4 / 12.
"""

from __future__ import annotations

from planner.kernels.algebra.rotations import turned
from planner.kernels.algebra.spatial import cross, load3, store3
from planner.kernels.integrators import (
    END_TURNED,
    LEAPFROG,
    LENGTHS,
    MIDDLE,
    ROSENBROCK,
    RUNGE_KUTTA,
    SEMI_IMPLICIT_EULER,
    SHARE,
    TURNED,
)
from planner.kernels.numba.jit import inline, jit, part
from planner.kernels.numba.lane_math import transpose
from planner.kernels.numba.lanes import (
    WIDTH,
    as_floats,
    at,
    doubles,
    floats,
    integers,
    lanes,
    load,
    load4,
    pointer,
    store,
)
from planner.kernels.tree.accelerations import accelerations
from planner.kernels.tree.forces import activation_rates
from planner.kernels.tree.leapfrog import end_rates, half_way, whole_way
from planner.kernels.tree.loop_projection import POSITIONS, VELOCITIES, project_to_closure
from planner.kernels.tree.mechanism_table import BALL, BALL_NEXT, TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.rosenbrock import (
    begin_implicit,
    end_displacement,
    end_velocity,
    forget_implicit,
    second_stage,
)
from planner.kernels.tree.rounds import forget_guess


@inline
def moved(m, q, theta, q_next):
    """Configuration q moved by theta (nv)."""
    kind, q_address = integers(m, TREE.kind), integers(m, TREE.q_address)
    for i in range(m[TREE.nv]):
        if load(kind, i) != BALL and load(kind, i) != BALL_NEXT:
            k = load(q_address, i)
            store(q_next, k, load(q, k) + load(theta, i))
    ball_q, ball_v = integers(m, TREE.ball_q), integers(m, TREE.ball_v)
    for b in range(m[TREE.nballs]):
        k = load(ball_q, b)
        w, x, y, z = turned(load(q, k), load(q, k + 1), load(q, k + 2), load(q, k + 3), load3(theta, load(ball_v, b)))
        store(q_next, k, w)
        store(q_next, k + 1, x)
        store(q_next, k + 2, y)
        store(q_next, k + 3, z)


@inline
def add_commutator(m, theta, first, second, factor):
    """Add factor times first x second to theta on every ball."""
    ball_v = integers(m, TREE.ball_v)
    for b in range(m[TREE.nballs]):
        k = load(ball_v, b)
        c = cross(load3(first, k), load3(second, k))
        t = load3(theta, k)
        store3(theta, k, (t[0] + factor * c[0], t[1] + factor * c[1], t[2] + factor * c[2]))


@part
def stage_state(m, r, x, i, a, dt):
    """State (q_stage, v_stages[i], act_stage) of Runge-Kutta stage i > 0, from the accelerations a so far."""
    nq, nv, na, method = m[TREE.nq], m[TREE.nv], m[TREE.na], floats(r, MEMORY.method)
    v, act, all_v, theta = at(x, nq), at(x, nq + nv), lanes(r, MEMORY.v_stages), lanes(r, MEMORY.theta)
    if i == 1:
        for k in range(nv):
            store(all_v, k, load(v, k))
    before, own, acceleration = at(all_v, (i - 1) * nv), at(all_v, i * nv), at(a, (i - 1) * r[MEMORY.stride])
    factor = load(method, LENGTHS + i) * dt
    for k in range(nv):
        store(own, k, load(v, k) + factor * load(acceleration, k))
        store(theta, k, factor * load(before, k))
    rate, act_i = at(lanes(r, MEMORY.act_rates), (i - 1) * na), lanes(r, MEMORY.act_stage)
    for k in range(na):
        store(act_i, k, load(act, k) + factor * load(rate, k))
    if i == 2:
        add_commutator(m, theta, all_v, before, load(method, TURNED) * dt * dt)
    moved(m, x, theta, lanes(r, MEMORY.q_stage))


@inline
def _weighed(r, p, stride, k, dt):
    """Dt times the weighted mean over a Runge-Kutta method's stages of entry k of p, whose stages lie stride apart."""
    method, last = floats(r, MEMORY.method), r[MEMORY.stages] - 1
    total = load(p, k)
    if last > 1:
        inner = load(p, stride + k)
        for i in range(2, last):
            inner += load(p, i * stride + k)
        total += load(method, MIDDLE) * inner
    return load(method, SHARE) * dt * (total + load(p, last * stride + k))


@part
def end_rotation(m, r, x, a, dt):
    """The displacement theta of the configuration over a whole Runge-Kutta step, from v_stages."""
    nv, v, theta = m[TREE.nv], lanes(r, MEMORY.v_stages), lanes(r, MEMORY.theta)
    for k in range(nv):
        store(theta, k, _weighed(r, v, nv, k, dt))
    turned = load(floats(r, MEMORY.method), END_TURNED)
    add_commutator(m, theta, v, at(v, (r[MEMORY.stages] - 1) * nv), turned * dt * dt)


@part
def end_state(m, r, x, a, dt, x_next):
    """Configuration and velocity at the end of a Runge-Kutta step, from v_stages; x_next may be x."""
    v, v_next = at(x, m[TREE.nq]), at(x_next, m[TREE.nq])
    end_rotation(m, r, x, a, dt)
    moved(m, x, lanes(r, MEMORY.theta), x_next)
    for k in range(m[TREE.nv]):
        store(v_next, k, load(v, k) + _weighed(r, a, r[MEMORY.stride], k, dt))


@inline
def end_activations(m, r, act, dt, act_next):
    """Activations at the end of a Runge-Kutta step, from act_rates; act_next may be act."""
    na, rates = m[TREE.na], lanes(r, MEMORY.act_rates)
    for k in range(na):
        store(act_next, k, load(act, k) + _weighed(r, rates, na, k, dt))


@part
def _end_rosenbrock(m, r, x, u, a, dt, x_next, external):
    """The second stage and the end of a step of kernels.tree.rosenbrock, whose first accelerations are in a."""
    nq, nv, na = m[TREE.nq], m[TREE.nv], m[TREE.na]
    act, theta, q_stage = at(x, nq + nv), lanes(r, MEMORY.theta), lanes(r, MEMORY.q_stage)
    rates, act_stage, act_next = lanes(r, MEMORY.act_rates), lanes(r, MEMORY.act_stage), at(x_next, nq + nv)
    second_stage(m, r, x, a, dt)
    moved(m, x, theta, q_stage)
    for k in range(na):
        store(act_stage, k, load(act, k) + dt * load(rates, k))
    accelerations(m, r, q_stage, at(lanes(r, MEMORY.v_stages), nv), u, act_stage, at(a, nv), external)
    activation_rates(m, u, act_stage, at(rates, na))
    end_displacement(m, r, x, a, dt)
    moved(m, x, theta, x_next)
    end_velocity(m, x, a, dt, x_next)
    half = 0.5 * dt
    for k in range(na):
        store(act_next, k, load(act, k) + half * (load(rates, k) + load(rates, na + k)))


@part
def _leap(m, r, x, u, a, dt, x_next, external):
    """A step of kernels.tree.leapfrog."""
    nq, nv, theta, q_stage = m[TREE.nq], m[TREE.nv], lanes(r, MEMORY.theta), lanes(r, MEMORY.q_stage)
    act_stage, rates = lanes(r, MEMORY.act_stage), lanes(r, MEMORY.act_rates)
    activation_rates(m, u, at(x, nq + nv), rates)
    half_way(m, r, x, rates, dt)
    moved(m, x, theta, q_stage)
    accelerations(m, r, q_stage, at(x, nq), u, act_stage, a, external)
    activation_rates(m, u, act_stage, rates)
    whole_way(m, r, x, a, dt)
    moved(m, x, theta, x_next)
    end_rates(m, x, a, rates, dt, x_next)


@part
def _step(m, r, x, u, a, dt, x_next, external):
    """The end x_next of one step of length dt (a V4) from x under u; a (stages * stride) keeps the accelerations."""
    nq, nv, na, integrator = m[TREE.nq], m[TREE.nv], m[TREE.na], r[MEMORY.integrator]
    v, act, theta = at(x, nq), at(x, nq + nv), lanes(r, MEMORY.theta)
    v_next, act_next, rates = at(x_next, nq), at(x_next, nq + nv), lanes(r, MEMORY.act_rates)
    if integrator == LEAPFROG:
        _leap(m, r, x, u, a, dt, x_next, external)
        return
    if external is not None and integrator == ROSENBROCK:
        begin_implicit(m, r, dt)
    accelerations(m, r, x, v, u, act, a, external)
    activation_rates(m, u, act, rates)
    if external is not None and integrator == ROSENBROCK:
        _end_rosenbrock(m, r, x, u, a, dt, x_next, external)
        return
    if integrator != RUNGE_KUTTA:
        for k in range(nv):
            rate = load(v, k) + dt * load(a, k)
            store(theta, k, dt * (rate if integrator == SEMI_IMPLICIT_EULER else load(v, k)))
            store(v_next, k, rate)
        for k in range(na):
            store(act_next, k, load(act, k) + dt * load(rates, k))
        moved(m, x, theta, x_next)
        return
    for i in range(1, r[MEMORY.stages]):
        stage_state(m, r, x, i, a, dt)
        vi, act_i = at(lanes(r, MEMORY.v_stages), i * nv), lanes(r, MEMORY.act_stage)
        accelerations(m, r, lanes(r, MEMORY.q_stage), vi, u, act_i, at(a, i * r[MEMORY.stride]), external)
        activation_rates(m, u, act_i, at(rates, i * na))
    end_state(m, r, x, a, dt, x_next)
    end_activations(m, r, act, dt, act_next)


@part
def close_state(m, r, x):
    """A state x at the end of a stage goes back onto the closed chains (kernels.tree.loop_projection)."""
    theta, v = lanes(r, MEMORY.theta), at(x, m[TREE.nq])
    project_to_closure(m, r, x, v, POSITIONS, theta)
    moved(m, x, theta, x)
    project_to_closure(m, r, x, v, VELOCITIES, theta)
    for i in range(m[TREE.nv]):
        store(v, i, load(v, i) + load(theta, i))


@part
def stage(m, r, x, u, a, dt, x_next, external):
    """The end x_next of a stage of length dt (a V4) from x under u, in equal substeps; a keeps all accelerations."""
    substeps = r[MEMORY.substeps]
    if external is not None:
        forget_guess(m, r)
    length = (1.0 / substeps) * dt
    _step(m, r, x, u, a, length, x_next, external)
    for i in range(1, substeps):
        _step(m, r, x_next, u, at(a, i * r[MEMORY.stages] * r[MEMORY.stride]), length, x_next, external)
    if external is not None and r[MEMORY.integrator] == RUNGE_KUTTA and m[TREE.loop_rows] > 0:
        close_state(m, r, x_next)


@inline
def gather(source, first, count, width, destination):
    """Rows first, ..., first + 3 (the last one repeated) of a float matrix onto lanes."""
    flat, last, whole = as_floats(destination), count - 1, width // WIDTH * WIDTH
    r0, r1 = first * width, min(first + 1, last) * width
    r2, r3 = min(first + 2, last) * width, min(first + 3, last) * width
    for k in range(0, whole, WIDTH):
        e = transpose((load4(source, r0 + k), load4(source, r1 + k), load4(source, r2 + k), load4(source, r3 + k)))
        store(destination, k, e[0])
        store(destination, k + 1, e[1])
        store(destination, k + 2, e[2])
        store(destination, k + 3, e[3])
    for lane in range(WIDTH):
        row = min(first + lane, last) * width
        for k in range(whole, width):
            store(flat, k * WIDTH + lane, load(source, row + k))


@inline
def scatter(source, first, count, width, destination):
    """The reverse of gather."""
    flat = as_floats(source)
    for lane in range(min(WIDTH, count - first)):
        row = (first + lane) * width
        for k in range(width):
            store(destination, row + k, load(flat, k * WIDTH + lane))


@jit
def steps(m, r, dt, xs, us, xs_next, keep, external):
    """xs_next[i] = the end of a stage of length dt[i] from xs[i] (K, nx) with us[i] (K, nu).

    With `keep` the stages' accelerations are left in MEMORY.accelerations.
    """
    m, r = pointer(m), pointer(r)
    nx, nu, K = xs.shape[1], m[TREE.nu], xs.shape[0]
    x, a, scratch = lanes(r, MEMORY.x), lanes(r, MEMORY.a), lanes(r, MEMORY.scratch)
    for first in range(0, K, WIDTH):
        gather(doubles(xs), first, K, nx, x)
        gather(doubles(us), first, K, nu, lanes(r, MEMORY.u))
        gather(pointer(dt), first, K, 1, scratch)
        length = load(scratch, 0)
        stage(m, r, x, lanes(r, MEMORY.u), a, length, x, external)
        scatter(x, first, K, nx, doubles(xs_next))
        if keep:
            scatter(a, first, K, r[MEMORY.kept], floats(r, MEMORY.accelerations))


@jit
def rates(m, r, xs, us, out, external):
    """out[i] = (qvel, qacc, d act/dt) at xs[i] (K, nx) with us[i] (K, nu)."""
    m, r = pointer(m), pointer(r)
    nx, nq, nv, na, K = xs.shape[1], m[TREE.nq], m[TREE.nv], m[TREE.na], xs.shape[0]
    forget_implicit(m, r)
    x, u, a, rate = lanes(r, MEMORY.x), lanes(r, MEMORY.u), lanes(r, MEMORY.a), lanes(r, MEMORY.links)
    for first in range(0, K, WIDTH):
        gather(doubles(xs), first, K, nx, x)
        gather(doubles(us), first, K, m[TREE.nu], u)
        forget_guess(m, r)
        accelerations(m, r, x, at(x, nq), u, at(x, nq + nv), a, external)
        for k in range(nv):
            store(rate, k, load(x, nq + k))
            store(rate, nv + k, load(a, k))
        activation_rates(m, u, at(x, nq + nv), at(rate, 2 * nv))
        scatter(rate, first, K, 2 * nv + na, doubles(out))
