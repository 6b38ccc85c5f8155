"""The studies in the order of the page, and what the paper says that no study answers yet."""

from __future__ import annotations

from collections.abc import Sequence

from planner.base.arguments import choice
from planner.paper.studies.dive import dive_markdown, dive_results, dive_rows, draw_dive
from planner.paper.studies.elbow import draw_elbow, elbow_markdown, elbow_results, elbow_rows
from planner.paper.studies.gradient import draw_gradients, gradient_markdown, gradient_results, gradient_rows
from planner.paper.studies.hopper import draw_hopper, hopper_markdown, hopper_results, hopper_rows
from planner.paper.studies.hopper_splines import (
    draw_hopper_splines,
    hopper_splines_markdown,
    hopper_splines_results,
    hopper_splines_rows,
)
from planner.paper.studies.masses import draw_masses, masses_markdown, masses_results, masses_rows
from planner.paper.studies.motion import draw_motions, motion_markdown, motion_results, motion_rows
from planner.paper.studies.objective import draw_objectives, objective_markdown, objective_results, objective_rows
from planner.paper.studies.page import Row, Study
from planner.paper.studies.puma import draw_puma, puma_markdown, puma_results, puma_rows
from planner.paper.studies.shooting import draw_shooting, shooting_markdown, shooting_results, shooting_rows
from planner.paper.studies.step import step_results
from planner.paper.studies.step_drawing import draw_step, draw_step_cycle, draw_step_methods
from planner.paper.studies.step_page import step_markdown, step_rows
from planner.paper.studies.table import table_markdown, table_results, table_rows
from planner.paper.studies.theorem import draw_theorems, theorem_markdown, theorem_results, theorem_rows

STUDIES: tuple[Study, ...] = (
    Study(
        "motions", "the machines, inverse dynamics and the motions of the arms (Fig. 1 to 4)",
        motion_results, motion_markdown, motion_rows, {"motions.png": draw_motions},
    ),
    Study(
        "masses", "the direct method, and which arm has the paper's efforts (2.1)",
        masses_results, masses_markdown, masses_rows, {"masses.png": draw_masses}, seconds=20,
    ),
    Study(
        "shooting", "indirect shooting, and why it fails (2.1)",
        shooting_results, shooting_markdown, shooting_rows, {"shooting_sensitivity.png": draw_shooting}, seconds=35,
    ),
    Study(
        "elbow", "the adjoint gradient of Eq. 7 near convergence (2.2)",
        elbow_results, elbow_markdown, elbow_rows, {"elbow_gradient.png": draw_elbow}, seconds=25,
    ),
    Study(
        "hopper-splines", "the hopper by B-splines (2.4)",
        hopper_splines_results, hopper_splines_markdown, hopper_splines_rows,
        {"hopper_splines.png": draw_hopper_splines}, seconds=30,
    ),
    Study("table", "Table 1 as printed", table_results, table_markdown, table_rows),
    Study(
        "gradients", "gradient methods beside SLQ",
        gradient_results, gradient_markdown, gradient_rows, {"gradients.png": draw_gradients}, seconds=35,
    ),
    Study(
        "theorems", "Theorems 1 and 2 in numbers",
        theorem_results, theorem_markdown, theorem_rows, {"theorems.png": draw_theorems}, seconds=90,
    ),
    Study(
        "hopper", "the numerical example (section 4)",
        hopper_results, hopper_markdown, hopper_rows, {"hopper.png": draw_hopper}, seconds=25,
    ),
    Study(
        "objectives", "effort, energy, jerk and time (section 1)",
        objective_results, objective_markdown, objective_rows, {"objectives.png": draw_objectives}, seconds=60,
    ),
    Study(
        "puma", "weightlifting with a Puma-like arm (reference 20)",
        puma_results, puma_markdown, puma_rows, {"puma.png": draw_puma}, seconds=60,
    ),
    Study(
        "dive", "a high dive (reference 16)",
        dive_results, dive_markdown, dive_rows, {"dive.png": draw_dive}, seconds=25,
    ),
    Study(
        "step", "the human step (2.3)", step_results, step_markdown, step_rows,
        {"step_fig5.png": draw_step, "step_cycle.png": draw_step_cycle, "step_methods.png": draw_step_methods},
        seconds=50,
    ),
)  # fmt: skip


# Rows of studies that do not exist yet, by the name that the study will have: with it in STUDIES they are gone.
PENDING: dict[str, tuple[Row, ...]] = {}


def chosen(names: Sequence[str]) -> list[Study]:
    """Studies by name, each once, in the order they are named; all of them where none is.

    Raises:
        PlannerError: No such study.
    """
    known = {study.name: study for study in STUDIES}
    return [known[choice("study", name, known)] for name in dict.fromkeys(names)] or list(STUDIES)
