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
    stand: tuple[str, ...]  # names of bodies; the other feet swing


def phase_of(table: Any, k: int, of: int) -> Phase:
    """Phase k of a list, from its table."""
    where = f"[[phase]] {k}"
    if not isinstance(table, Mapping):
        raise PlannerError(f"{where} is {short_repr(table)}, expected a table of until and stand.")
    for key in table:
        choice(f"a key of {where}", key, ("until", "stand"))
    stand = table.get("stand")
    if not isinstance(stand, (list, tuple)) or not all(isinstance(name, str) for name in stand):
        raise PlannerError(f"stand of {where} is {short_repr(stand)}, expected names of bodies, [] for none.")
    if "until" not in table and k < of:
        raise PlannerError(f"{where} has no `until`, expected the time of its end, s; only the last needs none.")
    until = number(f"until of {where}", table["until"], greater_than=0.0) if "until" in table else math.inf
    return Phase(until, tuple(stand))


def free_times(phases: Any) -> tuple[Any, dict[int, tuple[float, float]]]:
    """Tables of phases with the middle of each range of times, and the ranges, s, by the numbers of phases, from 0.

    Raises:
        PlannerError: A range that is none, of the last phase, or that reaches the time of another one.
    """
    if not isinstance(phases, list) or not all(isinstance(table, Mapping) for table in phases):
        return phases, {}  # gait_of says what is expected
    found, fixed = {}, []
    for k, table in enumerate(phases):
        until = table.get("until")
        if not isinstance(until, (list, tuple)):
            fixed.append(table)
            continue
        low, high = array(f"until of [[phase]] {k + 1}, the earliest and the latest time, s", until, (2,)).tolist()
        others = [one["until"] for j, one in enumerate(phases) if j != k and isinstance(one.get("until"), (int, float))]
        others += [time for pair in found.values() for time in pair]
        if not 0.0 < low < high or k == len(phases) - 1 or any(low <= time <= high for time in others):
            raise PlannerError(
                f"until of [[phase]] {k + 1} is {short_repr(until)}, expected the earliest and the latest time of its "
                "end, s, not of the last phase and between the times of its neighbours."
            )
        found[k] = (low, high)
        fixed.append({**table, "until": 0.5 * (low + high)})
    return fixed, found
