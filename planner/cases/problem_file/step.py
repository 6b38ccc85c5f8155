"""How a stage is integrated where a problem file leaves it to be chosen: dt, substeps and integrator = "auto"."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.base.errors import PlannerError
from planner.dynamics.rigid_body import MAX_SUBSTEPS
from planner.dynamics.step_stability import (
    IMPLICIT,
    MAX_RATE_STEP,
    FastestMode,
    fastest_mode,
    follows_all_but_damping,
    implicit_error,
    leaping,
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
FEW = 8  # substeps of RK4; a damping that asks for more is taken implicitly where that takes no more of them


def with_step(
    table: dict[str, Any], mechanism: Mechanism, prescribed: Collection[str], states: Sequence[np.ndarray],
    leaps: bool = False,
) -> tuple[dict[str, Any], int, dict[str, str]]:  # fmt: skip
    """The table with a number for dt and an integrator, the substeps, and the reasons of what was chosen.

    The table's own substeps stay "auto": a finer stage needs fewer.

    The states (nx,), with home where no ground is near, are where the machine's fastest motion is looked for. A stage
    is 0.01 s with RK4. Where 16 substeps cannot follow the machine's fastest motion, its damping is taken implicitly,
    at the stage or a half, a quarter or an eighth of it, by the Rosenbrock method; where that is too coarse, too, the
    stage is what RK4 can follow, but never below SHORTEST, where damping of single joints is taken implicitly. Where
    nothing touches and more than FEW substeps could follow it, the Rosenbrock method, whose substep takes half of the
    time, is preferred if it is exact with as many or fewer. An oscillation that lasts turns by at most SWING in a
    stage, unless that asks for less than SHORTEST. The stage is a little shorter than all this: a whole number of
    stages is the duration.

    Where contacts with a lead ask for the shortest steps and the machine `leaps`, since a foot stands at all times and
    none lands hard, the leapfrog method takes the place of RK4: a quarter of the evaluations, and the same plan to 1 %.
    It takes any damping of single joints, so that what is left of the machine's rates in a stage decides.

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
    stage = USUAL if table["dt"] == AUTO else number("dt", table["dt"], greater_than=0.0)
    machine = leaping(mechanism, stage) if table["integrator"] == LEAPFROG else mechanism
    found = FastestMode(0.0, "", 0.0) if known else fastest_mode(machine, states, prescribed)
    usual = USUAL if found.swing * USUAL <= SWING else max(SWING / found.swing, SHORTEST)
    reasons, dt, substeps, integrator = {}, table["dt"], table["substeps"], table["integrator"]
    most = substeps if isinstance(substeps, int) else MAX_SUBSTEPS
    closed = mechanism.has_closed_chains  # which the Rosenbrock method does not keep
    exact, counts = MAX_SUBSTEPS, (MAX_SUBSTEPS,)  # substeps of the Rosenbrock method, and which are tried
    if closed or substeps not in (AUTO, MAX_SUBSTEPS):
        counts = ()
    elif substeps == AUTO and not (mechanism.contacts or mechanism.body_contacts):  # which substeps have to follow
        counts = (MAX_SUBSTEPS // 4, MAX_SUBSTEPS // 2, MAX_SUBSTEPS)
    if integrator == AUTO:
        integrator, implicit = "rk4", ""
        lengths = [usual * 0.5**k for k in range(HALVINGS + 1)] if dt == AUTO else [number("dt", dt, greater_than=0.0)]
        for longest in lengths:
            fits = found.rate * longest <= most * MAX_RATE_STEP
            needed = substeps_of(found, longest) if fits else MAX_SUBSTEPS  # of RK4
            if fits and (needed <= FEW or len(counts) <= 1):
                break
            fewest = _fewest_exact(counts, mechanism, longest, states, prescribed)
            if fewest <= needed:
                implicit, exact = "rosenbrock", fewest
                break
            if fits:
                break
        else:
            longest, shortest = lengths[0], SHORTEST if dt == AUTO else lengths[0]
            if substeps in (AUTO, 1) and found.rate * shortest > most * MAX_RATE_STEP:
                follows = follows_all_but_damping(mechanism, longest, states, prescribed)
                implicit = "implicitfast" if follows else ""
        if implicit:
            integrator, dt = implicit, _whole(table["duration"], longest) if dt == AUTO else dt
            parts = f"{exact} substeps" if integrator in able else "1 step"
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
        if leaps and found.lead and table["integrator"] == AUTO and integrator == "rk4" and not closed:
            with suppress(PlannerError):  # of damping that the leapfrog method does not take
                found = fastest_mode(leaping(mechanism, stage), states, prescribed)
                integrator = LEAPFROG
        substeps = exact if integrator in able else 1
        if integrator in divided:
            substeps = (leaps_of if integrator == LEAPFROG else substeps_of)(found, number("dt", dt, greater_than=0.0))
        if integrator == LEAPFROG and found.lead:
            reasons["substeps"] = (
                f"{substeps} leapfrog steps a stage, because the damping of {found.joint} feels the velocity that it "
                f"has {1e3 * found.lead:.3g} ms later."
            )
        elif integrator in divided and substeps > 1:
            reasons["substeps"] = reason(found, substeps)
    return table | {"dt": dt, "integrator": integrator}, substeps, reasons


def _fewest_exact(
    counts: Sequence[int], mechanism: Mechanism, dt: float, states: Sequence[np.ndarray], prescribed: Collection[str]
) -> int:  # fmt: skip
    """The first of these counts of substeps with which the Rosenbrock method is exact in a stage of dt s.

    One more than the most for none.
    """
    errors = ((count, implicit_error(mechanism, dt, states, prescribed, count)) for count in counts)
    return next((count for count, error in errors if error <= IMPLICIT), MAX_SUBSTEPS + 1)


def _whole(duration: Any, longest: float) -> float:
    """The longest stage, s, no longer than this of which the duration is a whole number."""
    duration = number("duration", duration, greater_than=0.0)
    return duration / max(math.ceil(duration / longest * (1.0 - 1e-9)), 1)
