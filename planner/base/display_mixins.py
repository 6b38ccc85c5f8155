"""Mixins with plot(), film() and notebook HTML, for result classes in folders below planner/view.

planner/view/results.py draws them; it is imported by name on first use, since lower folders must not import it.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DRAWN_BY = "planner.view.results"


class Plottable:
    """A result with a plot."""

    def plot(self) -> Figure:
        """A Matplotlib figure of the result, without a window (no pyplot); `figure.savefig("plan.png")` writes it."""
        return import_module(DRAWN_BY).figure_of(self)

    def _repr_html_(self) -> str:
        """HTML for a notebook: the verdict or the status, and the plot."""
        return import_module(DRAWN_BY).html_of(self)


class Reportable:
    """Results in a folder, with an HTML page."""

    def page(self) -> Path:
        """Write index.html, the page with the maps, into the folder.

        Raises:
            FileError: The page cannot be written.
        """
        return import_module(DRAWN_BY).page_of(self)

    def _repr_html_(self) -> str:
        """HTML for a notebook: outcomes of the tasks, and the first table rows."""
        return import_module(DRAWN_BY).html_of_sweep(self)


class Renderable(Plottable):
    """A result with a plot and a film."""

    def film(self, path: str | Path, **options: Any) -> Path:
        """Write a film, .mp4 or .gif; options are those of planner.render_video: width, height, fps, speed, progress.

        Raises:
            PlannerError: As render_video.
        """
        return import_module(DRAWN_BY).film_of(self, path, **options)
