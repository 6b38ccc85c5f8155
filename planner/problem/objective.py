"""Objectives: effort, energy, jerk or time, or a weighted sum of these; and a problem whose cost is made of them.

    effort    the problem's own weights of the controls, times this weight
    energy    mechanical work of the motors, per J                              planner.problem.costs.motors
    jerk      squared jerk of the joints / 2, per second                        planner.problem.costs.jerk
    time      the duration, per s: constant here, varied by planner.solvers.free_time

Running and final costs of the states are unchanged. Without an effort weight the effort has the weight EFFORT_SHARE,
because controls without effect on the motion would otherwise be undetermined; beside time alone its own, since time
says nothing of the motions of one duration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.model.capabilities import capabilities_of
from planner.model.space import StateSpace, space_of
from planner.problem.costs.jerk import JerkCost, with_acceleration
from planner.problem.costs.motors import EnergyCost
from planner.problem.costs.terms import Quadratic, SumCost, Term, call_if_supported
from planner.problem.costs.tracking import tracking_of
from planner.problem.problem import Problem
from planner.problem.problem_parts import FOUND, Objective, weights_of

EFFORT_SHARE = 0.01
"""Weight of the effort where an objective has none: relative to the problem's own."""
VELOCITY_SHARE = 0.01
"""Of a file's default weights of velocities, where an objective is named: without any, joints swing for little."""


class TimeCost(Term):
    """weight N dt: the same for every motion of a duration (s)."""

    def __init__(self, duration: float, weight: float, space: StateSpace) -> None:
        self.duration, self.weight = duration, number("the time's weight", weight, minimum=0.0)
        self.space, self.nx, self.ndx = space, space.nx, space.ndx

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The weighted duration."""
        return self.weight * self.duration

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Zeros."""
        (N, nu), ndx = us.shape, self.ndx
        return Quadratic(np.zeros((N + 1, ndx, ndx)), np.zeros((N + 1, ndx)), np.zeros((N, nu, nu)), np.zeros((N, nu)))


def rebuilt(problem: Problem, **changes: Any) -> Problem:
    """The problem that its recipe builds with some arguments changed, with its own limits and objective."""
    own = base_problem(problem)
    assert own.recipe is not None  # its caller knows its arguments
    new = replace(base_problem(own.recipe.rebuilt(**changes)), limits=own.limits)
    return new if problem.objective is None else with_objective(new, problem.objective.stored)


def with_objective(problem: Problem, objective: str | Mapping[str, float]) -> Problem:
    """The same task with another criterion; with time in it solve() chooses the duration.

    Args:
        problem: With a TrackingCost, alone or in a sum with DriveCosts, FrameCosts and PenaltyCosts; an objective that
            it has is replaced.
        objective: "effort", "energy", "jerk", "time", or weights by these names, e.g. {"effort": 1, "jerk": 1e-3}; and
            with energy its "smoothing", W (see EnergyCost), which solves take from the motion of least effort (see
            with_smoothing); and with time whether its duration was found by a search (FOUND).

    Raises:
        PlannerError: An unknown name or a negative weight; a machine without actuators or joints to speak of.
    """
    given = dict(objective) if isinstance(objective, Mapping) else {}
    smoothing, found = given.pop("smoothing", None), bool(given.pop(FOUND, False))
    weights = weights_of(given or objective)
    if set(weights) != {"time"}:
        weights = {"effort": EFFORT_SHARE} | weights
    problem = base_problem(problem)
    base, dynamics, effort = problem.cost, problem.dynamics, weights.get("effort", 1.0)
    terms = [base if effort == 1.0 else call_if_supported(base, "with_effort", effort)]
    if "energy" in weights:
        terms.append(EnergyCost(dynamics, weights["energy"], smoothing))
    if "jerk" in weights:
        terms.append(_jerk(problem, weights["jerk"]))
    if "time" in weights:
        terms.append(TimeCost(problem.duration, weights["time"], space_of(dynamics)))
    cost = terms[0] if len(terms) == 1 else SumCost(*terms)
    own = Objective(weights, base, smoothing if "energy" in weights else None, found and "time" in weights)
    return replace(problem, cost=cost, objective=own)


