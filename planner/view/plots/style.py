"""Shared by all plots: figures without pyplot, quiet axes, colours, and gaps where a value cannot be drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.base.errors import FileError
from planner.base.files import PathLike, write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

    from planner.proof.replays.sampled_gains import Sampling

DPI = 130
MINUS = "\N{MINUS SIGN}"
DASHED = (0, (4, 2))
INK = "#222222"
SOFT = "#7d8590"
RED = "#b2182b"

# Plan, replay with gains and open-loop replay in one hue each.
HUES = (
    ("#08306b", "#4292c6", "#b3d4ea"),
    ("#7f2704", "#f47d2b", "#fdd0a2"),
    ("#00441b", "#41ab5d", "#bce4b5"),
    ("#3f007d", "#9a6fc9", "#d9c9ec"),
    ("#164e5c", "#3fb0c4", "#b9e3ea"),
    ("#67001f", "#e377a0", "#f9cfdd"),
    ("#4f4300", "#bda31f", "#ece19b"),
    ("#252525", "#8a8a8a", "#d0d0d0"),
)
GREYS = ("#222222", "#8a8a8a", "#cccccc")
# Distinct for the colour-blind as well (after Okabe and Ito).
MODE_COLOURS = {"open-loop": "#c1570a", "feedback": "#0b5aa6"}
MODE_WORDS = {"open-loop": "open loop", "feedback": "with gains"}

DECADES = 100.0  # a log axis at least so long says enough by its powers of ten
DRAWABLE = 1e60  # larger values are not drawn: matplotlib's axes would overflow

_COLUMN, _ROW, _HEAD = 5.4, 3.1, 0.5  # inches


def blank(width: float, height: float) -> Figure:
    """An empty figure of a size in inches."""
    # Agg objects of its own and no pyplot: neither a display nor a caller's figures are touched.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(w_pad=0.08, h_pad=0.08)  # type: ignore[call-arg]
    return figure


def grid_of(rows: int, columns: int, width: float, height: float) -> tuple[Figure, np.ndarray]:
    """A figure of a size in inches, and its axes (rows, columns)."""
    figure = blank(width, height)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        _colour(axes)
    return figure, grid


def panels_of(panels: int) -> tuple[Figure, list[Axes]]:
    """A figure of two columns, and its axes; an odd last panel takes the whole width."""
    figure, cells = figure_of(panels)
    drawn = [figure.add_subplot(cell) for cell in cells]
    for axes in drawn:
        _colour(axes)
    return figure, drawn


def _colour(axes: Axes) -> None:
    """Curves without a colour of their own take the hues in turn."""
    axes.set_prop_cycle(color=[middle for _, middle, _ in HUES])


def figure_of(panels: int) -> tuple[Figure, list[SubplotSpec]]:
    """The figure of panels_of() without axes, and a cell for each panel."""
    columns = 1 if panels == 1 else 2
    rows = math.ceil(panels / columns)
    figure = blank(_COLUMN * columns, _HEAD + _ROW * rows)
    grid = figure.add_gridspec(rows, columns)
    cells = [grid[index // columns, index % columns] for index in range(panels - 1)]
    return figure, [*cells, grid[rows - 1, (panels - 1) % columns :]]


def save(figure: Figure, path: PathLike) -> None:
    """Write a figure; the suffix of `path` chooses the format.

    Raises:
        FileError: `path` cannot be written, or its suffix names no format.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    kind = Path(path).suffix.lstrip(".").lower()
    known = figure.canvas.get_supported_filetypes()
    if kind not in known:
        names = ", ".join(sorted(known))
        raise FileError(f"cannot write {str(path)!r}: no picture format {kind!r}; expected one of {names}.")
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        low, high = sorted(axis.get_view_interval())
        if axis.get_scale() == "log" and high >= DECADES * low:
            axis.minorticks_off()  # hundreds of them take half of the time of a figure
    with write_atomically(path) as hidden:
        if kind == "png" and isinstance(figure.canvas, FigureCanvasAgg):
            figure.dpi = DPI
            figure.canvas.print_png(hidden)  # draws once; savefig() draws all of it for the layout, and then again
        else:
            figure.savefig(hidden, dpi=DPI, format=kind)


def dress(axes: Axes, title: str, ylabel: str, xlabel: str = "") -> None:
    """Title, labels and quiet lines."""
    if xlabel:
        axes.set_xlabel(xlabel)
    if title:
        axes.set_title(title, fontsize=9.5, loc="left", color=INK)
    axes.set_ylabel(ylabel, fontsize=8.5)
    axes.xaxis.label.set_fontsize(8.5)
    axes.tick_params(which="both", labelsize=8, color="#999999")
    axes.tick_params(length=3)
    axes.grid(True, color="#d9d9d9", lw=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#999999")


def title_above(figure: Figure, title: str) -> None:
    """A title above all panels; none where it is empty."""
    if title:
        figure.suptitle(title, fontsize=12, fontweight="bold", color=INK)


def legend_below(figure: Figure, handles: Sequence[Any], columns: int | None = None) -> None:
    """One legend under all panels, in a row or in so many columns at most."""
    most = len(handles) if columns is None else min(len(handles), columns)
    figure.legend(handles=handles, loc="outside lower center", ncols=most, frameon=False, fontsize=8.5)


def right_axis(axes: Axes, ylabel: str) -> Axes:
    """A second axis at the right."""
    right = axes.twinx()
    dress(right, "", ylabel)
    right.grid(False)
    right.spines["right"].set(visible=True, color="#999999")
    return right


def sampling_words(sampling: Sampling) -> str:
    """How a controller applies gains, e.g. "500 Hz, held, one period late"."""
    late = {0: "at once", 1: "one period late"}.get(sampling.delay, f"{sampling.delay} periods late")
    return f"{sampling.rate:.4g} Hz, held, {late}"


def say(axes: Axes, words: str) -> None:
    """A sentence in place of curves."""
    axes.text(0.5, 0.5, words, ha="center", va="center", transform=axes.transAxes, fontsize=8.5, color=SOFT)
    axes.set_yticks([])


def drawable(values: np.ndarray) -> np.ndarray:
    """The values with gaps where one cannot be drawn."""
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) < DRAWABLE, values, np.nan)


def positive(values: np.ndarray) -> np.ndarray:
    """The values with gaps where a log scale has no place for one."""
    shown = drawable(values)
    with np.errstate(invalid="ignore"):
        return np.where(shown > 0.0, shown, np.nan)
