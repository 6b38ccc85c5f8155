"""Goals: what the end of a problem's cost asks for, in its own units, and how far from it passes.

Every term of a cost with a final weight asks for something: a TrackingCost for joint positions and velocities, a
FrameCost for a place of the hand. A goal passes within the problem's `tolerance`, else within 2 % of its way (of a
velocity: of its peak along the plan), but never less than LEAST: nobody measures a robot better than that by eye. Of a
motion so small that doing nothing would pass, LEAST is less in proportion: a tenth of the way.

A task says itself what is wanted and how near (planner.problem.tasks), of waypoints and paths at their times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import choice
from planner.model.coordinates import coordinates_of
from planner.problem.costs.goal_spec import GoalSpec
from planner.problem.costs.terms import SumCost
from planner.problem.problem import Problem

SHARE = 0.02  # of the way, or of a velocity's peak
MIN_TOLERANCES = {"rad": 0.02, "m": 5e-3, "rad/s": 0.1, "m/s": 0.05}  # by unit; 0 for others
ROUNDING = 1e-11  # rad or m: a way no longer than that is none, and to stay is the task
KINDS = ("position", "velocity")


@dataclass(frozen=True, eq=False)
class GoalCheck:
    """One thing that the end of a cost asks for, or a task at its times.

    Attributes:
        name: The coordinate or the frame, "elbow" or "position of hand".
        unit: "rad", "m", "rad/s", "m/s", or another one of the machine's own.
        tolerance: The largest miss that passes; infinite for a goal that is soft.
        error: States (K, nx) -> (K,) how far they are from it; K = T with times.
        times: (T,) s, when it is asked for; None for the end.
        alone: Whether it has a tolerance of its own, and is listed by its name rather than with others of its unit.
    """

    name: str
    unit: str
    tolerance: float
    error: Callable[[np.ndarray], np.ndarray]
    times: tuple[float, ...] | None = None
    alone: bool = False

    def miss(self, t: np.ndarray, xs: np.ndarray) -> float:
        """The largest distance of a motion, states xs (M, nx) at rising times t (M,), from what is asked for."""
        return float(np.max(self.error(xs[-1:] if self.times is None else between(t, xs, np.array(self.times)))))

    def miss_at(self, x: np.ndarray) -> float:
        """The largest distance of a machine that stays at x (nx,)."""
        return static_error(self, x)


def goals_of(problem: Problem, xs: np.ndarray | None = None) -> tuple[GoalCheck, ...]:
    """The goals of a problem; empty where its cost has no final weight.

    Args:
        problem: With any cost.
        xs: (N+1, nx) a plan's states, whose peak velocities are the scale of goals for velocities.

    Raises:
        PlannerError: The problem's tolerance names no goal of it.
    """
    specs = goal_specs_of(problem)
    asked = _asked(problem.tolerance, [one.name for one in specs])
    ways = [(static_error(one, problem.x0), one.unit) for one in specs]
    goals, share = [], least_share(ways)
    for one in specs:
        kind = KINDS[one.unit.endswith("/s")]
        given = asked.get(one.name, asked.get(kind) if one.tolerance is None else one.tolerance)
        tolerance = _usual(one, problem.x0, xs, share) if given is None else given
        goals.append(GoalCheck(one.name, one.unit, tolerance, one.error, one.times, one.tolerance is not None))
    return tuple(goals)


def missed_goal_message(problem: Problem, t: np.ndarray, xs: np.ndarray) -> str:
    """Which goal a motion xs (N+1, nx) misses most, by how much, and what to do; "" for none.

    Machines with a rule of their own for what they achieve are judged by their proof alone.
    """
    if problem.periodic is not None or (problem.requirements is not None and problem.requirements.goal is not None):
        return ""
    goals = [one for one in goals_of(problem, xs) if np.isfinite(one.tolerance) and one.tolerance > 0.0]
    over = {one.name: one.miss(t, xs) / one.tolerance for one in goals}
    worst = max(goals, key=lambda one: over[one.name], default=None)
    if worst is None or not over[worst.name] > 1.0:
        return ""
    miss = over[worst.name] * worst.tolerance
    return (
        f"{worst.name} is missed by {miss:.3g} {worst.unit}, and {worst.tolerance:.3g} pass; weigh the goal more, give "
        "it more time, or widen what holds the motion off"
    )


def goal_specs_of(problem: Problem) -> tuple[GoalSpec, ...]:
    """What a problem's task asks for, else what the terms of its cost ask of its end."""
    if problem.goal_specs is not None:
        return problem.goal_specs
    coordinates = coordinates_of(problem.dynamics)
    found = tuple(one for term in terms_of(problem.cost) for one in getattr(term, "goal_specs", _nothing)(coordinates))
    if problem.periodic is None:
        return found
    # What is to come back has no goal of its own: its reference at the end is a multiplier (planner.solvers.periodic).
    returning = {one for one, closes in zip(coordinates, problem.periodic.periodic_mask, strict=True) if closes}
    return tuple(one for one in found if (one.name, one.unit) not in returning)


