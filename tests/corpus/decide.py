"""Whether a plan is right, without prove(), its kernels and MuJoCo: by Fig. 2 in NumPy and SciPy's DOP853 at 1e-10.

The controls are held over their stages. Where the plan does not get to its goals open loop, its gains act on the exact
state at 500 Hz or the nearest rate that fits the stages, held in between and one period late. A right plan ends at its
goals, stays within its ranges between the knots too, and its path is what happens, to 1 % of each coordinate's range.
"""

import math
from typing import Any

import numpy as np
from scipy.integrate import DOP853

from planner import Plan
from planner.dynamics import product_of_exponentials
from planner.dynamics.contacts import generalized_forces
from planner.model.actuators import DIRECT, INTEGRATOR
from planner.model.coordinates import coordinates_of
from planner.model.mechanism import BALL, SCREW
from planner.model.space import product
from planner.problem.goals import goals_of

TOLERANCE = 1e-10
PERIOD = 2e-3  # s
SHARE = 0.01  # of a coordinate's range of motion: how far its path may be off, and how far outside of a limit
SMOOTHED = 0.05  # the same where contacts are part of the plan
LEAST = 1e-3  # rad, m, rad/s, m/s: of a range of motion
MAX_STEPS = 200_000


class Lost(Exception):
    """The motion runs away, or takes too long to integrate."""


