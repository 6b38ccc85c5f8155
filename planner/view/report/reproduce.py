"""The command that makes a plan again, and its problem file if it had one."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from planner import cases
from planner.base.errors import PlannerError
from planner.cases import problem_file
from planner.cases.problem_file.keys import RESOLVED
from planner.problem.plan import Plan

if TYPE_CHECKING:
    from planner.proof.repair.refinement import Refinement

PROBLEM = "problem.toml"


def command(plan: Plan, path: Sequence[Refinement] = (), options: Mapping[str, Any] | None = None) -> str:
    """The command line that makes a plan; "" for a problem that is no case and no file.

    With a `path` of refinements, it makes the first plan of them. `options` are flags by name: {"no_refine": True}.
    """
    parameters = _at_first(plan, path)
    words = ["planner", "run"]
    if plan.case == problem_file.NAME:
        words.append(PROBLEM)
    elif plan.case in cases.CASES:
        words += [plan.case, *_flags(_needed(plan.case, parameters))]
    else:
        return ""
    given = dict(options or {})
    if len(plan.starts) > 1 and plan.case in cases.CASES:
        given.setdefault("starts", len(plan.starts))
    return shlex.join([*words, *_flags(given)])


def problem_text(plan: Plan, path: Sequence[Refinement] = ()) -> str:
    """The problem file of a plan as TOML; "" for a plan that was made from none."""
    if plan.case != problem_file.NAME:
        return ""
    table = {name: value for name, value in _at_first(plan, path).items() if value is not None}  # TOML has no null
    lines = [f"{name} = {_toml(value)}" for name, value in table.items() if name not in ("weights", "limits", RESOLVED)]
    for name in ("weights", "limits"):
        if table.get(name):
            lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in table[name].items())]
    return "\n".join(lines)


def _at_first(plan: Plan, path: Sequence[Refinement]) -> dict[str, Any]:
    """The parameters of a plan, before it was refined."""
    found = typed(plan.parameters) if plan.case in cases.CASES else dict(plan.parameters)
    if len(path) < 2:
        return found
    first = {"integrator": path[0].integrator, "horizon": path[0].horizon, "dt": path[0].dt}
    return found | {name: value for name, value in first.items() if name in found}


def typed(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that a flag can hold; the case finds arrays and tables again from the others."""
    return {name: value for name, value in parameters.items() if not isinstance(value, (dict, list, tuple))}


def _needed(case: str, parameters: dict[str, Any]) -> dict[str, Any]:
    """The parameters that the case does not find from the others."""
    try:
        usual = cases.build(case).parameters
        needed = {name: value for name, value in parameters.items() if usual.get(name) != value}
        for name in list(needed):
            others = {other: value for other, value in needed.items() if other != name}
            made = cases.build(case, **others).parameters
            if typed(made) == parameters:
                needed = others
    except PlannerError:  # another version made the plan
        return parameters
    return needed


def _flags(values: Mapping[str, Any]) -> list[str]:
    """Flags of the command line; those of None and False are left out."""
    flags = []
    for name, value in values.items():
        flag = f"--{name.replace('_', '-')}"
        if value is True:
            flags.append(flag)
        elif value is not None and value is not False:
            flags += [flag, f"{value:.17g}" if isinstance(value, float) and f"{value:g}" != str(value) else str(value)]
    return flags


def _toml(value: Any) -> str:
    """A value of a problem file as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(name)} = {_toml(part)}" for name, part in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(part) for part in value) + "]"
    return json.dumps(value, default=str, ensure_ascii=False)  # strings, numbers and booleans are written alike


def _key(name: str) -> str:
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isascii() and bare.isalnum() else json.dumps(name, ensure_ascii=False)
