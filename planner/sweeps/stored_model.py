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

from planner.base.files import printable
from planner.cases import CASES
from planner.model.capabilities import capabilities_of
from planner.model.mjcf.model_changes import model_changes
from planner.model.mjcf.prescribed_joints import heavy_joints
from planner.model.model_origin import read_again
from planner.model.twin import model_digest
from planner.problem.goals import given_tolerance, goal_specs_of
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
    """

    state: ModelState
    details: tuple[str, ...] = ()
    digest: str = ""

    def __str__(self) -> str:
        more = f"; and {len(self.details) - MAX_NAMED} more" if len(self.details) > MAX_NAMED else ""
        details = "; ".join(self.details[:MAX_NAMED]) + more
        return f"model {self.state}" + (f": {details}" if details else "")


def stored_model(plan: Plan, folder: Path, model: str | Path | None = None, accepted: str = "") -> StoredModel:
    """Compare a stored plan's model with the file that it was read from, or with another MJCF or URDF file.

    Args:
        plan: Of load_plan().
        folder: The plan's own.
        model: The file, in place of the one whose path the plan has.
        accepted: Digest of a changed model that the user has accepted.

    Raises:
        PlannerError: The file given cannot be read, or MuJoCo refuses it.
    """
    twin = plan.twin
    if twin is None:
        return StoredModel(ModelState.UNREAD, ("the plan has none",))
    mechanism = None if plan.problem is None else capabilities_of(plan.problem.dynamics).mechanism
    if mechanism is not None and heavy_joints(mechanism):
        return StoredModel(ModelState.UNREAD, ("its joints are driven by jerk",))
    if model is None and plan.case in CASES and plan.problem is not None and plan.problem.twin is not None:
        text, files = plan.problem.twin.given, plan.problem.twin.assets  # load_plan() has built the case again
    else:
        file = twin.origin.get("path") if model is None else str(model)
        if not isinstance(file, str):
            return StoredModel(ModelState.UNREAD, ("the plan was made from a text, expected --model FILE",))
        if model is None and not _inside(Path(file), folder):
            where = f"{printable(os.path.relpath(file, folder))} is outside of the plan's folder"
            return StoredModel(ModelState.UNREAD, (f"{where}, expected --model FILE",))
        if model is None and not os.path.isfile(file):
            return StoredModel(ModelState.UNREAD, (f"{printable(Path(file).name)} is absent, expected --model FILE",))
        text, files = read_again(twin.origin, file)
    changes, digest = model_changes(twin.given, text, twin.assets, files), model_digest(text, files)
    if not changes:
        return StoredModel(ModelState.SAME, (), digest)
    return StoredModel(ModelState.ACCEPTED if digest == accepted else ModelState.CHANGED, changes, digest)


def _inside(file: Path, folder: Path) -> bool:
    """Whether a file is in a folder or below it, links followed."""
    return Path(os.path.realpath(file)).is_relative_to(os.path.realpath(folder))


def stated(plan: Plan) -> tuple[str, ...]:
    """What a plan's file asks for in its proof, a phrase each: tolerances that were given, and a model that is missing.

    A file can be edited: whoever reads a PASS should see what it was measured by.
    """
    phrases, problem = [], plan.problem
    if problem is not None:
        largest: dict[str, float] = {}
        for goal in goal_specs_of(problem):
            if (value := given_tolerance(problem.tolerance, goal)) is not None:
                largest[goal.unit] = max(value, largest.get(goal.unit, 0.0))
        for unit, value in largest.items():
            phrases.append(f"tolerance {'soft, in' if np.isinf(value) else f'{value:g}'} {unit}".rstrip())
        if problem.limits is not None and problem.limits.tolerance != type(problem.limits)().tolerance:
            phrases.append(f"tolerance of limits {problem.limits.tolerance:g}")
    twin = plan.twin
    digest = "" if twin is None else twin.origin.get("digest", "")
    if twin is not None and digest and digest != twin.given_digest:
        phrases.append("the model that it was made from is not in the file")
    return tuple(phrases)
