"""This package on the problems of rigid_body_problems.py, served to rigid_body.py.

A process for each instruction set: Numba reads what to compile for when it is imported.
"""

from __future__ import annotations

import importlib
import pkgutil
import re
import warnings
from typing import Any

import numpy as np
from mechanisms import mjcf
from serving import Answer, serve, timed


def hello() -> Answer:
    """What is installed and what it compiles for."""
    from numba.core.registry import cpu_target

    import planner

    _, cpu, features = cpu_target.target_context.codegen().magic_tuple()
    widest = [name for name in ("avx512f", "avx2", "avx", "sse2", "neon") if f"+{name}" in features.split(",")]
    return {"version": planner.__version__, "cpu": cpu, "widest": widest[0] if widest else ""}


def posed(problem: dict[str, Any]) -> Any:
    """A planner.Problem."""
    import planner

    mechanism = planner.Mechanism.from_mjcf(mjcf(problem["chain"], problem["motors"]))
    N, dt = problem["N"], problem["dt"]
    Q = np.repeat(dt * np.diag(problem["running"])[None], N + 1, axis=0)
    Q[N] = np.diag(problem["final"])
    R = np.repeat(dt * problem["effort"] * np.eye(mechanism.nu)[None], N, axis=0)
    cost = planner.TrackingCost(Q, R, problem["x_ref"], 0.0, space=mechanism.space)
    dynamics = planner.RigidBodyDynamics(mechanism, dt, problem["integrator"])
    return planner.Problem(dynamics, cost, problem["x0"], problem["us"])


class Case:
    """One problem as this package has it."""

    def __init__(self, problem: dict[str, Any]) -> None:
        from planner.solvers.engine import acquire_engine

        self.problem = posed(problem)
        # The same stop for all: solve() multiplies its tolerance by the cost where that is above 1.
        self.stop, self.enough, self.iterations = problem["stop"], problem["enough"], problem["max_iterations"]
        self.engine = acquire_engine(self.problem)
        self.rewind()
        self.outcome = self.iterate()

    def rewind(self) -> None:
        """Back to the first trajectory."""
        self.cost = self.engine.start_from_controls(self.problem.x0, self.problem.first_guess)

    def iterate(self) -> Any:
        """Linearize, sweep, search, accept: feedback, Armijo, no regularization, no tolerance that could end it."""
        return self.engine.iterate(True, 0, 0.0, True, self.cost, 0.0, -1.0)

    def prepare_solve(self) -> None:
        """Iterations until the cost is low enough, if the problem says what is; and what the stop is relative to."""
        import planner

        plan = planner.solve(self.problem, max_iterations=self.iterations, expected_reduction_tolerance=self.stop)
        self.tolerance = self.stop / max(1.0, plan.cost)
        if self.enough is not None:
            reached = [i for i, line in enumerate(plan.history) if line.cost <= self.enough]
            self.iterations = reached[0] if reached else self.iterations

    def solve(self) -> Any:
        """A whole solve as a user calls it."""
        import planner

        return planner.solve(self.problem, max_iterations=self.iterations, expected_reduction_tolerance=self.tolerance)


_cases: dict[str, Case] = {}


def load(problem: dict[str, Any], probes: dict[str, Any]) -> Answer:
    """Build a problem; accelerations at the probes, and costs."""
    _cases.clear()  # a problem that fails must not leave the last one to be timed
    case = Case(problem)
    rates = case.problem.dynamics.rates(np.array(probes["xs"]), np.array(probes["us"]))
    nv = case.problem.dynamics.mechanism.nv
    _cases["now"] = case
    return {
        "accelerations": rates[:, nv : 2 * nv].tolist(), "cost": case.cost,
        "stepped_cost": case.outcome.cost, "step": case.outcome.step,
    }  # fmt: skip


def iterate(repeats: int, seconds: float) -> Answer:
    """Times of single iterations from the first trajectory."""
    case = _cases["now"]
    return {"times": timed(case.iterate, case.rewind, repeats, seconds)}


def solve(repeats: int, seconds: float) -> Answer:
    """Times of whole solves from the first trajectory."""
    case = _cases["now"]
    if not hasattr(case, "tolerance"):
        case.prepare_solve()
    plan: Any = None

    def whole() -> None:
        nonlocal plan
        plan = case.solve()

    times = timed(whole, lambda: None, repeats, seconds)
    return {
        "times": times, "cost": plan.cost, "iterations": plan.nit,
        "converged": plan.success if case.enough is None else plan.cost <= case.enough, "us": plan.us.tolist(),
    }  # fmt: skip


def judge(us: list[list[float]]) -> Answer:
    """The cost of anybody's controls, rolled out here."""
    case = _cases["now"]
    return {"cost": case.engine.start_from_controls(case.problem.x0, np.array(us))}


def registers() -> Answer:
    """Uses of the vector registers in the code compiled so far; what came from the cache cannot be read back."""
    import planner.kernels

    found = dict.fromkeys(("zmm", "ymm", "xmm"), 0)
    fused, seen = 0, set()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "inspection disabled for cached code"
        for item in pkgutil.walk_packages(planner.kernels.__path__, "planner.kernels."):
            for value in vars(importlib.import_module(item.name)).values():
                for text in value.inspect_asm().values() if hasattr(value, "inspect_asm") else ():
                    if "xmm" not in text or text in seen:
                        continue
                    seen.add(text)
                    fused += len(re.findall(r"\bvfn?m(?:add|sub)", text))
                    for name in found:
                        found[name] += text.count(f"%{name}")
    return {**found, "fused": fused, "kernels": len(seen)}


if __name__ == "__main__":
    serve(hello, {"load": load, "iterate": iterate, "solve": solve, "judge": judge, "registers": registers})
