"""The machine of a problem.toml, read as the keys of its table ask for it, and how its stages are integrated.

The second is chosen where the file leaves it: dt, substeps and integrator = "auto".
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import choice, number, short_repr
from planner.base.data_files import check_keys
from planner.base.errors import ModelError, PlannerError
from planner.cases.problem_file.keys import GROUND, LAW, URDF
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
from planner.model.capabilities import capabilities_of, floating_dofs, thrusters
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contact_mode import MODES, stands_at
from planner.model.mjcf.ground_law import UNCERTAINTY
from planner.model.mjcf.unsupported import KINDS
from planner.model.urdf.read import read_model
from planner.problem.constraints.clearance import model_index_of
from planner.problem.costs.tracking import tracking_of
from planner.problem.goals import MIN_TOLERANCES
from planner.problem.problem import Problem

ADDED = {"attach": "attach", "obstacles": "obstacle", "exclude": "exclude"}
"""What a file may add to its model: the argument of read_model(), and its key."""
_LAW_ARGUMENTS = {"friction_smoothing": "bend", "penetration": "sink"}


def machine_of(model: str | Path, table: dict[str, Any], assets: dict[str, bytes] | None) -> Mechanism:
    """The machine of a model file, or of the model that a plan keeps with its `assets`.

    Raises:
        PlannerError: A key is wrong, or the model cannot be used.
    """
    ignore = table["ignore"]
    if not isinstance(ignore, list) or not all(isinstance(kind, str) for kind in ignore):
        raise PlannerError(f"ignore is {short_repr(ignore)}, expected a list of some of: {', '.join(KINDS)}.")
    of_urdf = {key: table[key] for key in URDF if key in table}
    added = {} if assets is not None else {key: table.get(name) for key, name in ADDED.items()}  # else stored
    opened = partial(read_model, model, ignore=tuple(ignore), assets=assets, **added, **of_urdf)
    contacts = table["contacts"]
    if not isinstance(contacts, dict):
        choice("contacts", "model" if contacts == "on" and assets is not None else contacts, MODES)
    if assets is not None and contacts not in ("avoid", "off"):  # a stored model has the law already
        contacts = "auto"
    elif isinstance(contacts, dict):
        contacts = _contact_law(contacts, opened(contacts="off"))
    mechanism = opened(contacts=contacts)
    if "avoid" in table and contacts == "auto" and mechanism.contacts_mode == "model":
        mechanism = opened(contacts="avoid")  # the shapes are not to touch
    if mechanism.nu == 0 and not table.get("prescribed"):
        name = "the model" if assets is not None else f"the model {model}"
        joints = json.dumps([joint for joint in mechanism.joint_names if joint], ensure_ascii=False)
        raise ModelError(
            f"{name} has no actuators, expected at least one, or joints whose accelerations are planned: "
            f"prescribed = {joints}."
        )
    return mechanism


def lands(problem: Problem) -> bool:
    """Whether a machine that is planned without contacts is to end on the ground, nearer than a goal's tolerance."""
    mechanism, cost = capabilities_of(problem.dynamics).mechanism, tracking_of(problem.cost)
    if mechanism is None or cost is None or mechanism.contacts_mode != "avoid":
        return False
    if not np.any(thrusters(mechanism)) and not np.any(floating_dofs(mechanism)):
        return False
    return stands_at(model_index_of(mechanism), cost.x_ref[-1, : mechanism.nq], MIN_TOLERANCES["m"])


def _contact_law(law: dict[str, Any], mechanism: Mechanism) -> ContactLaw:
    """The law of a table of GROUND for the machine's mass, or of a table of LAW."""
    if "penetration" in law:
        number("penetration", law["penetration"], greater_than=0.0)
    if "friction_smoothing" in law:
        number("friction_smoothing", law["friction_smoothing"], minimum=0.0, maximum=1.0)
    if "stiffness" in law:
        check_keys(law, LAW, "a contacts table with stiffness")
        return ContactLaw(**_renamed(law))
    check_keys(law, GROUND, "a contacts table without stiffness")
    gravity = float(np.linalg.norm(mechanism.gravity))
    arguments: dict[str, Any] = {"uncertainty": UNCERTAINTY, **_renamed(law)}
    uncertainty = arguments.pop("uncertainty")
    resting = ContactLaw.resting(float(mechanism.mass.sum()), gravity=gravity, **arguments)
    return replace(resting, uncertainty=uncertainty)


def _renamed(law: dict[str, Any]) -> dict[str, Any]:
    """The keys of a contacts table as ContactLaw has them."""
    return {_LAW_ARGUMENTS.get(key, key): value for key, value in law.items()}


def folders_of(beside: Path, given: Any) -> list[str]:
    """Folders of packages, relative to the problem file."""
    folders = [given] if isinstance(given, str) else given
    if not isinstance(folders, list) or not all(isinstance(folder, str) for folder in folders):
        raise PlannerError(f"package_path is {short_repr(given)}, expected a folder of packages, or a list of some.")
    return [str(beside / folder) for folder in folders]


def prescribed_of(table: dict[str, Any], mechanism: Mechanism) -> tuple[str, ...]:
    """The joints whose accelerations are planned, by their names.

    Raises:
        PlannerError: The key is no list of joints.
    """
    names = table.get("prescribed", [])
    known = [name for name in mechanism.joint_names if name]
    if not isinstance(names, list):
        raise PlannerError(f"prescribed is {short_repr(names)}, expected a list of some of: {', '.join(known)}.")
    return tuple(choice("a joint in prescribed", name, known) for name in names)


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
