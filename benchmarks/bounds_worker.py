"""A bounded solve, served to bounds.py: Crocoddyl's SolverBoxFDDP where its interpreter runs this, else ours."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
from serving import Answer, serve, timed

THEIRS = importlib.util.find_spec("crocoddyl") is not None


class Ours:
    """This package on a bounded problem."""

    def __init__(self, problem: dict[str, Any], bounds: list[list[float]] | None) -> None:
        from dataclasses import replace

        import planner_worker

        import planner

        limits = None if bounds is None else planner.Limits(control=tuple(map(np.array, bounds)))
        self.problem, self.stop = replace(planner_worker.posed(problem), limits=limits), problem["stop"]
        self.tolerance = self.stop

    def prepare(self) -> None:
        """The same stop as the peer's, which is not relative to the cost."""

    def solve(self) -> None:
        """A whole solve."""
        import planner

        self.plan = planner.solve(self.problem, expected_reduction_tolerance=self.tolerance)
        self.tolerance = self.stop / max(1.0, self.plan.cost)

    def result(self) -> Answer:
        """Iterations, cost and controls of the last solve."""
        plan = self.plan
        return {"iterations": plan.nit, "cost": plan.cost, "us": plan.us.tolist(), "ended": plan.status.name}


class Theirs:
    """Crocoddyl on the same."""

    def __init__(self, problem: dict[str, Any], bounds: list[list[float]] | None) -> None:
        import crocoddyl
        import crocoddyl_worker

        self.case = crocoddyl_worker.Case(problem)
        for model in self.case.shooting.runningModels:
            if bounds is not None:
                model.u_lb, model.u_ub = map(np.array, bounds)
        self.solver = crocoddyl.SolverBoxFDDP(self.case.shooting)
        self.solver.th_stop = problem["stop"]

    def prepare(self) -> None:
        """Nothing is left from the last solve."""

    def solve(self) -> None:
        """A whole solve from the first guess and its rollout."""
        self.converged = self.solver.solve(self.case.xs, self.case.us, 1000, True)

    def result(self) -> Answer:
        """Iterations, cost and controls of the last solve; the cost of the rollout of its controls."""
        us = list(self.solver.us)
        cost = float(self.case.shooting.calc(self.case.shooting.rollout(us), us))
        ended = "CONVERGED" if self.converged else "not converged"
        return {"iterations": int(self.solver.iter) + 1, "cost": cost, "us": np.array(us).tolist(), "ended": ended}


_cases: dict[str, Any] = {}


def hello() -> Answer:
    """What is installed."""
    module = __import__("crocoddyl" if THEIRS else "planner")
    return {"version": module.__version__}


def load(problem: dict[str, Any], bounds: list[list[float]] | None) -> Answer:
    """Build a problem and solve it once."""
    _cases["now"] = (Theirs if THEIRS else Ours)(problem, bounds)
    _cases["now"].solve()
    _cases["now"].solve()
    return _cases["now"].result()


def solve(repeats: int, seconds: float) -> Answer:
    """Times of whole solves."""
    case = _cases["now"]
    return {"times": timed(case.solve, case.prepare, repeats, seconds)}


if __name__ == "__main__":
    serve(hello, {"load": load, "solve": solve})
