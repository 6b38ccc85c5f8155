"""Every solver behind one face: `make(hopper)` returns a solve, and each call of it is one whole solve.

A solver's library is imported inside its maker, so that this module loads where none but NumPy is installed.
Building, tracing and compiling happen in the maker or in the first call; both are untimed. All start from zero
controls and the states these roll out to.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from problems import DECREASE, MAX_ITERATIONS, TOLERANCE, Hopper


class Result(NamedTuple):
    """What a solve returns."""

    us: np.ndarray  # (N,)
    cost: float  # by the solver's own account
    iterations: int
    converged: bool


Solve = Callable[[], Result]


class Solver(NamedTuple):
    """One line of the comparison."""

    module: str  # whose import tells whether it is installed
    label: str
    pip: str
    make: Callable[[Hopper], Solve]


def make_ours(hopper: Hopper) -> Solve:
    """This package: SLQ with feedback rollouts and its default tolerances."""
    import planner
    from planner.cases.hopper import PAPER

    problem = planner.cases.hopper(height=hopper.height, **PAPER)

    def solve() -> Result:
        plan = planner.solve(problem, max_iterations=MAX_ITERATIONS)
        return Result(plan.us[:, 0], plan.cost, plan.nit, plan.success)

    return solve


def make_jax(hopper: Hopper) -> Solve:
    """ILQR as one jitted while loop in float64: scans for rollout and sweep, all step lengths side by side."""
    from jax_ilqr import compiled

    run, first = compiled(hopper)

    def solve() -> Result:
        us, cost, iterations, converged = run(first)
        return Result(np.asarray(us), float(cost), int(iterations), bool(converged))

    return solve


def make_fatrop(hopper: Hopper) -> Solve:
    """Multiple shooting with exact Hessians: CasADi's derivatives, fatrop's interior point sweep."""
    import casadi as ca

    x, u, h = ca.SX.sym("x", 3), ca.SX.sym("u"), hopper
    e = x[2] - x[0]
    soft, stiff = 0.5 * h.stiffness / h.smoothing * e * e, h.stiffness * (e - 0.5 * h.smoothing)
    force = ca.if_else(e <= 0.0, 0.0, ca.if_else(e < h.smoothing, soft, stiff))
    f = ca.Function("f", [x, u], [x + h.dt * ca.vertcat(x[1], force - h.gravity, u)])
    # fatrop reads the stages off the order of variables and constraints: x0 u0 x1 u1 ... xN, dynamics first.
    xs = [ca.SX.sym(f"x{n}", 3) for n in range(h.N + 1)]
    us = [ca.SX.sym(f"u{n}") for n in range(h.N)]
    variables, constraints = [], []
    J = 0.5 * h.final_weight * (xs[-1][0] - h.height) ** 2 + xs[-1][1] ** 2
    first, state = [], np.zeros(3)
    for n in range(h.N):
        variables += [xs[n], us[n]]
        constraints.append(xs[n + 1] - f(xs[n], us[n]))
        if n == 0:
            constraints.append(xs[0])
        J += 0.5 * h.dt * (h.piston_weight * xs[n][2] ** 2 + h.flow_weight * us[n] ** 2)
        first.append(np.append(state, 0.0))
        state = np.asarray(f(state, 0.0)).ravel()
    rows = 3 * (h.N + 1)
    options = {
        "structure_detection": "auto", "equality": [True] * rows, "print_time": False, "error_on_fail": False,
        "fatrop": {"print_level": 0, "tol": TOLERANCE, "max_iter": 3 * MAX_ITERATIONS},
    }  # fmt: skip
    nlp = {"x": ca.vertcat(*variables, xs[-1]), "f": J, "g": ca.vertcat(*constraints)}
    nlpsol, guess = ca.nlpsol("hopper", "fatrop", nlp, options), ca.DM(np.concatenate([*first, state]))

    def solve() -> Result:
        answer = nlpsol(x0=guess, lbg=0.0, ubg=0.0)
        stats = nlpsol.stats()
        z = np.asarray(answer["x"]).ravel()
        return Result(z[3::4], float(answer["f"]), int(stats["iter_count"]), bool(stats["success"]))

    return solve


def make_crocoddyl(hopper: Hopper) -> Solve:
    """FDDP; Crocoddyl has no such machine in C++, so the model is Python, and most of the time is spent there."""
    import crocoddyl

    h, dt = hopper, hopper.dt

    class Stage(crocoddyl.ActionModelAbstract):
        def __init__(self) -> None:
            crocoddyl.ActionModelAbstract.__init__(self, crocoddyl.StateVector(3), 1, 0)
            self.Luu = np.array([[dt * h.flow_weight]])
            self.Lxx = np.diag([0.0, 0.0, dt * h.piston_weight])
            self.Fu = np.array([0.0, 0.0, dt])

        def calc(self, data, x, u=None) -> None:
            (y, v, p), flow = x.tolist(), float(u[0])
            force, _ = h.spring(p - y)
            data.xnext = np.array([y + dt * v, v + dt * (force - h.gravity), p + dt * flow])
            data.cost = 0.5 * dt * (h.piston_weight * p * p + h.flow_weight * flow * flow)

        def calcDiff(self, data, x, u=None) -> None:
            y, _, p = x.tolist()
            slope = dt * h.spring(p - y)[1]
            data.Fx = np.array([[1.0, dt, 0.0], [-slope, 1.0, slope], [0.0, 0.0, 1.0]])
            data.Fu = self.Fu
            data.Lx = np.array([0.0, 0.0, dt * h.piston_weight * p])
            data.Lu = np.array([dt * h.flow_weight * float(u[0])])
            data.Lxx, data.Luu = self.Lxx, self.Luu

    class End(crocoddyl.ActionModelAbstract):
        def __init__(self) -> None:
            crocoddyl.ActionModelAbstract.__init__(self, crocoddyl.StateVector(3), 1, 0)

        def calc(self, data, x, u=None) -> None:
            data.xnext = x.copy()
            data.cost = 0.5 * h.final_weight * (x[0] - h.height) ** 2 + x[1] ** 2

        def calcDiff(self, data, x, u=None) -> None:
            data.Lx = np.array([h.final_weight * (x[0] - h.height), 2.0 * x[1], 0.0])
            data.Lxx = np.diag([h.final_weight, 2.0, 0.0])

    shooting = crocoddyl.ShootingProblem(np.zeros(3), [Stage()] * h.N, End())
    us = [np.zeros(1)] * h.N
    xs = shooting.rollout(us)
    solver = crocoddyl.SolverFDDP(shooting)
    solver.th_stop = DECREASE

    def solve() -> Result:
        converged = solver.solve(xs, us, MAX_ITERATIONS, True)
        return Result(np.array(solver.us)[:, 0], solver.cost, solver.iter, bool(converged))

    return solve


SOLVERS = {
    "ours": Solver("planner", "planner SLQ", "slq-planner", make_ours),
    "jax": Solver("jax", "JAX iLQR", "jax", make_jax),
    "casadi": Solver("casadi", "CasADi + fatrop", "casadi", make_fatrop),
    # libcrocoddyl takes any libpinocchio, but 3.2.1 is built against 4.0.0 and is silently wrong with 4.1.0.
    "crocoddyl": Solver(
        "crocoddyl", "Crocoddyl FDDP (Python model)", "crocoddyl==3.2.1 pin==4.0.0 libpinocchio==4.0.0", make_crocoddyl
    ),
}
