"""The states of a controller's goals, and whether a goal is an equilibrium."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.model.capabilities import capabilities_of
from planner.model.space import space_of
from planner.problem.costs.residuals.cost import ResidualCost
from planner.problem.costs.tracking import states, tracking_of
from planner.problem.goals import terms_of
from planner.problem.problem import Problem
from planner.proof.goal_regulator import hold_gain


def goal_states(problem: Problem, goal: Any, horizon: int) -> np.ndarray:
    """The state (nx,) of a goal: a keyframe's name, positions (nq,) or a state; or states (horizon + 1, nx)."""
    mechanism, space = capabilities_of(problem.dynamics).mechanism, space_of(problem.dynamics)
    if isinstance(goal, str):
        if mechanism is None:
            raise PlannerError(f"goal is {short_repr(goal)}, expected a state: the machine has no keyframes.")
        return mechanism.keyframe(goal)
    if mechanism is not None and np.shape(goal) == (mechanism.nq,) != (space.nx,):
        goal = np.concatenate([np.asarray(goal, dtype=float), np.zeros(space.nx - mechanism.nq)])
    return states("goal", goal, space, () if np.ndim(goal) < 2 else (horizon + 1,))


def goal_stays(problem: Problem) -> bool:
    """Whether some control makes the goal an equilibrium; True for goals of frames or without a final weight."""
    goal = tracking_of(problem.cost)
    frames = any(isinstance(one, ResidualCost) and one.goal_rows() for one in terms_of(problem.cost))
    if goal is None or frames or not np.any(goal.Q[-1]):
        return True
    try:
        hold_gain(problem)
    except PlannerError:
        return False
    return True
