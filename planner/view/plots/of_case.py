"""The pictures that a case gives beyond those of every plan, each under the name of its kind."""

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
    from planner.proof.replaying import Replay

CASE_PICTURES = {StickFigures: "poses.png", Charts: "measures.png", Paths: "paths.png"}
"""The file that each kind is written to: a case has one of a kind at most."""


def case_pictures(plan: Plan, replay: Replay | None) -> dict[str, CasePicture]:
    """File name -> picture, of a plan and the replay of it that was judged; nothing for a case that gives none."""
    appearance = appearance_of(plan.problem)
    if appearance is None or appearance.pictures is None:
        return {}
    return {CASE_PICTURES[type(picture)]: picture for picture in appearance.pictures(plan, replay)}


def draw_case_picture(picture: CasePicture) -> Figure:
    """The figure of one of them."""
    if isinstance(picture, Charts):
        return draw_charts(picture)
    return draw_paths(picture) if isinstance(picture, Paths) else draw_stick_figures(picture)
