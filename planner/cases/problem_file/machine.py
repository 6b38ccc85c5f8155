"""The machine of a problem.toml: its model, read as the keys of its table ask for it."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import choice, number, short_repr
from planner.base.data_files import check_keys
from planner.base.errors import ModelError, PlannerError
from planner.cases.problem_file.keys import GROUND, LAW, URDF
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
