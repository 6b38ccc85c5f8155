"""What is wrong with the input of a command, as far as it can be said before slow imports and without a model.

Files that are not there, keys and values of a problem file, objective and durations. What needs the model's names
(joints, frames, limits by joint) and the parameters of a case are checked where the problem is built.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from planner.base.arguments import short_repr
from planner.base.data_files import check_file, read_table
from planner.base.errors import PlannerError
from planner.base.files import PLANS, check_confined, check_exists, read_input
from planner.cli.flags import value_of
from planner.model.robot_collections import PREFIX
from planner.problem.problem_parts import checked_durations, durations_or_default, stages_of, weights_of


def check_inputs(arguments: argparse.Namespace) -> None:
    """Raise PlannerError for an input that is not there, may not be read or has wrong keys or values."""
    objective, durations = (getattr(arguments, name, None) for name in ("objective", "durations"))
    objective, durations = objective_of(objective), durations_of(durations)
    for name, what in (("problem", "the problem file"), ("model", "the model")):
        path = getattr(arguments, name, None)
        if isinstance(path, str) and path:
            _check_path(path, what)
            if name == "problem" and arguments.command != "sweep":  # which may add keys
                _check_problem_file(path, {"objective": objective, "durations": durations})
    for path in getattr(arguments, "paths", ()):  # of check
        check_confined(path, "the plan")
        check_exists(path, PLANS)
    plan = getattr(arguments, "plan", None)
    if isinstance(plan, str) and not os.path.exists(plan):
        from planner.problem.archive import opened  # local: a third of a second

        opened(Path(plan)).close()  # it says so, too, but for a plan within an archive of many


def _check_path(path: str, what: str) -> None:
    """Refuse a file that is not there or may not be read."""
    if not path.startswith(PREFIX):
        check_confined(path, what)
        if not os.path.exists(path):
            read_input(path, what)  # which says why it is not there


def _check_problem_file(path: str, instead: dict[str, Any]) -> None:
    """Refuse a problem file of a machine of one's own by its keys and values alone."""
    table = read_table(Path(path))
    if "case" in table:
        return
    table |= {name: value for name, value in instead.items() if value is not None}
    keys, parts, rules = (value_of("planner.cases.problem_file.keys", name) for name in ("KEYS", "TABLES", "VALUES"))
    check_file(table, keys, parts, rules, path)
    if isinstance(table.get("model"), str) and table["model"]:
        model = table["model"]
        _check_path(model if model.startswith(PREFIX) else str(Path(path).parent / model), "the model")
    _check_parts(table)


def _check_parts(table: dict[str, Any]) -> None:
    """Refuse values of a file that lie in tables, or that have to fit each other."""
    from planner.model.mjcf.attached import attachments  # these are local, because most commands check no file
    from planner.model.mjcf.obstacles import obstacles_of
    from planner.problem.costs.terms import checked_tolerance
    from planner.problem.tasks.goal import goal_of

    checked_tolerance(table.get("tolerance"))
    objective = weights_of(table["objective"]) if "objective" in table else {}
    checked_durations(durations_or_default(table.get("durations"), objective, 1.0), objective)  # 1 s: of any duration
    if "duration" in table and isinstance(table.get("dt"), (int, float)):
        stages_of(table["duration"], table["dt"])
    goals = table.get("goal")
    for k, goal in enumerate(goals if isinstance(goals, list) else [], 1):
        if isinstance(goal, dict):
            goal_of(goal, f"goal {k}")
    attachments(table.get("attach"))
    obstacles_of(table.get("obstacle"))


def objective_of(text: str | None) -> dict[str, float] | None:
    """Weights of criteria from "time" or from "effort=1,time=2"; None stays None."""
    if text is None:
        return None
    if "=" not in text:
        return weights_of(text.strip())
    weights: dict[str, float] = {}
    for word in text.split(","):
        name, _, value = word.partition("=")
        try:
            weights[name.strip()] = float(value)
        except ValueError:
            raise PlannerError(
                f"--objective has {short_repr(word)}, expected NAME=WEIGHT, e.g. effort=1,time=2."
            ) from None
    return weights_of(weights)


def durations_of(text: str | None) -> list[float] | None:
    """The shortest and the longest duration, s, from "0.5,3"; None stays None."""
    if text is None:
        return None
    try:
        shortest, longest = map(float, text.split(","))
    except ValueError:
        raise PlannerError(f"--durations is {short_repr(text)}, expected SHORTEST,LONGEST in s, e.g. 0.5,3.") from None
    return [shortest, longest]
