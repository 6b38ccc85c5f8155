"""Phases: which feet stand until when, as tables of a problem file say it, and times that these leave free."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from planner.base.arguments import array, choice, number, short_repr
from planner.base.errors import PlannerError


class Phase(NamedTuple):
    """A part of a motion, and who stands in it."""

    until: float  # s
    stand: tuple[str, ...]  # names of bodies or geoms; the other feet swing


def phase_of(table: Any, k: int, of: int) -> Phase:
    """Phase k of a list, from its table."""
    where = f"[[phase]] {k}"
    if not isinstance(table, Mapping):
        raise PlannerError(f"{where} is {short_repr(table)}, expected a table of until and stand.")
    for key in table:
        choice(f"a key of {where}", key, ("until", "stand"))
    stand = table.get("stand")
    if not isinstance(stand, (list, tuple)) or not all(isinstance(name, str) for name in stand):
        raise PlannerError(f"stand of {where} is {short_repr(stand)}, expected names of bodies or geoms, [] for none.")
    if "until" not in table and k < of:
        raise PlannerError(f"{where} has no `until`, expected the time of its end, s; only the last needs none.")
    until = number(f"until of {where}", table["until"], greater_than=0.0) if "until" in table else math.inf
    return Phase(until, tuple(stand))


def free_times(phases: Any, duration: float) -> tuple[Any, dict[int, tuple[float, float]]]:
    """Tables of phases with the middle of each range of times, and the ranges, s, by the numbers of phases, from 0.

    Raises:
        PlannerError: A range that is none, or that reaches the time of another one or the duration, s.
    """
    if not isinstance(phases, list) or not all(isinstance(table, Mapping) for table in phases):
        return phases, {}  # gait_of says what is expected
    found, fixed, before = {}, [], 0.0
    for k, table in enumerate(phases):
        until = table.get("until")
        ends = [until, until]
        if isinstance(until, (list, tuple)):
            said = f"until of [[phase]] {k + 1}, the earliest and the latest time, s"
            ends = array(said, until, (2,)).tolist()
            table, found[k] = {**table, "until": 0.5 * (ends[0] + ends[1])}, (ends[0], ends[1])
        fixed.append(table)
        if not all(isinstance(end, (int, float)) for end in ends):
            continue  # gait_of says what is expected
        if k in found and not before < ends[0] < ends[1] < duration:
            raise PlannerError(
                f"until of [[phase]] {k + 1} is {short_repr(until)}, expected the earliest and the latest time of its "
                f"end, s, after the phase before and before the duration, {duration:g} s."
            )
        if found and k not in found and not ends[0] > before:
            raise PlannerError(
                f"until of [[phase]] {k + 1} is {short_repr(until)}, expected a time after {before:g} s, the latest "
                "end of the phase before."
            )
        before = ends[1]
    return fixed, found
