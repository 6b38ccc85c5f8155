"""The stage and its substeps, where a problem file leaves them to be chosen: dt = "auto", substeps = "auto"."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.dynamics.rigid_body import MOST_SUBSTEPS
from planner.dynamics.stiffness import REACH, Fastest, fastest, reason, substeps_of
from planner.model.mechanism import Mechanism

USUAL, SHORTEST = 0.01, 5e-4  # s: shorter ones are asked for, because a plan of them takes long
AUTO = "auto"


def with_step(
    table: dict[str, Any], mechanism: Mechanism, prescribed: Collection[str], states: Sequence[np.ndarray]
) -> tuple[dict[str, Any], int, dict[str, str]]:
    """The table with a number for dt, the substeps, and the reasons of what was chosen.

    The table's own substeps stay "auto": a finer stage needs fewer.

    The states (nx,), with home where no ground is near, are where the machine's fastest motion is looked for. A stage
    is 0.01 s, or what 16 substeps can follow, or a little less: a whole number of stages is the duration. It is never
    below SHORTEST.

    Raises:
        PlannerError: The duration is no number, or the dt that is asked for takes more than 16 substeps.
    """
    rk4 = table["integrator"] == "rk4"
    if AUTO not in (table["dt"], table["substeps"]):
        return table, table["substeps"], {}
    if not mechanism.contacts:  # which may have home deep in the ground
        states = (*states, mechanism.home)
    found = Fastest(0.0, "") if not rk4 else fastest(mechanism, states, prescribed)
    reasons, dt, substeps = {}, table["dt"], table["substeps"]
    if dt == AUTO:
        duration = number("duration", table["duration"], above=0.0)
        most = substeps if isinstance(substeps, int) else MOST_SUBSTEPS
        longest = min(USUAL, max(most * REACH / found.rate, SHORTEST)) if found.rate > 0.0 else USUAL
        dt = duration / max(math.ceil(duration / longest * (1.0 - 1e-9)), 1)
        if longest < USUAL:
            reasons["dt"] = f"{dt:.4g} s: {found.joint} has a rate of {found.rate:.4g} per s"
    if substeps == AUTO:
        substeps = substeps_of(found, number("dt", dt, above=0.0)) if rk4 else 1
        if substeps > 1:
            reasons["substeps"] = reason(found, substeps)
    return table | {"dt": dt}, substeps, reasons
