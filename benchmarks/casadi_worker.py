"""Fatrop through CasADi on the planar problems of rigid_body_problems.py, served to rigid_body.py.

Multiple shooting with exact Hessians on the closed form of the two rods; CasADi has no rigid bodies of its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rigid_body_problems import RK4, rod_acceleration
from serving import Answer, serve, timed


def hello() -> Answer:
    """What is installed."""
    import casadi

    return {"version": casadi.__version__}


class Case:
    """One problem as CasADi has it."""

    def __init__(self, problem: dict[str, Any]) -> None:
        import casadi as ca

        names, motors = [joint["name"] for joint in problem["chain"]["joints"]], problem["motors"]
        if names != ["shoulder", "elbow"]:
            raise ValueError("only the two rods have a closed form here.")
        self.problem, self.nu = problem, len(motors)
        N, dt, x0 = problem["N"], problem["dt"], np.array(problem["x0"])

        def rates(x: Any, u: Any) -> Any:
            tau = [u[motors.index(name)] if name in motors else 0.0 for name in names]
            return ca.vertcat(x[2], x[3], *rod_acceleration((x[0], x[1]), (x[2], x[3]), tau, ca.cos, ca.sin))

        x, u = ca.SX.sym("x", 4), ca.SX.sym("u", self.nu)
        if problem["integrator"] == RK4:
            k1 = rates(x, u)
            k2 = rates(x + 0.5 * dt * k1, u)
            k3 = rates(x + 0.5 * dt * k2, u)
            k4 = rates(x + dt * k3, u)
            end = x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        else:
            qd = x[2:] + dt * rates(x, u)[2:]
            end = ca.vertcat(x[:2] + dt * qd, qd)
        self.step = ca.Function("step", [x, u], [end])

        # Fatrop reads the stages off the order of variables and constraints: x0 u0 x1 u1 ... xN, dynamics first.
        xs = [ca.SX.sym(f"x{n}", 4) for n in range(N + 1)]
        us = [ca.SX.sym(f"u{n}", self.nu) for n in range(N)]
        variables, constraints, J = [], [], self.state_cost(xs[N], problem["final"])
        first, state = [], x0
        for n in range(N):
            variables += [xs[n], us[n]]
            constraints.append(xs[n + 1] - self.step(xs[n], us[n]))
            if n == 0:
                constraints.append(xs[0] - x0)
            J += dt * (0.5 * problem["effort"] * ca.sumsqr(us[n]) + self.state_cost(xs[n], problem["running"]))
            first += [state, problem["us"][n]]
            state = np.asarray(self.step(state, problem["us"][n])).ravel()
        options = {
            "structure_detection": "auto", "equality": [True] * (4 * (N + 1)), "print_time": False,
            "error_on_fail": False,
            "fatrop": {"print_level": 0, "tol": 10.0 * problem["stop"], "max_iter": 3 * problem["max_iterations"]},
        }  # fmt: skip
        nlp = {"x": ca.vertcat(*variables, xs[N]), "f": J, "g": ca.vertcat(*constraints)}
        self.nlpsol, self.guess = ca.nlpsol("rods", "fatrop", nlp, options), ca.DM(np.concatenate([*first, state]))
        self.cost = float(ca.Function("J", [nlp["x"]], [J])(self.guess))

    def state_cost(self, x: Any, weights: Any) -> Any:
        """Half the weighted square of the distance from the goal, of symbols."""
        x_ref = self.problem["x_ref"]
        return sum(0.5 * w * (x[i] - x_ref[i]) ** 2 for i, w in enumerate(weights))

    def accelerations(self, probes: dict[str, Any]) -> list[list[float]]:
        """From the closed form."""
        motors, found = self.problem["motors"], []
        for x, u in zip(probes["xs"], probes["us"], strict=True):
            tau = [u[motors.index(name)] if name in motors else 0.0 for name in ("shoulder", "elbow")]
            found.append([float(a) for a in rod_acceleration(x[:2], x[2:], tau)])
        return found


_cases: dict[str, Case] = {}


def load(problem: dict[str, Any], probes: dict[str, Any]) -> Answer:
    """Build a problem; accelerations at the probes, and the first trajectory's cost."""
    _cases.clear()  # a problem that fails must not leave the last one to be timed
    case = Case(problem)
    _cases["now"] = case
    return {"accelerations": case.accelerations(probes), "cost": case.cost}


def solve(repeats: int, seconds: float) -> Answer:
    """Times of whole solves from the first trajectory."""
    case = _cases["now"]
    answer: Any = None

    def whole() -> None:
        nonlocal answer
        answer = case.nlpsol(x0=case.guess, lbg=0.0, ubg=0.0)

    times = timed(whole, lambda: None, repeats, seconds)
    stats, z = case.nlpsol.stats(), np.asarray(answer["x"]).ravel()
    us = z[:-4].reshape(case.problem["N"], 4 + case.nu)[:, 4:]
    return {
        "times": times, "cost": float(answer["f"]), "iterations": int(stats["iter_count"]),
        "converged": bool(stats["success"]), "us": us.tolist(),
    }  # fmt: skip


if __name__ == "__main__":
    serve(hello, {"load": load, "solve": solve})
