"""The table of a problem.toml with its values checked and its defaults filled in."""

from __future__ import annotations

from typing import Any

from planner.base.arguments import number, numbers, short_repr
from planner.base.data_files import check_keys, check_values
from planner.base.errors import PlannerError
from planner.cases.problem_file.keys import (
    AVOID,
    DEFAULTS,
    KEYS,
    LIMITS,
    MODEL_LIMITS,
    RAMP,
    RESOLVED,
    VALUES,
    WEIGHTS,
)
from planner.problem.costs.terms import checked_tolerance, stored_tolerance
from planner.problem.joint_limits import OFF
from planner.problem.limits import Limits
from planner.problem.problem_parts import checked_durations, stages_of, weights_of
from planner.solvers.periodic_boundary import PARAMETER
from planner.solvers.waypoints import WAYPOINTS


def with_defaults(table: dict[str, Any], where: str, stored: bool = False) -> dict[str, Any]:
    """The table with its defaults; PlannerError where it has an unknown key or no model.

    A plan's own table, `stored`, holds beside the keys of a file what was chosen by itself.
    """
    check_keys(table, (*KEYS, RESOLVED, PARAMETER) if stored else KEYS, where)
    resolved = ("weights", "reasons", WAYPOINTS, RAMP)
    for name, keys in (("weights", WEIGHTS), ("limits", LIMITS), ("avoid", AVOID), (RESOLVED, resolved)):
        part = table.get(name, {})
        if not isinstance(part, dict):
            raise PlannerError(
                f"{name} is {short_repr(part)}, expected a table [{name}] with some of: {', '.join(keys)}."
            )
        check_keys(part, keys, f"[{name}] of {where}")
    if RESOLVED in table:
        _check_resolved(table[RESOLVED], where)
    if "model" not in table:
        raise PlannerError(f"{where} has no key 'model', expected the name of an MJCF or URDF file.")
    if "duration" not in table and isinstance(table.get("durations"), (list, tuple)) and table["durations"]:
        table = table | {"duration": table["durations"][-1]}  # a search begins where there is time enough
    if "duration" not in table:
        raise PlannerError(f"{where} has no key 'duration', expected a number of seconds, e.g. duration = 2.0.")
    return {**DEFAULTS, **table, "weights": dict(table.get("weights", {}))}


def _check_resolved(resolved: dict[str, Any], where: str) -> None:
    """Refuse what was chosen by itself unless it has tables of weights and of sentences."""
    for name in ("weights", "reasons"):
        part = resolved.get(name)
        if not isinstance(part, dict):
            raise PlannerError(f"{name} of [{RESOLVED}] is {short_repr(part)}, expected a table.")
    check_keys(resolved["weights"], (*WEIGHTS, "control"), f"[{RESOLVED}.weights] of {where}")
    if "effort" not in resolved["weights"]:
        raise PlannerError(f"[{RESOLVED}.weights] of {where} has no key 'effort', expected a weight of the controls.")
    numbers("a waypoint of the plan", resolved.get(WAYPOINTS, []))
    if RAMP in resolved:
        number("the ramp of the plan", resolved[RAMP], greater_than=0.0)
    for name, reason in resolved["reasons"].items():
        if not isinstance(reason, str):
            raise PlannerError(f"the reason for {short_repr(name)} is {short_repr(reason)}, expected a sentence.")


def with_model_limits(table: dict[str, Any]) -> dict[str, Any]:
    """The table of a file with the limits of its model, as far as it does not say otherwise."""
    limits = table.get("limits", {})
    if limits == OFF:
        limits = dict.fromkeys(MODEL_LIMITS, OFF)
    if not isinstance(limits, dict):
        raise PlannerError(f"limits is {short_repr(limits)}, expected {OFF!r} or a table [limits].")
    return table | {"limits": MODEL_LIMITS | limits}


def checked_values(table: dict[str, Any]) -> tuple[dict[str, Any], int]:
    """The table with its numbers, names, limits and objective checked, and the number of stages."""
    dt, N = stages_of(table["duration"], table["dt"])
    table = table | check_values(table, VALUES)
    table |= {"duration": float(table["duration"]), "dt": dt}
    table["tolerance"] = stored_tolerance(checked_tolerance(table.get("tolerance")))
    if table.get("limits"):
        table["limits"] = Limits.from_dict(table["limits"]).to_dict()
    if "objective" in table:
        table["objective"] = weights_of(table["objective"])
    if "durations" in table:
        table["durations"] = list(checked_durations(table["durations"], table.get("objective", {})) or ())
    return table, N


def tables_of_joints(table: dict[str, Any]) -> list[tuple[str, Any]]:
    """Where a table has positions of joints by name: what it is called there, and what is given."""
    goals = table.get("goal")
    if not isinstance(goals, list):
        return [("start", table["start"]), ("goal", goals)]
    several = [one for one in goals if isinstance(one, dict)]
    return [("start", table["start"]), *((f"goal {k + 1}", one.get("joints")) for k, one in enumerate(several))]
