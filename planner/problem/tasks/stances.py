"""Stances: whether the feet of a motion stand and swing as the phases of its problem ask.

A phase says nothing to the solver but where the reference goes: a motion that ignores it may cost less.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.model.capabilities import capabilities_of
from planner.problem.problem import Problem
from planner.problem.tasks.foot_names import with_feet_of
from planner.problem.tasks.gait import gait_of, stands_at
from planner.problem.tasks.legs import standing_feet
from planner.problem.touch_downs import standing

LARGEST_SHARE = 0.5  # of a stance or swing: a foot that does something else for longer does not keep it


class StanceMiss(NamedTuple):
    """The stance or swing of a foot that a motion keeps least."""

    foot: str
    swings: bool  # whether it was to swing
    begin: float  # s
    end: float  # s
    share: float  # of the knots between, in which it does something else

    @property
    def asked(self) -> str:
        """What the foot was to do: a verb."""
        return "swing" if self.swings else "stand"


def worst_stance(problem: Problem, t: np.ndarray, xs: np.ndarray) -> StanceMiss | None:
    """Of a motion xs (M, nx) at times t (M,), s; None without phases, or where they are of a cycle.

    The knots at both ends of a stance or swing are not counted: there it changes.
    """
    tables, mechanism = problem.parameters.get("phase"), capabilities_of(problem.dynamics).mechanism
    if not tables or mechanism is None or problem.periodic is not None or not np.isfinite(xs).all():
        return None
    feet = standing_feet(mechanism, problem.x0)
    try:
        swings, _ = with_feet_of(gait_of(tables), mechanism).swings_of_phases(feet, problem.duration)
    except PlannerError:
        return None  # free times; or a cycle that is repeated, whose phases end before the motion
    bears, found = standing(mechanism, xs), list[StanceMiss]()
    for foot, asked in zip(feet, stands_at(t, swings).T, strict=True):
        edges = [0, *(np.flatnonzero(np.diff(asked)) + 1).tolist(), len(t)]
        for a, b in pairwise(edges):
            inside = slice(a + (a > 0), b - (b < len(t)))
            if foot.name in bears and inside.stop > inside.start:
                share = float(np.mean(bears[foot.name][inside] != asked[a]))
                found.append(StanceMiss(foot.name, not asked[a], float(t[a]), float(t[b - 1]), share))
    return max(found, key=lambda one: one.share, default=None)