def rates(dynamics: Any, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """dx/dt (nx,) of a mechanism by the paper's recursions."""
    m = dynamics.mechanism
    q, qd, act = np.split(x, [m.nq, m.nq + m.nv])
    a, controls = m.actuators, u[: m.nu]
    direct = a.dynamics == DIRECT
    signal = np.where(direct, controls, act[a.activation] if m.na else controls)
    screws = np.flatnonzero(m.kind == SCREW)
    length = a.moment[:, screws] @ q[m.q_address[screws]]
    force = a.gain * signal + a.bias[:, 0] + a.bias[:, 1] * length + a.bias[:, 2] * (a.moment @ qd)
    inputs = a.moment.T @ force
    if m.contacts or m.body_contacts or m.stops or m.curves:
        inputs = inputs + generalized_forces(m, q, qd)
    given = np.zeros(m.nv, dtype=bool)
    for name in dynamics.prescribed:
        given[m.joint(name)] = True
    inputs[given] = u[m.nu :]
    qdd, _ = product_of_exponentials.hybrid_dynamics(m, q, qd, inputs, given)
    dq = np.zeros(m.nq)
    dq[m.q_address[screws]] = qd[screws]
    for i in np.flatnonzero(m.kind == BALL):
        at = m.q_address[i]
        dq[at : at + 4] = 0.5 * product(q[at : at + 4], np.array([0.0, *qd[i : i + 3]]))
    dact = np.zeros(m.na)
    for k in np.flatnonzero(~direct):
        now = act[a.activation[k]]
        filtered = a.dynamics[k] != INTEGRATOR
        dact[a.activation[k]] = (controls[k] - now) / a.time_constant[k] if filtered else controls[k]
    return np.concatenate([dq, qdd, dact])


def motion(plan: Plan, *, gains: bool) -> tuple[np.ndarray, np.ndarray]:
    """States at the ends of all of DOP853's steps (K, nx), and at the knots (N+1, nx)."""
    dynamics = plan.problem.dynamics
    stages = np.arange(plan.N)
    if not gains:
        times, owner = dynamics.dt * np.append(stages, plan.N), stages
    else:
        each = max(math.ceil(dynamics.dt / PERIOD - 0.5), 1)  # instants per stage, or stages per instant
        many = max(math.floor(PERIOD / dynamics.dt + 0.5), 1) if dynamics.dt < PERIOD else 1
        owner = np.repeat(stages, each)
        times = np.append(dynamics.dt * (owner + np.tile(np.arange(each), plan.N) / each), dynamics.dt * plan.N)
    x, late, steps = plan.problem.x0.copy(), np.zeros(dynamics.nu), 0
    correction = late
    xs, knots = [x], [x]
    nominal = plan.between_knots(each) if gains else plan.xs
    for k, n in enumerate(owner):
        if gains and (each > 1 or k % many == 0):
            correction = late
            late = plan.K[n] @ plan.space.difference(x, nominal[k])
        u = plan.within_bounds(int(n), plan.us[n] + correction) if gains else plan.us[n]
        whole = times[k + 1] - times[k]
        solver = DOP853(
            lambda t, y, u=u: rates(dynamics, y, u), times[k], x, times[k + 1],
            rtol=TOLERANCE, atol=TOLERANCE * scale(x), first_step=whole,
        )  # fmt: skip
        while solver.status == "running":
            message, steps = solver.step(), steps + 1
            if message or steps > MAX_STEPS or not np.isfinite(solver.y).all():
                raise Lost(f"at t = {solver.t:.4g} s")
            xs.append(solver.y.copy())
        x = solver.y.copy()
        for at, _ in plan.space.quaternions:
            x[at : at + 4] /= np.linalg.norm(x[at : at + 4])
        xs[-1] = x
        if k + 1 == len(owner) or owner[k + 1] != n:
            knots.append(x)
    return np.array(xs), np.array(knots)


def scale(x: np.ndarray) -> float:
    """Of absolute errors: that of the state, and at least a thousandth."""
    return max(1e-3, float(np.abs(x).max()))


def why_wrong(plan: Plan) -> str:
    """Why a plan is not right, in a phrase; "" where it is."""
    if not plan.success:
        return f"{plan.status.name}"
    first = ""
    for gains in (False, True):
        try:
            xs, knots = motion(plan, gains=gains)
        except Lost as lost:
            found = str(lost)
        else:
            found = missed(plan, xs) or outside(plan, xs) or astray(plan, knots)
        if not found:
            return ""
        first = first or found
    return f"open loop: {first}; with gains: {found}"


def missed(plan: Plan, xs: np.ndarray) -> str:
    """The goals that the end of a motion misses."""
    goals = [one for one in goals_of(plan.problem, plan.xs) if math.isfinite(one.tolerance)]
    ends = {one.name: float(one.error(xs[-1:])[0]) for one in goals}
    return ", ".join(
        f"{g.name} misses by {ends[g.name]:.3g} {g.unit}" for g in goals if not ends[g.name] <= g.tolerance
    )


def outside(plan: Plan, xs: np.ndarray) -> str:
    """The ranges of states that a motion leaves."""
    ranges = plan.problem.ranges
    if ranges is None:
        return ""
    e = plan.space.difference(xs, ranges.reference[-1])[:, ranges.component]
    beyond = np.maximum(np.maximum(e - ranges.upper[-1], ranges.lower[-1] - e), 0.0)
    beyond[:-1, len(ranges.coordinates) - ranges.at_end :] = 0.0  # exact goals are of the end
    most = beyond[1:].max(axis=0)
    allowed = plan.problem.limits.tolerance + share(plan) * np.minimum(ranges_of_motion(plan), 0.1)[ranges.component]
    worst = int(np.argmax(most - allowed))
    return f"{ranges.coordinates[worst].name} by {most[worst]:.3g}" if most[worst] > allowed[worst] else ""


def astray(plan: Plan, knots: np.ndarray) -> str:
    """The coordinate whose path is furthest off."""
    error = np.abs(plan.space.difference(knots, plan.xs)).max(axis=0) / ranges_of_motion(plan)
    worst = int(np.argmax(error))
    name = coordinates_of(plan.problem.dynamics)[worst].name
    return f"the path of {name} is off by {error[worst]:.2g} of its range" if error[worst] > share(plan) else ""


def share(plan: Plan) -> float:
    """Of a range of motion: what may be off."""
    m = plan.problem.dynamics.mechanism
    return SMOOTHED if m.contacts or m.body_contacts or m.stops else SHARE


def ranges_of_motion(plan: Plan) -> np.ndarray:
    """(ndx,) of each coordinate, at least a hundredth of the largest of its unit."""
    own = np.ptp(plan.space.difference(plan.xs, plan.xs[0]), axis=0)
    units = np.array([one.unit for one in coordinates_of(plan.problem.dynamics)])
    largest = np.array([own[units == unit].max() for unit in units])
    return np.maximum(np.maximum(own, 0.01 * largest), LEAST)
