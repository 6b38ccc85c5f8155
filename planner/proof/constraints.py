"""Whether a plan and its replays keep the constraints of the problem, each in its own unit.

The plan must keep them at its knots to their tolerance. A replay is looked at in every step of the simulator, so
between knots too, and may be beyond by what errors make of h that pass as errors of the path: the root of the sum of
squares of dh/dx_i times the bound of x_i, the largest along the plan. What takes controls may be beyond by a hundredth
of its own size too, since gains correct.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from planner.base.measured import Measurement
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.constraint_stack import ConstraintStack
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.error_scales import path_error_bounds
from planner.proof.replays.replaying import Replay

CORRECTION = 0.01  # of the largest |h| along the plan, of what takes controls


def planned_violations(plan: Plan, problem: Problem) -> list[Measurement]:
    """The largest violation of each constraint at the plan's knots."""
    rows = _rows(problem)
    if rows is None:
        return []
    allowed = {id(one): (one.allowed(), "at the plan's knots") for one in rows.constraints}
    return _measured(rows, plan.xs, plan.us, plan.t, allowed)


def replayed_violations(run: Replay, problem: Problem, among: Sequence[Constraint] | None = None) -> list[Measurement]:
    """The largest violation of each constraint in a replay, at any of its steps; of all, or of those `among`."""
    rows = _rows(problem)
    if rows is None:
        return []
    plan = run.plan
    us = run.ctrl if run.ctrl.shape[1] == plan.us.shape[1] else np.repeat(plan.us, run.substeps, axis=0)
    reach, note = _reach(rows, plan), "in MuJoCo; the bound is what errors of the path make of it that pass"
    allowed = {
        id(one): (one.allowed(), "in MuJoCo") if one.allowed() >= reach[id(one)] else (reach[id(one)], note)
        for one in rows.constraints
    }
    wanted = {id(one) for one in (rows.constraints if among is None else among)}
    return _measured(rows, run.xs, us, run.t, {key: bound for key, bound in allowed.items() if key in wanted})


def _rows(problem: Problem) -> ConstraintStack | None:
    return None if problem.trajectory_constraints is None else problem.trajectory_constraints.rows


def _reach(rows: ConstraintStack, plan: Plan) -> dict[int, float]:
    """How far errors of the path that pass move each constraint, at the knots where it is asked for."""
    found, bounds = dict[int, float](), path_error_bounds(plan)
    us = np.concatenate([plan.us, plan.us[-1:]])
    for part in rows.parts:
        columns = part.columns
        n = np.flatnonzero((np.isfinite(rows.lower) | np.isfinite(rows.upper))[:, columns].any(axis=1))
        xs = plan.xs[n + part.at_end]
        by_x, _ = part.function.derivatives(xs, us[n], n)
        moved = float(np.sqrt(np.sum((by_x * bounds) ** 2, axis=2)).max(initial=0.0))
        if part.function.of_controls:
            moved = max(moved, CORRECTION * float(np.abs(part.function.values(xs, us[n], n)).max(initial=0.0)))
        found[id(part.constraint)] = max(found.get(id(part.constraint), 0.0), moved)
    return found


def _measured(
    rows: ConstraintStack, xs: np.ndarray, us: np.ndarray, t: np.ndarray, allowed: dict[int, tuple[float, str]]
) -> list[Measurement]:
    measured, used = [], set[str]()
    known = bool(np.isfinite(xs).all() and np.isfinite(us).all())
    parts = {id(part.constraint): part.constraint for part in rows.parts if id(part.constraint) in allowed}
    found = rows.violations(xs, us) if known else []
    values = {id(one.constraint): (one.value, one.at) for one in found}
    for key, constraint in parts.items():
        value, at = values.get(key, (np.inf, 0))
        bound, note = allowed[key]
        when = f" at t = {t[at]:.4g} s" if 0.0 < value < np.inf else ""
        name = _key(constraint, used)
        measured.append(Measurement(name, value, constraint.unit, bound, f"{constraint.name}: largest{when}, {note}"))
    return measured


def _key(constraint: Constraint, used: set[str]) -> str:
    """A snake_case key, which no other constraint of the problem has."""
    word = "_".join("".join(c if c.isalnum() else " " for c in constraint.name.lower()).split()) or "constraint"
    key, number = f"{word}_violation", 2
    while key in used:
        key, number = f"{word}_{number}_violation", number + 1
    used.add(key)
    return key