def unchecked_goals(problem: Problem, xs: np.ndarray, us: np.ndarray) -> tuple[str, ...]:
    """The terms with a final part that do not say what they ask for, by their type: a user's own costs."""
    found = []
    for term in () if problem.goal_specs is not None else terms_of(problem.cost):
        if not hasattr(term, "goal_specs"):
            model = term.quadratize(xs, us)
            if np.any(model.Q[-1]) or np.any(model.q[-1]):
                found.append(type(term).__name__)
    return tuple(found)


def stages_asked(problem: Problem) -> np.ndarray:
    """The stages (k,) at which a task asks for something; those of paths aside."""
    found = [one.times[0] for one in problem.goal_specs or () if one.times is not None and len(one.times) == 1]
    return np.unique(np.round(np.array(found) / problem.dynamics.dt)).astype(int)


def between(t: np.ndarray, xs: np.ndarray, times: np.ndarray) -> np.ndarray:
    """States (..., T, nx) at times (T,) of motions xs (..., M, nx) at rising times t (M,), on lines between them."""
    i = np.clip(np.searchsorted(t, times * (1.0 - 1e-12)), 1, len(t) - 1)
    share = np.clip((times - t[i - 1]) / (t[i] - t[i - 1]), 0.0, 1.0)[:, None]
    return np.where(share > 1.0 - 1e-9, xs[..., i, :], (1.0 - share) * xs[..., i - 1, :] + share * xs[..., i, :])


def static_error(one: GoalSpec | GoalCheck, x: np.ndarray) -> float:
    """The largest distance of a machine that stays at x (nx,) from what is asked for."""
    return float(np.max(one.error(np.tile(x, (1 if one.times is None else len(one.times), 1)))))


def terms_of(cost: Any) -> tuple[Any, ...]:
    """The terms of a sum, or the one cost."""
    return cost.costs if isinstance(cost, SumCost) else (cost,)


def _nothing(_: Any) -> tuple[GoalSpec, ...]:
    return ()


def least_share(ways: Iterable[tuple[float, str]]) -> float:
    """The share of LEAST that goals with these ways, and units, have: less than 1 where doing nothing would pass."""
    known = ((way, unit) for way, unit in ways if unit in MIN_TOLERANCES and ROUNDING < way < np.inf)
    largest = max((way / MIN_TOLERANCES[unit] for way, unit in known), default=0.0)
    return 0.1 * largest if 0.0 < largest <= 1.0 else 1.0


def _usual(one: GoalSpec, x0: np.ndarray, xs: np.ndarray | None, share: float) -> float:
    """The tolerance of a goal for which the problem states none."""
    of_path = one.unit not in ("rad", "m")  # an unknown unit may be a velocity
    states = x0[None] if xs is None or not of_path else np.concatenate([x0[None], xs])
    scale = float(np.max(one.error(states), initial=0.0, where=np.isfinite(one.error(states))))
    return max(SHARE * scale, share * MIN_TOLERANCES.get(one.unit, 1e-6))


def _asked(tolerance: Any, names: list[str]) -> dict[str, float]:
    """Tolerances by the name of a goal, or by one of KINDS."""
    if tolerance is None:
        return {}
    if isinstance(tolerance, Mapping):
        known = [*KINDS, *dict.fromkeys(names)]
        return {choice("a goal in tolerance", name, known): value for name, value in tolerance.items()}
    return dict.fromkeys(KINDS, tolerance)
