"""Imports by name at first use: the public names of packages (PEP 562), and what draws results.

A package's `__init__.pyi` lists each name once: `from planner.X import NAME as NAME`. Type checkers read that file, and
this module takes the source of each name from it. So `import planner` is fast and does not choose an OpenGL library.

Mixins with plot(), film() and notebook HTML are for result classes in folders below planner/view, whose results.py
draws them: lower folders must not import it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def public_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package, from its `__init__.pyi`."""
    module = sys.modules[package]
    with open(f"{module.__file__}i", encoding="utf-8") as stub:
        lines = [line.split() for line in stub if line.startswith("from ")]
    home = {name: source for _, source, _, name, *_ in lines}

    def get(name: str) -> Any:
        if name not in home:
            import difflib  # local, so that `import planner` is fast

            similar = difflib.get_close_matches(name, home, n=1)
            hint = f". Did you mean {similar[0]!r}?" if similar else ""
            raise AttributeError(f"module {package!r} has no attribute {name!r}{hint}")
        if home[name] == package:  # a submodule of the package
            return import_module(f"{package}.{name}")
        value = getattr(import_module(home[name]), name)
        setattr(module, name, value)
        return value

    return get, lambda: sorted({*vars(module), *home}), sorted(home)


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
        """Write a film, .mp4, .gif or .apng; options are those of planner.render_video: width, height, fps, speed, ...

        Raises:
            PlannerError: As render_video.
        """
        return import_module(DRAWN_BY).film_of(self, path, **options)
