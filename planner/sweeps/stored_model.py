"""Compare the model in a plan's file with the model that it was made from, as it is on disk now.

Only a file in the plan's own folder, or below it, is read by the path in a plan, which may come from anybody. Another
place is named by the user. A case's model is made by the package, and compared with what this release makes.
"""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from planner.base.errors import FileError
from planner.base.files import printable
from planner.cases import CASES
from planner.model.capabilities import capabilities_of
from planner.model.mjcf.facts import model_changes
from planner.model.mjcf.prescribed_joints import heavy_joints
from planner.model.twin import model_digest, read_again
from planner.problem.goals import MIN_TOLERANCES, given_tolerance, goal_specs_of
from planner.problem.plan import Plan

MAX_NAMED = 5  # changes in a sentence


class ModelState(StrEnum):
    """What became of a stored plan's model."""

    SAME = "same"
    CHANGED = "changed"
    ACCEPTED = "changed, and accepted"
    UNREAD = "not looked at"


class StoredModel(NamedTuple):
    """The model of a stored plan against the one on disk.

    Attributes:
        state: Of the model.
        details: What changed, a sentence each; or why it was not looked at.
        digest: Of the model on disk; "" where it was not read.
        file: Name of the file that was read; "" for none.
    """

    state: ModelState
    details: tuple[str, ...] = ()
    digest: str = ""
    file: str = ""

    def __str__(self) -> str:
        more = f"; and {len(self.details) - MAX_NAMED} more" if len(self.details) > MAX_NAMED else ""
        details = "; ".join(self.details[:MAX_NAMED]) + more
        source = f" ({self.file})" if self.file else ""
        return f"model {self.state}{source}" + (f": {details}" if details else "")


def stored_model(plan: Plan, folder: Path, model: str | Path | None = None, accepted: str = "") -> StoredModel:
    """Compare a stored plan's model with the file that it was read from, or with another MJCF or URDF file.

    Args:
        plan: Of load_plan().
        folder: The plan's own.
        model: The file, in place of the one whose path the plan has.
        accepted: Digest of a changed model that the user has accepted.

    Raises:
        PlannerError: The file given cannot be read, or MuJoCo refuses it; the one that lay with the plan is gone.
    """
    twin = plan.twin
    if twin is None:
        return StoredModel(ModelState.UNREAD, ("the plan has none",))
    mechanism = None if plan.problem is None else capabilities_of(plan.problem.dynamics).mechanism
    if mechanism is not None and heavy_joints(mechanism):
        return StoredModel(ModelState.UNREAD, ("its joints are driven by jerk",))
    if model is None and plan.case in CASES and plan.problem is not None and plan.problem.twin is not None:
        text, files = plan.problem.twin.given, plan.problem.twin.assets  # load_plan() has built the case again
        name = ""
    else:
        file = twin.origin.get("path") if model is None else str(model)
        if not isinstance(file, str):
            return StoredModel(ModelState.UNREAD, ("the plan was made from a text, expected --model FILE",))
        if model is None and not _inside(Path(file), folder):
            where = f"{printable(os.path.relpath(file, folder))} is outside of the plan's folder"
            return StoredModel(ModelState.UNREAD, (f"{where}, expected --model FILE",))
        if model is None and not os.path.isfile(file):
            name = printable(os.path.relpath(file, folder))
            raise FileError(f"its model {name} is not there any more, expected it beside the plan, or --model FILE.")
        text, files = read_again(twin.origin, file)
        name = printable(Path(file).name)
    changes, digest = model_changes(twin.given, text, twin.assets, files), model_digest(text, files)
    changed = ModelState.ACCEPTED if digest == accepted else ModelState.CHANGED
    return StoredModel(changed if changes else ModelState.SAME, changes, digest, name)


def _inside(file: Path, folder: Path) -> bool:
    """Whether a file is in a folder or below it, links followed."""
    return Path(os.path.realpath(file)).is_relative_to(os.path.realpath(folder))


def stated_tolerances(plan: Plan) -> dict[str, float]:
    """The largest tolerance that a plan's file asks for, by unit ("rad", "m/s", ...): of its goals and constraints.

    Those that its goals have by default are not in it. A soft goal has an infinite one.
    """
    problem, largest = plan.problem, {}
    if problem is None:
        return {}
    asked = [(goal.unit, given_tolerance(problem.tolerance, goal)) for goal in goal_specs_of(problem)]
    asked += [  # those of an [avoid] and of a case are smaller than any goal's
        (one.unit, one.tolerance) for one in problem.constraints
        if one.tolerance is not None and one.tolerance > MIN_TOLERANCES.get(one.unit, 0.0)
    ]  # fmt: skip
    if problem.limits is not None and problem.limits.tolerance != type(problem.limits)().tolerance:
        asked.append(("limits", problem.limits.tolerance))
    for unit, value in asked:
        if value is not None:
            largest[unit] = max(value, largest.get(unit, 0.0))
    return largest


def stated(plan: Plan) -> tuple[str, ...]:
    """What a plan's file asks for in its proof, a phrase each: tolerances that were given, and a model that is missing.

    A file can be edited: whoever reads a PASS should see what it was measured by.
    """
    phrases = [
        f"tolerance {'soft, in' if np.isinf(value) else f'{value:g}'} {unit}".rstrip()
        if unit != "limits" else f"tolerance of limits {value:g}"
        for unit, value in stated_tolerances(plan).items()
    ]  # fmt: skip
    twin = plan.twin
    digest = "" if twin is None else twin.origin.get("digest", "")
    if twin is not None and digest and digest != twin.given_digest:
        phrases.append("the model that it was made from is not in the file")
    return tuple(phrases)
