"""plot(), film() and the HTML of a notebook, for results in folders below planner/view.

planner/view/results.py draws them. It is named here by text and imported when a picture is first requested: this is the
one call upwards.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DRAWN_BY = "planner.view.results"


class Plottable:
    """A result with pictures."""

    def plot(self) -> Figure:
        """A Matplotlib figure of it; `figure.savefig("plan.png")` writes it. It belongs to no window (no pyplot)."""
        return import_module(DRAWN_BY).figure_of(self)

    def _repr_html_(self) -> str:
        """HTML for a notebook: the verdict or the status, and the plot."""
        return import_module(DRAWN_BY).html_of(self)


class Reportable:
    """Results in a folder, with a page of their own."""

    def page(self) -> Path:
        """Write index.html, the page with the maps, into the folder.

        Raises:
            FileError: It cannot be written.
        """
        return import_module(DRAWN_BY).page_of(self)

    def _repr_html_(self) -> str:
        """HTML for a notebook: how the tasks ended, and the first rows."""
        return import_module(DRAWN_BY).html_of_sweep(self)


class Renderable(Plottable):
    """A result with a film too."""

    def film(self, path: str | Path, **options: Any) -> Path:
        """Write a film, .mp4; options are those of planner.render_video: width, height, fps, speed, progress.

        Raises:
            PlannerError: As render_video.
        """
        return import_module(DRAWN_BY).film_of(self, path, **options)
