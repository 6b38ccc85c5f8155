"""Step 0 of a proof: whether a plan agrees with its own dynamics and cost. MuJoCo has no part in it."""

from __future__ import annotations

import numpy as np

from planner.base.measured import Measured, Section
from planner.problem.costs.terms import Quadratic
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.scales import cost_of_deviation, limit_violations
from planner.solvers import lq

BOUND = 1e-9  # relative; a plan and its file agree to rounding
GAIN_BOUND = 1e-6  # relative; what rounding becomes in a sweep over unstable stages
_LEAST = 1e-3  # of the cost of a deviation that passes: costs smaller than that are as good as zero


def consistency(plan: Plan, problem: Problem) -> Section:
    """Start, states, cost, gradient, gains and times recomputed from the plan's states and controls."""
    dynamics, cost = problem.dynamics, problem.cost
    with np.errstate(all="ignore"):  # a plan may hold any numbers; a NaN passes no bound
        missed = plan.space.difference(dynamics.step(plan.xs[:-1], plan.us), plan.xs[1:])
        A, B = dynamics.linearize(plan.xs, plan.us)
        quadratic = cost.quadratize(plan.xs, plan.us)
        if plan.hinges is not None and problem.ranges is not None:
            quadratic = problem.ranges.added(plan.hinges, quadratic, plan.xs)
        moves = None if problem.bounds is None else (problem.bounds[0] - plan.us, problem.bounds[1] - plan.us)
        norm = float(np.linalg.norm(lq.projected(lq.gradient(A, B, quadratic), moves)))
        terms = float(np.linalg.norm(quadratic.r)) + norm
        scale = max(abs(plan.cost), _LEAST * cost_of_deviation(quadratic), np.finfo(float).tiny)
        largest = max(1.0, float(np.abs(plan.xs).max()))
        t = dynamics.dt * np.arange(plan.N + 1)
        errors = {
            "start_state_error": (_largest(plan.xs[0] - problem.x0) / largest, "first state against the problem's x0"),
            "stage_error": (_largest(missed) / largest, "each state against one stage from the last"),
            "cost_error": (abs(cost.value(plan.xs, plan.us) - plan.cost) / scale, "the cost recomputed"),
            "gradient_error": (abs(norm - plan.gradient_norm) / max(terms, scale), "the norm of Eq. 19 recomputed"),
            "time_error": (_largest(plan.t - t) / problem.duration, "the knots against n dt"),
        }
        measured = [Measured(n, float(e), "", BOUND, f"{note}, relative") for n, (e, note) in errors.items()]
        measured.append(_gains(plan, A, B, quadratic, moves))
    note = f"changed after the file was written: {', '.join(plan.changed)}" if plan.changed else "of the plan's file"
    measured.append(Measured("changed_parts", float(len(plan.changed)), "", 0.0, note))
    measured += limit_violations(problem, plan.xs, plan.us, "of the plan")
    return Section("plan", tuple(measured))


def _gains(plan: Plan, A: np.ndarray, B: np.ndarray, quadratic: Quadratic, moves: lq.Bounds | None) -> Measured:
    """The gains against a Riccati sweep along the plan."""
    name, sweep = "gain_error", None
    if np.isfinite(A).all() and np.isfinite(B).all() and quadratic.finite:
        sweep = lq.riccati(A, B, quadratic, bounds=moves)
    if sweep is None:
        note = "R + B'PB is not positive definite along the plan: its gains are those of a regularised model"
        return Measured(name, 0.0 if np.isfinite(plan.K).all() else np.inf, "", GAIN_BOUND, note)
    error = _largest(plan.K - sweep.K) / max(_largest(sweep.K), np.finfo(float).tiny)
    return Measured(name, error, "", GAIN_BOUND, "the gains against the last Riccati sweep (Eq. 31-33), relative")


def _largest(values: np.ndarray) -> float:
    """The largest magnitude; NaN when any is."""
    return float(np.abs(values).max())
