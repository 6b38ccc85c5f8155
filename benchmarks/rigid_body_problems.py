"""The problems of rigid_body.py and what they are held to. NumPy only; a problem is plain JSON for every solver.

    minimize  1/2 |x(N) - x_ref|^2_final + sum dt/2 (|x(n) - x_ref|^2_running + effort |u(n)|^2)
    subject to  x(n+1) = one step of dt of the chain (semi-implicit Euler or RK4, u held), x(0) = x0

States are MuJoCo's, x = (q, qd), a free base as place, quaternion (w first), linear rate in the world, angular rate in
the body; weights are diagonals over deviations. The place and linear rate of a free base have no weight: then both
sides' costs are the same number, although they carry the base on in different coordinates.

Two sets. ITERATIONS: one iteration from the first trajectory. Crocoddyl's RK4 also integrates the running cost through
the substeps, ours sums it over the knots, so with RK4 the running state weight is zero. SOLVES: whole solves.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mechanisms
import numpy as np
from mechanisms import Chain

Problem = dict[str, Any]

EULER, RK4 = "semi-implicit-euler", "rk4"
INTEGRATORS = (EULER, RK4)
SHORT = {EULER: "euler", RK4: "rk4"}
STOP = 1e-9  # a solver stops when its model promises less than this, the interior point at ten times this


class Target(NamedTuple):
    """What our solver is held to: a ratio of times, or a time and a cost."""

    ratio: float = float("nan")
    ms: float = float("nan")
    cost: float = float("nan")


MECHANISMS = {
    "2r": mechanisms.two_rods, "arm6": mechanisms.puma, "arm7": mechanisms.arm7, "tree24": mechanisms.tree24,
    "humanoid": mechanisms.humanoid,
}  # fmt: skip

# Iterations: at least so many times faster than Crocoddyl; and compiled for the instruction set that its wheel uses.
ITERATION_RATIOS = {
    **{(name, EULER): r for name, r in zip(MECHANISMS, (5.5, 6.5, 6.5, 7.5, 5.5), strict=True)},
    **{(name, RK4): 5.0 for name in MECHANISMS},
}
BASELINE_RATIOS = {name: 1.3 if name == "2r" else 1.5 for name in MECHANISMS}

SOLVE_TARGETS = {
    ("2r_guess", EULER): Target(ms=5.0, cost=16.7704),
    ("2r_guess", RK4): Target(ms=15.0, cost=17.867),
    ("acrobot", RK4): Target(ms=400.0, cost=6.617),
    ("arm6", EULER): Target(ms=2.0, cost=0.7105),
    ("arm6", RK4): Target(ms=8.0, cost=0.7104),
    ("humanoid", EULER): Target(ms=600.0, cost=1.01 * 0.6079),  # within 1 % of what FDDP ends with after 770 iterations
}
# A last digit of the costs above.
COST_SLACK = 1e-4


def _sizes(chain: Chain) -> tuple[bool, int, int]:
    free = chain["joints"][0]["type"] == "FF"
    nv = len(chain["joints"]) + 5 * free
    return free, nv + free, nv


def _problem(
    name: str, chain: Chain, integrator: str, *, N: int, dt: float, q0: np.ndarray | None, goal: np.ndarray,
    running: float, effort: float, final: float, us: np.ndarray, motors: list[str] | None = None,
    enough: float | None = None, weigh_base: bool = False,
) -> Problem:  # fmt: skip
    free, nq, nv = _sizes(chain)
    rest = np.zeros(nq)
    if free:
        rest[3] = 1.0
    weights = np.ones(2 * nv)
    if free:
        unweighted = [0, 1, 2] if weigh_base else list(range(6))
        weights[[*unweighted, *(nv + i for i in unweighted)]] = 0.0
    x0, x_ref = np.concatenate([rest, np.zeros(nv)]), np.concatenate([rest, np.zeros(nv)])
    if q0 is not None:
        x0[:nq] = q0
    x_ref[nq - len(goal) : nq] = goal
    motors = mechanisms.motorized(chain) if motors is None else motors
    return {
        "name": name, "integrator": integrator, "chain": chain, "motors": motors, "N": N, "dt": dt,
        "running": (running * weights).tolist(), "final": (final * weights).tolist(), "effort": effort,
        "x0": x0.tolist(), "x_ref": x_ref.tolist(), "us": np.broadcast_to(us, (N, len(motors))).tolist(),
        "enough": enough, "stop": STOP, "max_iterations": 1000,
    }  # fmt: skip


def iteration_problem(name: str, integrator: str) -> Problem:
    """T = 100 stages from rest to 0.5 rad in every joint, first held against gravity (the humanoid: falling)."""
    chain = MECHANISMS[name]()
    free, _, _ = _sizes(chain)
    joints = len(mechanisms.motorized(chain))
    return _problem(
        name, chain, integrator, N=100, dt=0.005 if joints > 10 else 0.01, q0=None, goal=np.full(joints, 0.5),
        running=0.1 if integrator == EULER else 0.0, effort=1e-3, final=10.0,
        us=np.zeros(joints) if free else mechanisms.holding(chain), weigh_base=True,
    )  # fmt: skip


def cart_pole_problem(N: int) -> Problem:
    """A cart that pulls its hanging pole 0.5 m along its rail, from rest.

    The pole has a motor, too: Crocoddyl has no actuation in C++ that leaves out any but the first joint.
    """
    return _problem(
        "cart-pole", mechanisms.cart_pole(), EULER, N=N, dt=0.01, q0=None, goal=np.array([0.5, 0.0]), running=0.1,
        effort=1e-3, final=10.0, us=np.zeros(2),
    )  # fmt: skip


def scaling_problem(chain: Chain, N: int, integrator: str) -> Problem:
    """A chain of any size over N stages of 2 ms, held at rest and asked to move a little: full steps succeed."""
    n = len(chain["joints"])
    return _problem(
        f"{n} joints", chain, integrator, N=N, dt=0.002, q0=None, goal=np.full(n, 0.01), running=0.1, effort=1e-3,
        final=1.0, us=mechanisms.holding(chain),
    )  # fmt: skip


def solve_problem(name: str, integrator: str) -> Problem:
    """The whole problems: 1/2 effort |u|^2 along the way, 100 |q - q_d|^2 + 100 |qd|^2 at the end."""
    common: dict[str, Any] = {"running": 0.0, "final": 200.0}
    if name == "2r_guess":
        return _problem(
            name, mechanisms.two_rods(), integrator, N=100, dt=0.02, q0=np.zeros(2), goal=np.array([np.pi / 2, 0.0]),
            effort=1.0, us=quintic_swing(100, 0.02), **common,
        )  # fmt: skip
    if name == "acrobot":
        return _problem(
            name, mechanisms.two_rods(), integrator, N=150, dt=0.02, q0=np.array([-1.0, 0.0]),
            goal=np.array([np.pi / 2, 0.0]), effort=1.0, us=np.zeros(1), motors=["elbow"], **common,
        )  # fmt: skip
    if name == "arm6":
        chain = mechanisms.puma()
        return _problem(
            name, chain, integrator, N=100, dt=0.01, q0=np.zeros(6), goal=np.array([1.0, 1.2, -1.0, 0.5, 0.8, -0.5]),
            effort=1e-3, us=mechanisms.holding(chain), **common,
        )  # fmt: skip
    return _problem(  # in free flight, as the paper's diver: another posture within a second
        name, mechanisms.humanoid(), integrator, N=100, dt=0.01, q0=None, goal=0.4 * np.sin(1.0 + np.arange(28)),
        effort=1e-2, us=np.zeros(28), enough=SOLVE_TARGETS["humanoid", EULER].cost, **common,
    )  # fmt: skip


def rod_acceleration(q: Any, qd: Any, tau: Any, cos: Any = np.cos, sin: Any = np.sin) -> tuple[Any, Any]:
    """The two rods' accelerations in closed form, of floats or of CasADi's symbols: a judge with no code in common."""
    m, l, g = 0.5, 1.0, mechanisms.GRAVITY
    own = m * l * l / 3.0  # of a rod about its end
    couple, carried = 0.5 * m * l * l, m * l * l
    m11, m12, m22 = 2.0 * own + carried + 2.0 * couple * cos(q[1]), own + couple * cos(q[1]), own
    outer = 0.5 * m * g * l * cos(q[0] + q[1])
    f1 = tau[0] + couple * sin(q[1]) * (2.0 * qd[0] * qd[1] + qd[1] * qd[1]) - 1.5 * m * g * l * cos(q[0]) - outer
    f2 = tau[1] - couple * sin(q[1]) * qd[0] * qd[0] - outer
    det = m11 * m22 - m12 * m12
    return (m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det


def quintic_swing(N: int, dt: float) -> np.ndarray:
    """Torques (N, 2) that swing the straight 2R up along a quintic, by finite differences (the paper's first guess)."""
    s = np.arange(N + 1) / N
    q = np.stack([0.5 * np.pi * (10 * s**3 - 15 * s**4 + 6 * s**5), np.zeros(N + 1)], axis=1)
    qd = np.concatenate([np.zeros((1, 2)), np.diff(q, axis=0) / dt])
    qdd = np.diff(qd, axis=0) / dt
    us = np.empty((N, 2))
    for n in range(N):
        free = np.array(rod_acceleration(q[n], qd[n], (0.0, 0.0)))
        columns = [np.array(rod_acceleration(q[n], qd[n], unit)) - free for unit in ((1.0, 0.0), (0.0, 1.0))]
        us[n] = np.linalg.solve(np.stack(columns, axis=1), qdd[n] - free)
    return us


def probes(problem: Problem, count: int = 8) -> dict[str, Any]:
    """Random states (K, nx) and controls (K, nu), at which all sides must accelerate alike; the first at rest."""
    chain, nu = problem["chain"], len(problem["motors"])
    free, nq, nv = _sizes(chain)
    rng = np.random.default_rng(0)
    xs = np.concatenate([rng.uniform(-1.0, 1.0, (count, nq)), rng.uniform(-2.0, 2.0, (count, nv))], axis=1)
    us = rng.uniform(-1.0, 1.0, (count, nu))
    xs[0], us[0] = problem["x0"], 0.0
    if free:
        xs[:, 3:7] /= np.linalg.norm(xs[:, 3:7], axis=1, keepdims=True)
    return {"xs": xs.tolist(), "us": us.tolist()}
