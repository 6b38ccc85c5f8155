"""task(): a problem of goals and paths in Python, by the keys of a problem.toml."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.cases.problem_file.build import again
from planner.cases.problem_file.keys import with_model_limits
from planner.model.mechanism import Mechanism
from planner.problem.constraints.clearance import Avoid
from planner.problem.constraints.constraint import Constraint
from planner.problem.limits import Limits
from planner.problem.problem import Problem
from planner.problem.tasks.goal import Follow, Goal, follow_of, goal_of

_EXAMPLES = {
    Goal: 'a Goal, such as Goal(joints={"elbow": 1.0}) or Goal(joints="home")',
    Follow: 'a Follow, such as Follow(frame="hand", points=[[0, 0.4, 0, 0.3], [1, 0.4, 0.1, 0.3]])',
}
OWN = ("model", "goal", "follow", "attach", "obstacle", "exclude")


def task(
    mechanism: Mechanism, start: Any, goals: Goal | Sequence[Goal] = (), *, duration: float,
    follow: Follow | Sequence[Follow] = (), **keys: Any,
) -> Problem:  # fmt: skip
    """The problem of bringing frames and joints of a machine to goals, and along paths.

    Weights, the stage and the first guess are chosen, and the limits of the model hold, as of a problem.toml.

    Args:
        mechanism: The machine; payloads and obstacles are added when it is read.
        start: A keyframe, positions (nq,), a state (nx,), or a table of joints.
        goals: In the order of their times; one without a time is at the end.
        duration: s.
        follow: Paths to keep to.
        keys: Others of a problem.toml: dt, limits, weights, tolerance, objective, guess, ... Limits may be a Limits,
            avoid an Avoid, and constraint a Constraint or a list of some, in place of tables.

    Raises:
        PlannerError: A goal out of reach (how far, and the nearest point), an unknown frame, times out of order, goals
            that contradict each other, or a key that there is not.
    """
    if not isinstance(mechanism, Mechanism):
        raise PlannerError(f"mechanism is {short_repr(mechanism)}, expected a Mechanism.")
    for key in OWN:
        if key in keys:
            raise PlannerError(
                f"{key} is a key of a file, expected goals= and follow= beside the mechanism, and attach=, obstacles= "
                "and exclude= where it is read."
            )
    asked = [goal_of(one, f"goal {k}") for k, one in enumerate(_several("goals", goals, Goal), 1)]
    paths = [follow_of(one, "follow") for one in _several("follow", follow, Follow)]
    if not (asked or paths or "periodic" in keys or "gait" in keys):
        raise PlannerError(f"goals is empty, expected {_EXAMPLES[Goal]}, or a list of them, or follow=.")
    table = {"model": "the mechanism", "start": _plain(start), "duration": duration, "title": "", **keys}
    table |= {"goal": [one.to_dict() for one in asked]} if asked else {}
    table |= {"follow": [one.to_dict() for one in paths]} if paths else {}
    table.setdefault("contacts", mechanism.contacts_mode or "off")
    if isinstance(table.get("limits"), Limits):
        table["limits"] = table["limits"].to_dict()
    if isinstance(table.get("avoid"), Avoid):
        table["avoid"] = table["avoid"].to_dict()
    kept = table.get("constraint", [])
    kept = [kept] if isinstance(kept, (Constraint, dict)) else kept
    given = [one for one in kept if isinstance(one, Constraint)]
    if "constraint" in table:
        table["constraint"] = [one for one in kept if not isinstance(one, Constraint)] if given else kept
    return again(mechanism, *given, **with_model_limits(table))


def _several(name: str, value: Any, kind: type) -> list[Any]:
    value = [value] if isinstance(value, (kind, dict)) else value
    if not isinstance(value, (list, tuple)):
        raise PlannerError(f"{name} is {short_repr(value)}, expected {_EXAMPLES[kind]}, or a list of them.")
    return list(value)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else list(value) if isinstance(value, tuple) else value
