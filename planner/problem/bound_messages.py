"""Where a plan is at the bounds of its controls, or outside of ranges and constraints, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from planner.model.mechanism import Mechanism
from planner.problem.problem import Problem

_AT_BOUND_SHARE = 1e-6  # of a range: at its bound
_OFTEN = 0.1  # of the stages: then bounds are what a motion hangs on
_MAX_NAMED = 3  # constraints that are named
_GAINED = 1e-3  # of the cost: a second half of a solve that gains less has stalled


def control_name(problem: Problem, place: int) -> str:
    """A control by the name of its actuator, for a sentence."""
    mechanism = getattr(problem.dynamics, "mechanism", None)
    names = mechanism.actuators.names if isinstance(mechanism, Mechanism) else ()
    return f"actuator {names[place]!r}" if place < len(names) and names[place] else f"control {place}"


def control_at_bound(problem: Problem, xs: np.ndarray, us: np.ndarray) -> str:
    """The control that is most often at a bound along xs (N+1, nx), us (N, nu), and in how many stages; "" for none."""
    if problem.bounds is None:
        return ""
    lower, upper = problem.bounds.at(slice(None), xs[: len(us)])
    with np.errstate(invalid="ignore"):
        near = _AT_BOUND_SHARE * np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    stages = ((us <= lower + near) | (us >= upper - near)).sum(axis=0)
    worst = int(np.argmax(stages))
    if stages[worst] < max(1, _OFTEN * len(us)):
        return ""
    return f"{control_name(problem, worst)} is at its bound in {stages[worst]} of {len(us)} stages"


def state_at_bound(problem: Problem, xs: np.ndarray) -> str:
    """The coordinate that is most often at a bound along the states xs (N+1, nx), and how often; "" for none."""
    ranges, limits = problem.ranges, problem.limits
    if ranges is None or limits is None or not np.isfinite(xs).all():
        return ""
    knots = ranges.at_bound(xs, limits.tolerance)[:, : len(ranges.component) - ranges.at_end].sum(axis=0)
    worst = int(np.argmax(knots)) if len(knots) else -1
    if worst < 0 or knots[worst] < max(1, _OFTEN * len(xs)):
        return ""
    return f"the {ranges.coordinates[worst].name} is at its limit at {knots[worst]} of {len(xs)} knots"


def state_outside(problem: Problem, xs: np.ndarray, t: np.ndarray) -> str:
    """What of the states xs (N+1, nx) is furthest outside of its range, and when; "" where nothing is."""
    limits, ranges = problem.limits, problem.ranges
    if ranges is None or limits is None or not np.isfinite(xs).all():
        return ""
    beyond = ranges.violation(xs)
    n, worst = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    if beyond[n, worst] <= limits.tolerance:
        return ""
    name, unit = ranges.coordinates[worst]
    where = "from its exact goal" if worst >= len(ranges.component) - ranges.at_end else "outside of its range"
    return f"{name} is {beyond[n, worst]:.3g} {unit}".rstrip() + f" {where} at t = {t[n]:.3g} s"


def constraints_broken(problem: Problem, xs: np.ndarray, us: np.ndarray, t: np.ndarray) -> str:
    """The constraints that states xs (N+1, nx) and controls us (N, nu) break, how far and when; "" where none is."""
    rows = None if problem.trajectory_constraints is None else problem.trajectory_constraints.rows
    if rows is None or not np.isfinite(xs).all():
        return ""
    broken = [one for one in rows.violations(xs, us) if not one.value <= one.constraint.allowed()]
    broken.sort(key=lambda one: -one.value / one.constraint.allowed())
    said = [
        f"{one.constraint} is broken by {one.value:.3g} {one.constraint.unit}".rstrip() + f" at t = {t[one.at]:.3g} s"
        for one in broken[:_MAX_NAMED]
    ]
    more = len(broken) - _MAX_NAMED
    return ", ".join(said) + (f", and {more} more" if more > 0 else "")


def stalled(history: Sequence[Any], cost: float) -> bool:
    """Whether the second half of a solve's iterations hardly lowered its cost."""
    half = history[len(history) // 2 :]
    return len(half) > 2 and half[0].cost - cost <= _GAINED * abs(cost)
