"""The pictures that a case gives beyond those of every plan, each under the name of its kind."""

from __future__ import annotations

from typing import TYPE_CHECKING

from planner.base.files import PathLike
from planner.problem.default_appearance import appearance_of
from planner.problem.pictures import CasePicture, Charts, Paths, StickFigures
from planner.view.plots.charts import plot_charts
from planner.view.plots.paths import plot_paths
from planner.view.plots.stick_figures import plot_stick_figures

if TYPE_CHECKING:
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


def plot_case_picture(picture: CasePicture, path: PathLike) -> None:
    """Write one of them.

    Raises:
        FileError: `path` cannot be written, or its suffix names no format.
    """
    if isinstance(picture, Charts):
        plot_charts(picture.t, picture.charts, path, xlabel=picture.xlabel, title=picture.title,
                    span_label=picture.span_label)  # fmt: skip
    elif isinstance(picture, Paths):
        plot_paths(picture.traces, path, title=picture.title)
    else:
        plot_stick_figures(picture.motions, picture.sticks, path, poses=len(picture.times), times=picture.times,
                           ground=picture.ground, title=picture.title)  # fmt: skip
