"""Objectives: effort, energy, jerk or time, or a weighted sum of these.

    effort    the problem's own weights of the controls, times this weight
    energy    mechanical work of the motors, per J                              planner.problem.costs.energy
    jerk      squared jerk of the joints / 2, per second                        planner.problem.costs.jerk
    time      the duration, per s: constant here, varied by planner.solvers.free_time

Running and final costs of the states are unchanged. Without an effort weight the effort has the weight EFFORT_SHARE,
because controls without effect on the motion would otherwise be undetermined.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import choice, number, short_repr
from planner.base.errors import PlannerError
from planner.problem.costs.terms import Cost

OBJECTIVES = ("effort", "energy", "jerk", "time")
EFFORT_SHARE = 0.01
"""Weight of the effort where an objective has none: relative to the problem's own."""
VELOCITY_SHARE = 0.01
"""Of a file's default weights of velocities, where an objective is named: without any, joints swing for little."""


@dataclass(frozen=True, eq=False)
class Objective:
    """The weights of a problem's objective, and its cost without them.

    Attributes:
        weights: Above 0, by names of OBJECTIVES: the arguments of with_objective, and the share of effort.
        base: The problem's cost before with_objective.
    """

    weights: dict[str, float]
    base: Cost


def weights_of(objective: Any) -> dict[str, float]:
    """The weights above 0 of an objective: a name, or weights by name."""
    if isinstance(objective, str):
        return {choice("objective", objective, OBJECTIVES): 1.0}
    if not isinstance(objective, Mapping):
        expected = f"expected one of {', '.join(OBJECTIVES)}, or weights by these names"
        raise PlannerError(f"objective is {short_repr(objective)}, {expected}.")
    given = {choice("objective", name, OBJECTIVES): weight for name, weight in objective.items()}
    weights = {name: number(f"the weight of {name}", weight, minimum=0.0) for name, weight in given.items()}
    weights = {name: weights[name] for name in OBJECTIVES if weights.get(name)}
    if not weights:
        raise PlannerError(f"no weight of the objective is above 0, expected some of {', '.join(OBJECTIVES)}.")
    return weights


def durations_or_default(durations: Any, weights: Mapping[str, float], duration: float) -> Any:
    """Durations as given; a fifth and twice the problem's own duration, s, where time is weighed and none are given."""
    return (duration / 5.0, 2.0 * duration) if durations is None and "time" in weights else durations


def checked_durations(durations: Any, weights: Mapping[str, float]) -> tuple[float, float] | None:
    """Checked min and max duration, s: required by an objective with time, None and refused for any other."""
    if "time" not in weights:
        if durations is not None:
            raise PlannerError(f"durations are {short_repr(durations)}, expected none without time in the objective.")
        return None
    pair = isinstance(durations, (Sequence, np.ndarray)) and not isinstance(durations, str) and len(durations) == 2
    if not pair:
        raise PlannerError(
            f"durations is {short_repr(durations)}, expected (shortest, longest) in s, which time needs."
        )
    shortest, longest = (number("a duration", value, greater_than=0.0) for value in durations)
    if not shortest < longest:
        raise PlannerError(f"durations are {shortest:g} and {longest:g} s, expected the shortest before the longest.")
    return shortest, longest
