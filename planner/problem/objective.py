"""Objectives: what a motion is to be sparing of. Effort, energy, jerk and time, alone or weighted against each other.

    effort    the problem's own weights of the controls, times this weight
    energy    mechanical work of the motors, per J                              planner.problem.costs.energy
    jerk      squared jerk of the joints / 2, per second                        planner.problem.costs.jerk
    time      the duration, per s: constant here, varied by planner.solvers.free_time

What the problem's cost asks of states, on the way and at the end, stays as it is. A part of the effort, EFFORT_SHARE,
is kept where none is asked for: without it nothing would choose among controls that move nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planner.base.arguments import choice, number, shown
from planner.base.errors import PlannerError
from planner.model.space import StateSpace, space_of
from planner.problem.costs.drive import DriveCost
from planner.problem.costs.energy import EnergyCost
from planner.problem.costs.frame import FrameCost
from planner.problem.costs.jerk import JerkCost, with_acceleration
from planner.problem.costs.penalty import PenaltyCost
from planner.problem.costs.tracking import Cost, Quadratic, SumCost, Term, TrackingCost, tracking_of
from planner.problem.problem import Problem

OBJECTIVES = ("effort", "energy", "jerk", "time")
EFFORT_SHARE = 0.01
"""Weight of the effort where an objective has none: relative to the problem's own."""


@dataclass(frozen=True, eq=False)
class Objective:
    """What a problem's cost was made of.

    Attributes:
        weights: Above 0, by names of OBJECTIVES; what with_objective was given, and the share of effort.
        base: The problem's cost before.
    """

    weights: dict[str, float]
    base: Cost


class TimeCost(Term):
    """weight N dt: the same for every motion of a duration.

    Args:
        duration: N dt, s.
        weight: Per s.
        space: Of the states.
    """

    def __init__(self, duration: float, weight: float, space: StateSpace) -> None:
        self.duration, self.weight = duration, number("the time's weight", weight, least=0.0)
        self.space, self.nx, self.ndx = space, space.nx, space.ndx

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The weighted duration."""
        return self.weight * self.duration

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Zeros."""
        (N, nu), ndx = us.shape, self.ndx
        return Quadratic(np.zeros((N + 1, ndx, ndx)), np.zeros((N + 1, ndx)), np.zeros((N, nu, nu)), np.zeros((N, nu)))


def weights_of(objective: Any) -> dict[str, float]:
    """The weights above 0 of an objective: a name, or weights by name.

    Raises:
        PlannerError: An unknown name, a weight that is not finite or negative, or none above 0.
    """
    if isinstance(objective, str):
        return {choice("objective", objective, OBJECTIVES): 1.0}
    if not isinstance(objective, Mapping):
        raise PlannerError(
            f"objective is {shown(objective)}, expected one of {', '.join(OBJECTIVES)}, or weights by these names."
        )
    weights = {
        choice("objective", name, OBJECTIVES): number(f"the weight of {name}", weight, least=0.0)
        for name, weight in objective.items()
    }
    weights = {name: weights[name] for name in OBJECTIVES if weights.get(name)}
    if not weights:
        raise PlannerError(f"no weight of the objective is above 0, expected some of {', '.join(OBJECTIVES)}.")
    return weights


def checked_durations(durations: Any, weights: Mapping[str, float]) -> tuple[float, float] | None:
    """The shortest and the longest duration, s, which an objective with time needs and any other refuses.

    Raises:
        PlannerError: There are some and no time, or time and none; not two numbers that rise.
    """
    if "time" not in weights:
        if durations is not None:
            raise PlannerError(f"durations are {shown(durations)}, expected none without time in the objective.")
        return None
    pair = isinstance(durations, (Sequence, np.ndarray)) and not isinstance(durations, str) and len(durations) == 2
    if not pair:
        raise PlannerError(f"durations is {shown(durations)}, expected (shortest, longest) in s, which time needs.")
    shortest, longest = (number("a duration", value, above=0.0) for value in durations)
    if not shortest < longest:
        raise PlannerError(f"durations are {shortest:g} and {longest:g} s, expected the shortest before the longest.")
    return shortest, longest


def with_objective(problem: Problem, objective: str | Mapping[str, float]) -> Problem:
    """The same task with another criterion, at its own duration.

    Args:
        problem: With a TrackingCost, alone or in a sum with DriveCosts, FrameCosts and PenaltyCosts; an objective that
            it has is replaced.
        objective: "effort", "energy", "jerk", "time", or weights by these names, e.g. {"effort": 1, "jerk": 1e-3}.

    Raises:
        PlannerError: An unknown name or a negative weight; a machine without actuators or joints to speak of.
    """
    weights = {"effort": EFFORT_SHARE} | weights_of(objective)
    problem = plain(problem)
    base, dynamics = problem.cost, problem.dynamics
    terms = [_with_effort(base, weights["effort"])]
    if "energy" in weights:
        terms.append(EnergyCost(dynamics, weights["energy"]))
    if "jerk" in weights:
        terms.append(_jerk(problem, weights["jerk"]))
    if "time" in weights:
        terms.append(TimeCost(problem.duration, weights["time"], space_of(dynamics)))
    cost = terms[0] if len(terms) == 1 else SumCost(*terms)
    return replace(problem, cost=cost, objective=Objective(weights, base))


def _with_effort(cost: Cost, weight: float) -> Cost:
    """A cost with its control weights multiplied."""
    if weight == 1.0 or isinstance(cost, (DriveCost, FrameCost, PenaltyCost)):
        return cost
    if isinstance(cost, SumCost):
        return SumCost(*(_with_effort(term, weight) for term in cost.costs))
    if type(cost) is not TrackingCost:
        raise PlannerError(
            f"the cost is of the type {type(cost).__name__}, expected a TrackingCost or a sum of TrackingCost, "
            "DriveCost, FrameCost and PenaltyCost: the effort in nothing else can be weighed."
        )
    return TrackingCost(cost.Q, weight * cost.R, cost.x_ref, cost.u_ref, cost.space)


def _jerk(problem: Problem, weight: float) -> JerkCost:
    """Held before a start at rest, and after a goal at rest."""
    mechanism, goal = getattr(problem.dynamics, "mechanism", None), tracking_of(problem.cost)
    if mechanism is None or goal is None:
        return JerkCost(problem.dynamics, problem.N, weight)
    q, v = slice(mechanism.nq, mechanism.nq + mechanism.nv), slice(mechanism.nv, 2 * mechanism.nv)
    stops = not goal.x_ref[-1, q].any() and bool(np.abs(goal.Q[-1, v]).max(axis=1).all())
    return JerkCost(problem.dynamics, problem.N, weight, goal.R, from_rest=not problem.x0[q].any(), to_rest=stops)


def plain(problem: Problem) -> Problem:
    """The problem without an objective, with the cost that it had before."""
    return problem if problem.objective is None else replace(problem, cost=problem.objective.base, objective=None)


def solver_problem(problem: Problem) -> Problem:
    """What SLQ iterates on: without what no control changes, and with an added state where jerk counts."""
    if problem.objective is None:
        return problem
    weights, terms = problem.objective.weights, getattr(problem.cost, "costs", (problem.cost,))
    left = [term for term in terms if not isinstance(term, TimeCost)]
    changed = replace(problem, cost=left[0] if len(left) == 1 else SumCost(*left), objective=None)
    if "jerk" in weights:
        return with_acceleration(changed)
    return changed if "time" in weights else problem
