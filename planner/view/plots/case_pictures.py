"""The pictures that a case adds to those of every plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

from planner.problem.default_appearance import appearance_of
from planner.problem.pictures import CasePicture, Charts, Paths, StickFigures
from planner.view.plots.charts import draw_charts
from planner.view.plots.paths import draw_paths
from planner.view.plots.stick_figures import draw_stick_figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from planner.problem.plan import Plan
    from planner.proof.replays.replaying import Replay

CASE_PICTURES = {StickFigures: "poses.png", Charts: "measures.png", Paths: "paths.png"}
"""The file of each kind of picture; a case has at most one of a kind."""


def case_pictures(plan: Plan, replay: Replay | None) -> dict[str, CasePicture]:
    """File name -> picture, of a plan and its judged replay; empty for a case without own pictures."""
    pictures = appearance_of(plan.problem).pictures
    return {} if pictures is None else {CASE_PICTURES[type(one)]: one for one in pictures(plan, replay)}


def draw_case_picture(picture: CasePicture) -> Figure:
    """The figure of a case's picture."""
    if isinstance(picture, Charts):
        return draw_charts(picture)
    return draw_paths(picture) if isinstance(picture, Paths) else draw_stick_figures(picture)