def with_found_duration(problem: Problem) -> Problem:
    """The problem, whose duration solve() keeps though its objective has time."""
    own = problem.objective
    return problem if own is None else replace(problem, objective=replace(own, duration_found="time" in own.weights))


def seeks_duration(problem: Problem) -> bool:
    """Whether the objective has time, and the problem's duration is not yet the best one."""
    own = problem.objective
    return own is not None and "time" in own.weights and not own.duration_found


def _jerk(problem: Problem, weight: float) -> JerkCost:
    """The jerk cost, with zero acceleration before a start at rest and after a goal at rest."""
    mechanism, goal = capabilities_of(problem.dynamics).mechanism, tracking_of(problem.cost)
    if mechanism is None or goal is None:
        return JerkCost(problem.dynamics, problem.N, weight)
    q, v = mechanism.velocities, slice(mechanism.nv, 2 * mechanism.nv)
    at_rest = not goal.x_ref[-1, q].any() and bool(np.abs(goal.Q[-1, v]).max(axis=1).all())
    return JerkCost(problem.dynamics, problem.N, weight, goal.R, from_rest=not problem.x0[q].any(), to_rest=at_rest)


def base_problem(problem: Problem) -> Problem:
    """The problem without an objective, with the cost that it had before."""
    return problem if problem.objective is None else replace(problem, cost=problem.objective.base, objective=None)


def without_objective(problem: Problem) -> Problem:
    """The problem without its objective; that of a file has its default weights again."""
    if (recipe := problem.recipe) is None or recipe.build is None or recipe.parameters.get("objective") is None:
        return base_problem(problem)
    return recipe.rebuilt(objective=None, durations=None, resolved=None)


def lacks_smoothing(problem: Problem) -> bool:
    """Whether the objective has energy, and no motion has told yet how much power there is to smooth."""
    own = problem.objective
    return own is not None and "energy" in own.weights and own.smoothing is None


def with_smoothing(problem: Problem, xs: np.ndarray, us: np.ndarray) -> Problem:
    """The problem; if its energy lacks smoothing, with that of a motion xs (N+1, nx), us (N, nu) (see EnergyCost)."""
    if not lacks_smoothing(problem):
        return problem
    assert problem.objective is not None  # it has energy
    smoothing = EnergyCost(problem.dynamics).smoothing_along(xs, us)
    return with_objective(problem, problem.objective.stored | {"smoothing": smoothing})


def smoothed(problem: Problem, solve: Callable[[Problem], Any]) -> Problem:
    """The problem; if its energy lacks smoothing, with that of its plan of least effort, from which it then starts."""
    if not lacks_smoothing(problem):
        return problem
    usual = solve(without_objective(problem))
    return replace(with_smoothing(problem, usual.xs, usual.us), us=usual.us)


def smoothing_of(problem: Problem | None) -> dict[str, float]:
    """The smoothing of the energy that a problem's objective has, W; nothing without one."""
    own = None if problem is None or problem.objective is None else problem.objective.smoothing
    return {} if own is None else {"smoothing": own}


def solver_problem(problem: Problem) -> Problem:
    """Drop cost terms that no control affects; for jerk, append the previous acceleration to the state."""
    if problem.objective is None:
        return problem
    weights, terms = problem.objective.weights, getattr(problem.cost, "costs", (problem.cost,))
    left = [term for term in terms if not isinstance(term, TimeCost)]
    changed = replace(problem, cost=left[0] if len(left) == 1 else SumCost(*left), objective=None)
    if "jerk" in weights:
        return with_acceleration(changed)
    return changed if "time" in weights else problem
