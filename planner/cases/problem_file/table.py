"""The table of a problem.toml: read, with its keys checked and its defaults filled in."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection
from pathlib import Path
from typing import Any

from planner.base.arguments import choice, count, did_you_mean, number, numbers, short_repr
from planner.base.errors import FileError, PlannerError
from planner.base.files import printable, read_text
from planner.cases.problem_file.keys import AVOID, DEFAULTS, KEYS, LIMITS, MODEL_LIMITS, RAMP, RESOLVED, WEIGHTS
from planner.cases.problem_file.reference_guess import GUESSES
from planner.dynamics.rigid_body import MAX_SUBSTEPS
from planner.problem.costs.goal_spec import checked_tolerance, stored_tolerance
from planner.problem.limit_values import OFF
from planner.problem.limits import Limits
from planner.problem.objective import checked_durations, weights_of
from planner.problem.rediscretize import MAX_STAGES
from planner.problem.tasks.waypoints import WAYPOINTS
from planner.solvers.options import MAX_STARTS

_FEW = 8  # keys that are listed before the nearest one is suggested
LONGEST = 2**20  # characters; guesses and weights are short, models are files of their own
MAX_DOTS = 20
_PART = r"""(?:"[^"\n]*"|'[^'\n]*'|[\w-]+)"""
_DEEP = re.compile(rf"(?:^|[\[{{,])[ \t]*(?:{_PART}[ \t]*\.[ \t]*){{{MAX_DOTS}}}", re.M)
"""A dotted key of many parts, which takes tomllib the square of their number."""

_VALUE = re.compile(r"""\s*(?P<key>[\w-]+)\s*=\s*(?:(?P<bare>[A-Za-z_][\w./-]*)\s*(?:\#.*)?$|.)""")


def read_table(path: Path) -> dict[str, Any]:
    """The file's table; FileError where it cannot be read."""
    text = read_text(path, "the problem file")
    if len(text) > LONGEST:
        raise FileError(f"{printable(path)} has {len(text)} characters, expected a table of at most {LONGEST}.")
    if _DEEP.search(text):
        raise FileError(
            f"{printable(path)} has a key of more than {MAX_DOTS} parts, expected some of KEY or TABLE.KEY."
        )
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{path} is not TOML: {_likely_cause(text) or str(error).removesuffix('.')}.") from None
    except ValueError:  # Python reads no integers of more than 4300 digits
        raise FileError(f"{path} has a number of thousands of digits, expected numbers that fit 64 bits.") from None
    except RecursionError:
        raise FileError(f"{path} is nested too deeply, expected a table of numbers and names.") from None


def _likely_cause(text: str) -> str:
    """What most often is wrong in a text that is not TOML; "" for something else."""
    values: dict[str, int] = {}
    for n, line in enumerate(text.splitlines(), 1):
        found = _VALUE.match(line)
        if found and found["bare"] and found["bare"] not in ("true", "false", "inf", "nan"):
            return f'line {n} has a text without quotes, expected {found["key"]} = "{found["bare"]}"'
        if line.lstrip().startswith("["):
            name = line.strip().strip("[]").strip()
            if name in values and line.lstrip().startswith("[["):
                return (
                    f"{name} is a value in line {values[name]} and a table [[{name}]] in line {n}, expected one of them"
                )
        elif found:
            values.setdefault(found["key"], n)
    return ""


def with_defaults(table: dict[str, Any], where: str, stored: bool = False) -> dict[str, Any]:
    """The table with its defaults; PlannerError where it has an unknown key or no model.

    A plan's own table, `stored`, holds beside the keys of a file what was chosen by itself.
    """
    check_keys(table, (*KEYS, RESOLVED) if stored else KEYS, where)
    for name, keys in (
        ("weights", WEIGHTS), ("limits", LIMITS), ("avoid", AVOID), (RESOLVED, ("weights", "reasons", WAYPOINTS, RAMP)),
    ):  # fmt: skip
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


def check_keys(table: dict[str, Any], keys: Collection[str], where: str) -> None:
    """Refuse a key that is unknown, and suggest the nearest known one."""
    for key in table:
        if key not in keys:
            hint, known = did_you_mean(key, keys), ", ".join(keys)
            if hint and len(keys) > _FEW:  # the cure first: nobody reads on after thirty names
                raise PlannerError(f"{where} has no key {short_repr(key)}.{hint} Its keys are: {known}.")
            raise PlannerError(f"{where} has the key {short_repr(key)}, expected some of: {known}.{hint}")


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
