"""The table of a problem.toml with its values checked and its defaults filled in."""

from __future__ import annotations

from typing import Any

from planner.base.arguments import choice, count, number, numbers, short_repr
from planner.base.data_files import check_keys
from planner.base.errors import PlannerError
from planner.cases.problem_file.keys import AVOID, DEFAULTS, KEYS, LIMITS, MODEL_LIMITS, POSES, RAMP, RESOLVED, WEIGHTS
from planner.cases.problem_file.reference_guess import GUESSES
from planner.dynamics.rigid_body import MAX_SUBSTEPS
from planner.problem.costs.terms import checked_tolerance, stored_tolerance
from planner.problem.joint_limits import OFF
from planner.problem.limits import Limits
from planner.problem.objective import checked_durations, weights_of
from planner.problem.rediscretize import MAX_STAGES
from planner.solvers.options import MAX_STARTS
from planner.solvers.periodic_boundary import PARAMETER
from planner.solvers.waypoints import WAYPOINTS


def with_defaults(table: dict[str, Any], where: str, stored: bool = False) -> dict[str, Any]:
    """The table with its defaults; PlannerError where it has an unknown key or no model.

    A plan's own table, `stored`, holds beside the keys of a file what was chosen by itself.
    """
    check_keys(table, (*KEYS, RESOLVED, PARAMETER) if stored else KEYS, where)
    chosen = ("weights", "reasons", WAYPOINTS, RAMP, POSES)
    for name, keys in (("weights", WEIGHTS), ("limits", LIMITS), ("avoid", AVOID), (RESOLVED, chosen)):
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
    dt, N = _stages(table["duration"], table["dt"])
    table = table | {
        "duration": float(table["duration"]), "dt": dt, "starts": checked_starts(table["starts"]),
        "seed": count("seed", table["seed"], minimum=0),
        "tolerance": stored_tolerance(checked_tolerance(table.get("tolerance"))),
        "substeps": _substeps(table["substeps"]),
        "guess": choice("guess", table["guess"], GUESSES),
    }  # fmt: skip
    if "work" in table:
        table["work"] = number("work", table["work"], greater_than=0.0)
    if not isinstance(table["title"], str):
        raise PlannerError(f"title is {short_repr(table['title'])}, expected a text.")
    if table.get("limits"):
        table["limits"] = Limits.from_dict(table["limits"]).to_dict()
    if "objective" in table:
        table["objective"] = weights_of(table["objective"])
    if "durations" in table:
        table["durations"] = list(checked_durations(table["durations"], table.get("objective", {})) or ())
    return table, N


def _substeps(value: Any) -> int | str:
    return value if value == "auto" else count('substeps, unless "auto",', value, maximum=MAX_SUBSTEPS)


def checked_starts(starts: Any) -> int:
    """A number of first guesses."""
    return count("starts", starts, maximum=MAX_STARTS)


def _stages(duration: Any, dt: Any) -> tuple[float, int]:
    duration, dt = number("duration", duration, greater_than=0.0), number("dt", dt, greater_than=0.0)
    if not duration / dt < MAX_STAGES + 0.5:
        raise PlannerError(f"duration / dt is {duration / dt:.4g}, expected at most {MAX_STAGES} stages.")
    N = round(duration / dt)
    if N < 1 or abs(N * dt - duration) > 1e-9 * duration:
        near = max(N, 1) * dt
        raise PlannerError(f"duration is {duration:g} s, expected a whole number of stages of {dt:g} s, e.g. {near:g}.")
    return dt, N
