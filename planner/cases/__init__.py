"""Machines of the paper and of its references; a case is a function of plain numbers that returns a Problem."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from planner.base.arguments import choice
from planner.base.data_files import problem_files
from planner.base.errors import PlannerError
from planner.cases.acrobot import acrobot
from planner.cases.high_dive.case import high_dive
from planner.cases.hopper import hopper
from planner.cases.human_step.case import human_step
from planner.cases.puma import puma
from planner.cases.two_link import two_link
from planner.problem.problem import Problem

# The folders high_dive and human_step share their names with the functions that their case.py defines. The imports
# above run before any other part of those folders is reached, and bind the names to the functions; Python binds a
# submodule to its parent's name only once, so `planner.cases.human_step` is always the function. Import parts of a
# folder with `from planner.cases.human_step.gait import Gait`.

CASES: dict[str, Callable[..., Problem]] = {
    "two-link": two_link, "acrobot": acrobot, "hopper": hopper, "puma": puma, "high-dive": high_dive,
    "human-step": human_step,
}  # fmt: skip

__all__ = ["CASES", "acrobot", "build", "high_dive", "hopper", "human_step", "puma", "two_link"]


def build(name: str, /, **parameters: Any) -> Problem:
    """Build the Problem of a case by its name.

    Raises:
        PlannerError: No such case, no such parameter, or a value that is out of range.
    """
    if name in problem_files():
        raise PlannerError(f"{name} is a problem file of the package, expected planner.load_problem({name!r}).")
    case = CASES[choice("case", name, CASES)]
    known = inspect.signature(case).parameters
    for parameter in parameters:
        if parameter not in known:
            raise PlannerError(f"{name} has no parameter {parameter!r}, expected some of: {', '.join(known)}.")
    return case(**parameters)
