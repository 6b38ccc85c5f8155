"""Goals of a problem, in their own units, and their tolerances.

Every term of a cost with a final weight has goals: a TrackingCost joint positions and velocities, a FrameCost the
position of a hand. A goal passes within the problem's `tolerance`, else within 2 % of the displacement (of a velocity:
of its peak along the plan), but at least MIN_TOLERANCES. Of a motion so small that no motion would pass, these are a
tenth of the displacement.

A task has goals of its own, of via points and paths at their times (planner.problem.tasks).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import choice
from planner.model.coordinates import coordinates_of
from planner.model.space import space_of
from planner.problem.costs.terms import GoalSpec, SumCost
from planner.problem.problem import Problem
from planner.problem.stances import BOUND, least_kept

SHARE = 0.02  # of the displacement, or of a velocity's peak: the default tolerance
MIN_TOLERANCES = {"rad": 0.02, "m": 5e-3, "rad/s": 0.1, "m/s": 0.05}  # lower limit of a default tolerance, by unit
ROUNDING = 1e-11  # rad or m: a displacement up to this is none
KINDS = ("position", "velocity")


@dataclass(frozen=True, eq=False)
class GoalCheck:
    """A goal with its tolerance: of the end of a cost, or of a task at its times.

    Attributes:
        name: Of the coordinate or frame, "elbow" or "position of hand".
        unit: "rad", "m", "rad/s", "m/s", or another one of the machine's own.
        tolerance: Largest error that passes; infinite for a soft goal.
        error: States (K, nx) -> (K,) errors; K = T with times.
        times: (T,) s; None for the end.
        alone: Whether it has a tolerance of its own, and is listed by name rather than with others of its unit.
    """

    name: str
    unit: str
    tolerance: float
    error: Callable[[np.ndarray], np.ndarray]
    times: tuple[float, ...] | None = None
    alone: bool = False

    def miss(self, t: np.ndarray, xs: np.ndarray) -> float:
        """The largest error of a trajectory, states xs (M, nx) at rising times t (M,)."""
        return float(np.max(self.error(xs[-1:] if self.times is None else between(t, xs, np.array(self.times)))))

    def miss_at(self, x: np.ndarray) -> float:
        """The largest error of a machine at rest in x (nx,)."""
        return static_error(self, x)


def goals_of(problem: Problem, xs: np.ndarray | None = None) -> tuple[GoalCheck, ...]:
    """The goals of a problem; empty where its cost has no final weight.

    Args:
        problem: With any cost.
        xs: (N+1, nx) a plan's states, whose peak velocities scale the tolerances of velocities.

    Raises:
        PlannerError: The problem's tolerance names no goal of it.
    """
    specs = goal_specs_of(problem)
    if isinstance(problem.tolerance, Mapping):
        known = [*KINDS, *dict.fromkeys(one.name for one in specs)]
        for name in problem.tolerance:
            choice("a goal in tolerance", name, known)
    displacements = [(static_error(one, problem.x0), one.unit) for one in specs]
    goals, share = [], tolerance_share(displacements)
    for one in specs:
        given = given_tolerance(problem.tolerance, one)
        tolerance = _default_tolerance(one, problem.x0, xs, share) if given is None else given
        goals.append(GoalCheck(one.name, one.unit, tolerance, one.error, one.times, one.tolerance is not None))
    return tuple(goals)


def missed_goal_message(problem: Problem, t: np.ndarray, xs: np.ndarray) -> str:
    """A message about the goal that states xs (N+1, nx) miss most; "" for none.

    Problems with their own rule of success are judged by the proof alone.
    """
    if problem.periodic is not None:
        return unreturned_message(problem, xs) or ignored_stance_message(problem, t, xs)
    if problem.requirements is not None and problem.requirements.goal is not None:
        return ""
    goals = [one for one in goals_of(problem, xs) if np.isfinite(one.tolerance) and one.tolerance > 0.0]
    over = {one.name: one.miss(t, xs) / one.tolerance for one in goals}
    worst = max(goals, key=lambda one: over[one.name], default=None)
    if worst is None or not over[worst.name] > 1.0:
        return ignored_stance_message(problem, t, xs)
    miss = over[worst.name] * worst.tolerance
    return (
        f"{worst.name} is missed by {miss:.3g} {worst.unit}, and {worst.tolerance:.3g} pass; raise its weight, the "
        "duration or the limits and constraints that keep the motion off"
    )


def ignored_stance_message(problem: Problem, t: np.ndarray, xs: np.ndarray) -> str:
    """A message about the stance that states xs (N+1, nx) keep least; "" where each is kept long enough."""
    if not problem.stances:
        return ""
    stance, share = least_kept(problem.stances, problem.dynamics, t, xs)
    if share >= BOUND:
        return ""
    return f"{stance} is kept in {share:.3g} % of its time, and {BOUND:g} % pass; raise weights.position, or its time"


def unreturned_message(problem: Problem, xs: np.ndarray) -> str:
    """A message about the component of a periodic motion (N+1, nx) that returns least; "" where all do."""
    periodic, space = problem.periodic, space_of(problem.dynamics)
    assert periodic is not None  # its caller has asked
    error = np.abs(periodic.closure_error(space, xs))
    if not np.isfinite(xs).all() or np.all(error <= periodic.tolerance):
        return ""
    i = int(np.argmax(error / periodic.tolerance))
    one = coordinates_of(problem.dynamics)[i]
    return f"{one.name} ends {error[i]:.3g} {one.unit} from where the cycle began, and {periodic.tolerance[i]:.3g} pass"


def has_tolerances(problem: Problem) -> bool:
    """Whether a problem or one of its goals states a tolerance, as a problem file does for all; else defaults hold."""
    return problem.tolerance is not None or any(one.tolerance is not None for one in goal_specs_of(problem))


def goal_specs_of(problem: Problem) -> tuple[GoalSpec, ...]:
    """The goals of a problem's task, else those of its cost's terms."""
    if problem.goal_specs is not None:
        return problem.goal_specs
    coordinates = coordinates_of(problem.dynamics)
    terms = (term for term in terms_of(problem.cost) if hasattr(term, "goal_specs"))
    found = tuple(one for term in terms for one in term.goal_specs(coordinates))
    if problem.periodic is None:
        return found
    # Periodic components have no goal: their final reference is a multiplier (planner.solvers.periodic).
    returning = {one for one, closes in zip(coordinates, problem.periodic.periodic_mask, strict=True) if closes}
    return tuple(one for one in found if (one.name, one.unit) not in returning)


def unchecked_goals(problem: Problem, xs: np.ndarray, us: np.ndarray) -> tuple[str, ...]:
    """Types of the terms with a final part but no goal_specs: a user's own costs."""
    found = []
    for term in () if problem.goal_specs is not None else terms_of(problem.cost):
        if not hasattr(term, "goal_specs"):
            model = term.quadratize(xs, us)
            if np.any(model.Q[-1]) or np.any(model.q[-1]):
                found.append(type(term).__name__)
    return tuple(found)


