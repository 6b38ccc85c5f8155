"""How a stage is integrated where a problem file leaves it to be chosen: dt, substeps and integrator = "auto"."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.dynamics.rigid_body import MAX_SUBSTEPS
from planner.dynamics.step_stability import (
    IMPLICIT,
    MAX_RATE_STEP,
    FastestMode,
    fastest_mode,
    follows_all_but_damping,
    implicit_error,
    leaps_of,
    reason,
    substeps_of,
)
from planner.kernels.integrators import KNOWN_INTEGRATORS
from planner.model.mechanism import Mechanism

LEAPFROG = "leapfrog"
USUAL, SHORTEST = 0.01, 5e-4  # s: shorter ones are asked for, because a plan of them takes long
AUTO = "auto"
SWING = (
    1.0  # rad in a stage: gains for controls that are constant over a longer part of a swing excite it between knots
)
HALVINGS = 3  # of the stage, where damping is taken implicitly


def with_step(
    table: dict[str, Any], mechanism: Mechanism, prescribed: Collection[str], states: Sequence[np.ndarray],
    leaps: bool = False,
) -> tuple[dict[str, Any], int, dict[str, str]]:  # fmt: skip
    """The table with a number for dt and an integrator, the substeps, and the reasons of what was chosen.

    The table's own substeps stay "auto": a finer stage needs fewer.

    The states (nx,), with home where no ground is near, are where the machine's fastest motion is looked for. A stage
    is 0.01 s with RK4. Where 16 substeps cannot follow the machine's fastest motion, its damping is taken implicitly,
    at the stage or a half, a quarter or an eighth of it, by the Rosenbrock method; where that is too coarse, too, the
    stage is what RK4 can follow, but never below SHORTEST, where damping of single joints is taken implicitly. An
    oscillation that lasts turns by at most SWING in a stage, unless that asks for less than SHORTEST. The stage is a
    little shorter than all this: a whole number of stages is the duration.

    Where contacts with a lead ask for the shortest steps and the machine `leaps`, since a foot stands at all times and
    none lands hard, the leapfrog method takes the place of RK4: an eighth of the evaluations, and the same plan to 1 %.

    Raises:
        PlannerError: The duration is no number, or the dt that is asked for takes more than 16 substeps.
    """
    able = [name for name, one in KNOWN_INTEGRATORS.items() if one.has_substeps]
    divided = [name for name in able if not KNOWN_INTEGRATORS[name].implicit]  # until they are stable
    known = table["integrator"] not in (AUTO, *divided)
    if AUTO not in (table["dt"], table["substeps"], table["integrator"]):
        return table, table["substeps"], {}
    if not mechanism.contacts:  # which may have home deep in the ground
        states = (*states, mechanism.home)
    found = FastestMode(0.0, "", 0.0) if known else fastest_mode(mechanism, states, prescribed)
    usual = USUAL if found.swing * USUAL <= SWING else max(SWING / found.swing, SHORTEST)
    reasons, dt, substeps, integrator = {}, table["dt"], table["substeps"], table["integrator"]
    most = substeps if isinstance(substeps, int) else MAX_SUBSTEPS
    closed = mechanism.has_closed_chains  # which the Rosenbrock method does not keep
    if integrator == AUTO:
        integrator, implicit = "rk4", ""
        lengths = [usual * 0.5**k for k in range(HALVINGS + 1)] if dt == AUTO else [number("dt", dt, greater_than=0.0)]
        for longest in lengths:
            if found.rate * longest <= most * MAX_RATE_STEP:
                break
            if closed or substeps not in (AUTO, MAX_SUBSTEPS):
                continue
            if implicit_error(mechanism, longest, states, prescribed) <= IMPLICIT:
                implicit = "rosenbrock"
                break
        else:
            longest, shortest = lengths[0], SHORTEST if dt == AUTO else lengths[0]
            if substeps in (AUTO, 1) and found.rate * shortest > most * MAX_RATE_STEP:
                follows = follows_all_but_damping(mechanism, longest, states, prescribed)
                implicit = "implicitfast" if follows else ""
        if implicit:
            integrator, dt = implicit, _whole(table["duration"], longest) if dt == AUTO else dt
            parts = f"{MAX_SUBSTEPS} substeps" if integrator in able else "1 step"
            reasons["substeps"] = (
                f"damping is taken implicitly in {parts} a stage of {dt:.4g} s, because {found.joint} has a rate of "
                f"{found.rate:.4g} per s."
            )
    if dt == AUTO:
        longest = min(usual, max(most * MAX_RATE_STEP / found.rate, SHORTEST)) if found.rate > 0.0 else usual
        dt = _whole(table["duration"], longest)
        if longest < usual:
            reasons["dt"] = f"{dt:.4g} s: {found.joint} has a rate of {found.rate:.4g} per s"
        elif longest < USUAL:
            reasons["dt"] = f"{dt:.4g} s: the machine swings at {found.swing:.4g} rad/s, almost without damping"
    if substeps == AUTO:
        count = leaps_of(mechanism, found, number("dt", dt, greater_than=0.0))
        if leaps and count and table["integrator"] == AUTO and integrator == "rk4":
            integrator = LEAPFROG
        substeps = MAX_SUBSTEPS if integrator in able else 1
        if integrator == LEAPFROG and count:
            substeps = count
            reasons["substeps"] = (
                f"{count} leapfrog steps a stage, because the damping of {found.joint} feels the velocity that it has "
                f"{1e3 * found.lead:.3g} ms later."
            )
        elif integrator in divided:
            substeps = substeps_of(found, number("dt", dt, greater_than=0.0))
            if substeps > 1:
                reasons["substeps"] = reason(found, substeps)
    return table | {"dt": dt, "integrator": integrator}, substeps, reasons


def _whole(duration: Any, longest: float) -> float:
    """The longest stage, s, no longer than this of which the duration is a whole number."""
    duration = number("duration", duration, greater_than=0.0)
    return duration / max(math.ceil(duration / longest * (1.0 - 1e-9)), 1)
