"""The studies in the order of the page, and what the paper says that no study answers yet."""

from __future__ import annotations

from collections.abc import Sequence

from planner.arguments import choice
from planner.paper_studies.gradient_study import draw_gradients, gradient_markdown, gradient_results, gradient_rows
from planner.paper_studies.hopper_study import draw_hopper, hopper_markdown, hopper_results, hopper_rows
from planner.paper_studies.motion_study import draw_motions, motion_markdown, motion_results, motion_rows
from planner.paper_studies.page import Row, Study
from planner.paper_studies.table_study import table_markdown, table_results, table_rows
from planner.paper_studies.theorem_study import draw_theorems, theorem_markdown, theorem_results, theorem_rows

STUDIES: tuple[Study, ...] = (
    Study(
        "motions", "the machines, inverse dynamics and the motions of the arms (Fig. 1 to 4)",
        motion_results, motion_markdown, motion_rows, {"motions.png": draw_motions},
    ),
    Study("table", "Table 1 as printed", table_results, table_markdown, table_rows),
    Study(
        "gradients", "gradient methods beside SLQ",
        gradient_results, gradient_markdown, gradient_rows, {"gradients.png": draw_gradients},
    ),
    Study(
        "theorems", "Theorems 1 and 2 in numbers",
        theorem_results, theorem_markdown, theorem_rows, {"theorems.png": draw_theorems},
    ),
    Study(
        "hopper", "the numerical example (section 4)",
        hopper_results, hopper_markdown, hopper_rows, {"hopper.png": draw_hopper},
    ),
)  # fmt: skip


def _pending(where: str, paper: str, why: str) -> Row:
    return {"where": where, "paper": paper, "why": why}


_METHOD = "the study of this method of the paper is not built yet"
_STEP = "contact on trees and the human step come next"

# Rows of studies that do not exist yet, by the name that the study will have: with it in STUDIES they are gone.
PENDING: dict[str, tuple[Row, ...]] = {
    "spline": (
        _pending("2.1", "Quintic B-splines, 12 knot intervals, BFGS: effort from 73.6 to 9.9", _METHOD),
        _pending("2.1", "No masses, lengths or gravity are given", _METHOD),
        _pending("2.1", "About 2 minutes on a PIII-800", _METHOD),
    ),
    "shooting": (_pending("2.1", "The shooting method failed: the costate equations are too sensitive", _METHOD),),
    "puma": (_pending("2.1, ref. 20", "Puma 762: three times the payload of the manufacturer's figure", _METHOD),),
    "adjoint": (
        _pending("2.2, Eq. 7", "Elbow motion as splines, gradient by the costate: swing-up from q1 = -1.0", _METHOD),
        _pending("2.2", "Round-off leads to large relative errors of the gradient near convergence", _METHOD),
        _pending("2.2", "About 5 minutes on a PIII-800, with tolerances adjusted", _METHOD),
    ),
    "dive": (_pending("2.2, ref. 16", "High dives of a human-like diver by the same approach", _METHOD),),
    "step": (
        _pending("2.3", "Human step: 32 B-spline parameters for the swing hip", _STEP),
        _pending("2.3, Fig. 5", "The pelvis alone moves a paralysed leg through a step near the recorded gait", _STEP),
        _pending("2.3", "Approximately 4 hours to converge (PIII-800)", _STEP),
        _pending("2.3", "Stance and swing together were unstable and did not converge", _STEP),
        _pending("2.3", '"In just a few minutes" with the new algorithm, stance and swing together', _STEP),
    ),
    "hopper-splines": (
        _pending("2.4", "The hopper by B-splines would not converge, with much tweaking of tolerances", _METHOD),
    ),
}


def chosen(names: Sequence[str]) -> list[Study]:
    """Studies by name, each once, in the order they are named; all of them where none is.

    Raises:
        PlannerError: No such study.
    """
    known = {study.name: study for study in STUDIES}
    return [known[choice("study", name, known)] for name in dict.fromkeys(names)] or list(STUDIES)
