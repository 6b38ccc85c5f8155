"""Rate and horizon of a controller, and its prediction of the state after the latency."""

from __future__ import annotations

import numpy as np

from planner.base.arguments import count, number, short_repr
from planner.base.errors import PlannerError
from planner.problem.plan import Plan
from planner.problem.problem import Problem

TIME_TOLERANCE = 1e-6  # of a stage: smaller differences of time are zero


def horizon_and_rate(problem: Problem, horizon: int | None = None, rate: float | None = None) -> tuple[int, float]:
    """Number of stages and rate, Hz, of a controller; a PlannerError for invalid or incompatible arguments."""
    if not isinstance(problem, Problem):
        more = "; write Controller(plan.problem, plan=plan)" if isinstance(problem, Plan) else ""
        raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem{more}.")
    dt = problem.dynamics.dt
    H = problem.N if horizon is None else count("horizon", horizon)
    rate = 1.0 / dt if rate is None else number("rate", rate, greater_than=0.0)
    if rate * dt > 1.0 + 1e-9:
        raise PlannerError(
            f"the rate is {rate:.6g} Hz and the horizon has stages of {dt:.4g} s, expected at most one plan per "
            f"stage, {1.0 / dt:.6g} Hz, or a problem with dt = {1.0 / rate:.4g}; in between the gains act."
        )
    if rate * H * dt < 1.0 - 1e-9:
        raise PlannerError(
            f"the rate is {rate:.4g} Hz and a plan ends after {H * dt:.4g} s, expected at least "
            f"{1.0 / (H * dt):.4g} Hz, or a longer horizon."
        )
    return H, rate


def state_after(problem: Problem, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray:
    """The state (nx,) after `seconds` of constant control u (nu,) from x (nx,), by the problem's dynamics."""
    left, dt = seconds, problem.dynamics.dt
    while left > TIME_TOLERANCE * dt:
        length = min(left, dt)
        left -= length
        x = problem.dynamics.step(x[None], u[None], np.array([length]))[0]
    return x