def stages_asked(problem: Problem) -> np.ndarray:
    """The stages (k,) around the times of a task's goals, without those of paths."""
    found = [one.times[0] for one in problem.goal_specs or () if one.times is not None and len(one.times) == 1]
    at = np.array(found) / problem.dynamics.dt
    return np.unique(np.concatenate([np.floor(at + 1e-9), np.ceil(at - 1e-9)])).astype(int)


def between(t: np.ndarray, xs: np.ndarray, times: np.ndarray) -> np.ndarray:
    """States (..., T, nx) at times (T,), interpolated linearly from xs (..., M, nx) at rising times t (M,)."""
    i = np.clip(np.searchsorted(t, times * (1.0 - 1e-12)), 1, len(t) - 1)
    share = np.clip((times - t[i - 1]) / (t[i] - t[i - 1]), 0.0, 1.0)[:, None]
    return np.where(share > 1.0 - 1e-9, xs[..., i, :], (1.0 - share) * xs[..., i - 1, :] + share * xs[..., i, :])


def static_error(one: GoalSpec | GoalCheck, x: np.ndarray) -> float:
    """The largest error of a machine at rest in x (nx,)."""
    return float(np.max(one.error(np.tile(x, (1 if one.times is None else len(one.times), 1)))))


def terms_of(cost: Any) -> tuple[Any, ...]:
    """The terms of a sum, or the one cost."""
    return cost.costs if isinstance(cost, SumCost) else (cost,)


def tolerance_share(displacements: Iterable[tuple[float, str]]) -> float:
    """The share of MIN_TOLERANCES for goals with these displacements and units: below 1 where no motion would pass."""
    known = ((size, unit) for size, unit in displacements if unit in MIN_TOLERANCES and ROUNDING < size < np.inf)
    largest = max((size / MIN_TOLERANCES[unit] for size, unit in known), default=0.0)
    return 0.1 * largest if 0.0 < largest <= 1.0 else 1.0


def _default_tolerance(one: GoalSpec, x0: np.ndarray, xs: np.ndarray | None, share: float) -> float:
    """The default tolerance of a goal."""
    of_velocity = one.unit not in ("rad", "m")  # an unknown unit may be a velocity
    states = x0[None] if xs is None or not of_velocity else np.concatenate([x0[None], xs])
    scale = float(np.max(one.error(states), initial=0.0, where=np.isfinite(one.error(states))))
    return max(SHARE * scale, share * MIN_TOLERANCES.get(one.unit, 1e-6))


def given_tolerance(tolerance: float | Mapping[str, float] | None, goal: GoalSpec) -> float | None:
    """A problem's tolerance of a goal: by its name, its own, or that of its kind; None for the default."""
    given: Mapping[str, float | None] = tolerance if isinstance(tolerance, Mapping) else dict.fromkeys(KINDS, tolerance)
    kind = KINDS[goal.unit.endswith("/s")]
    return given.get(goal.name, given.get(kind) if goal.tolerance is None else goal.tolerance)
