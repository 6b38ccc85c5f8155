"""The LQ problem of every iteration of a solve, recorded by dynamics that keep the arguments of each line search."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import CompiledDynamics, Dynamics, ResidualDynamics
from planner.model.space import space_of
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.slq import solve


class RecordedSweep(NamedTuple):
    """Result of the compiled sweep for one trajectory."""

    xs: np.ndarray  # (N+1, nx)
    us: np.ndarray  # (N, nu)
    gradient: np.ndarray  # (N, nu), Eq. 19
    K: np.ndarray  # (N, nu, ndx)
    k: np.ndarray  # (N, nu)
    slope: float  # of J along the direction
    regularization: float  # added to R


class _Watched:
    """Compiled dynamics that note workspace and slope whenever a line search begins."""

    def __init__(self, dynamics: Any) -> None:
        known = (Dynamics, CompiledDynamics, ResidualDynamics)
        kinds = known if isinstance(dynamics, ResidualDynamics) else known[:2]
        names = {name for kind in kinds for name in dir(kind) if not name.startswith("_")}
        for name in names - {"search"}:
            setattr(self, name, getattr(dynamics, name))
        self.space = space_of(dynamics)
        self._dynamics = dynamics
        self.seen: list[RecordedSweep] = []

    def search(self, w: Any, memory: Any, rule: int, feedback: bool, cost: float, slope: float) -> tuple[float, float]:
        """Line search from w.xs, w.us; see CompiledDynamics.search."""
        if np.isfinite(cost):  # which is not so where the first guess is rolled out
            K = w.K[:, :, w.first : w.first + w.ndx].copy()
            self.seen.append(RecordedSweep(w.xs.copy(), w.us.copy(), w.gradient.copy(), K, w.k.copy(), slope, 0.0))
        return self._dynamics.search(w, memory, rule, feedback, cost, slope)


def record_solve(problem: Problem, **options: Any) -> tuple[Plan, list[RecordedSweep]]:
    """Solve with options of solve(), and return with the plan the LQ problem of every step that was taken.

    The problem has compiled dynamics and a cost whose R + B'PB is positive definite throughout.
    """
    if not isinstance(problem.dynamics, CompiledDynamics):
        raise PlannerError("the problem's dynamics are not compiled, expected RigidBodyDynamics or HopperDynamics.")
    dynamics = _Watched(problem.dynamics)
    plan = solve(replace(problem, dynamics=dynamics, twin=None, requirements=None), **options)
    lines = zip(plan.history, dynamics.seen, strict=False)  # the last line is the plan, where nothing is searched
    return plan, [step._replace(regularization=line.regularization) for line, step in lines if line.step > 0.0]
