"""The studies in the order of the page."""

from __future__ import annotations

from collections.abc import Sequence

from planner.base.arguments import choice
from planner.paper.studies import (
    dive,
    elbow,
    gradient,
    hopper,
    hopper_splines,
    masses,
    motion,
    objective,
    puma,
    shooting,
    table_1,
    theorem,
)
from planner.paper.studies.step import page as step_study
from planner.paper.studies.study import Study

STUDIES: tuple[Study, ...] = tuple(
    module.STUDY
    for module in (
        motion, masses, shooting, elbow, hopper_splines, table_1, gradient, theorem, hopper, objective, puma, dive,
        step_study,
    )
)  # fmt: skip


def chosen(names: Sequence[str]) -> list[Study]:
    """Studies by name, each once, in the order they are named; all of them where none is.

    Raises:
        PlannerError: No such study.
    """
    known = {study.name: study for study in STUDIES}
    return [known[choice("study", name, known)] for name in dict.fromkeys(names)] or list(STUDIES)
