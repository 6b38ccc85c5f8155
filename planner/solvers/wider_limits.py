"""A problem with limits that are wider by a factor: a family for a continuation in the limits.

    lower - (f - 1) room <= u <= upper + (f - 1) room,     f >= 1

of the bounds of controls, of servos' forces, and of the ranges of states. The room is half of the width between two
bounds. A bound without an opposite one has room for the plan of the free problem at the factor at which all others have
it. Exact goals and constraints stay as they are. At f = inf the problem is free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from planner.problem.plan import Plan
from planner.problem.problem import Problem

MIN_FREE_FACTOR = 2.0  # factor at which bounds without an opposite one admit the free plan, if no other says more


@dataclass(frozen=True, eq=False)
class WiderLimits:
    """A problem, and how far its free plan is beyond its limits.

    Attributes:
        problem: With bounds of its controls or ranges of its states.
        factor: At which the limits admit the free plan; 1 or less where it is within them.
        controls: (2, N, nu) excess of the free plan's controls below their lower and above their upper bounds.
        states: (2, N+1, H) the same of the ranges of its states.
    """

    problem: Problem
    factor: float
    controls: np.ndarray | None
    states: np.ndarray | None

    @classmethod
    def around(cls, problem: Problem, free: Plan) -> WiderLimits:
        """The family of a problem for its free plan."""
        controls = states = None
        factors = [0.0]
        if problem.bounds is not None:
            controls, factor = _beyond(free.us, *problem.bounds.at(slice(None), free.xs[:-1]))
            factors.append(factor)
        if problem.ranges is not None:
            ways = slice(0, len(problem.ranges.component) - problem.ranges.at_end)  # without exact goals
            sides = (side[:, ways] for side in (problem.ranges.lower, problem.ranges.upper))
            states, factor = _beyond(problem.ranges.deviations(free.xs)[:, ways], *sides)
            factors.append(factor)
        one_sided = any(part is not None and part.any() for part in (controls, states))
        return cls(problem, max(*factors, MIN_FREE_FACTOR if one_sided else 0.0), controls, states)

    def at(self, factor: float) -> Problem:
        """The problem with limits `factor` times as wide; the problem itself at 1."""
        if factor == 1.0:
            return self.problem
        bounds, ranges, more = self.problem.bounds, self.problem.ranges, factor - 1.0
        scale = more / max(self.factor - 1.0, 1.0)  # of excess, which is room at the free plan's factor
        if bounds is not None:
            lower, upper = _wider(bounds.lower, bounds.upper, more, self.controls, scale)
            servos = bounds.servos
            if servos is not None:
                low, high = _wider(servos.low, servos.high, more, None, scale)
                servos = replace(servos, low=low, high=high)
            bounds = None if np.isinf(factor) else replace(bounds, lower=lower, upper=upper, servos=servos)
        if ranges is not None:
            ways = len(ranges.component) - ranges.at_end
            lower, upper = ranges.lower.copy(), ranges.upper.copy()
            lower[:, :ways], upper[:, :ways] = _wider(
                ranges.lower[:, :ways], ranges.upper[:, :ways], more, self.states, scale
            )
            ranges = replace(ranges, lower=lower, upper=upper) if np.isfinite([lower, upper]).any() else None
        return self.problem.with_bounds(bounds, ranges)


def free_problem(problem: Problem) -> Problem:
    """The problem without bounds of its controls and ranges of its states; exact goals and constraints stay."""
    return WiderLimits(problem, 1.0, None, None).at(np.inf)


def at_limits(problem: Problem, plan: Plan) -> bool:
    """Whether a plan is at a bound of its controls or of a range of its states, or beyond."""
    if problem.bounds is not None and problem.bounds.at_bound(plan.xs, plan.us).any():
        return True
    ranges = problem.ranges
    if ranges is None:
        return False
    ways = len(ranges.component) - ranges.at_end
    assert problem.trajectory_constraints is not None  # of the ranges
    return bool(ranges.at_bound(plan.xs, problem.trajectory_constraints.tolerance)[1:, :ways].any())


def _beyond(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, float]:
    """(2, M, K) excess of values (M, K) beyond bounds without an opposite one, and the factor of all others."""
    with np.errstate(invalid="ignore", divide="ignore"):
        half = 0.5 * (upper - lower)
        two_sided = np.isfinite(half) & (half > 0.0)
        factors = np.where(two_sided, np.abs(values - 0.5 * (lower + upper)) / half, 0.0)
    excess = np.stack([lower - values, values - upper])
    excess = np.where(two_sided, 0.0, excess.max(axis=1, initial=0.0)[:, None])
    return excess, float(factors.max(initial=0.0))


def _wider(
    lower: np.ndarray, upper: np.ndarray, more: float, excess: np.ndarray | None, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds moved outwards by `more` times half of their width; those without an opposite by `scale` times excess."""
    with np.errstate(invalid="ignore"):
        half = 0.5 * (upper - lower)
        room = np.where(np.isfinite(half), more * half, 0.0)
    if np.isinf(more):
        return np.full_like(lower, -np.inf), np.full_like(upper, np.inf)
    below, above = (0.0, 0.0) if excess is None else scale * excess
    return lower - room - below, upper + room + above
