"""Plots of a plan beside its replay: states, controls, contact force and convergence in one figure.

Which states and controls are drawn is the machine's to say (`Stage.plots`); nothing here knows a machine. The
plan is dashed and dark, the replay solid and wide beneath it: where they agree, both can still be seen. Time
with contact is shaded in every panel.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from planner.default_stage import stage_of
from planner.errors import FileError
from planner.files import PathLike, write_atomically
from planner.plan import Plan
from planner.replay import Replay
from planner.stage import Panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

DPI = 130

# Pairs (plan, replay) of one hue each, told apart by the colour-blind as well (after Okabe and Ito).
HUES = (
    ("#08306b", "#6baed6"),
    ("#7f2704", "#fd9a4d"),
    ("#00441b", "#74c476"),
    ("#3f007d", "#bc8fdc"),
    ("#164e5c", "#74cbd9"),
    ("#67001f", "#f2a3bd"),
    ("#4f4300", "#d3bf45"),
    ("#252525", "#a9a9a9"),
)
MINUS = "\N{MINUS SIGN}"
INK = "#222222"
STANCE = "#ece7dc"
FORCE = "#b2182b"

# Values beyond this are not drawn: a plan that ran away must not break the axes of the others.
_DRAWABLE = 1e60

# More curves than this in one panel can no longer be told apart.
_MOST_CURVES = len(HUES)


@dataclass(frozen=True)
class _Curve:
    """One quantity over time: (t, values) of the plan, and of the replay if there is one."""

    label: str
    plan: tuple[np.ndarray, np.ndarray]
    replay: tuple[np.ndarray, np.ndarray] | None
    held: bool  # constant over a stage: drawn as steps


def plot_plan(plan: Plan, replay: Replay | None, path: PathLike) -> None:
    """Write the figure of a plan, and of its replay, to `path`.

    Args:
        plan: What was planned. Its problem's stage lists the panels; without one, all states and controls.
        replay: What MuJoCo did with it, or None.
        path: The file to write; its suffix chooses the format (png, pdf, svg).

    Raises:
        FileError: `path` cannot be written, or its suffix names no format.
    """
    figure = draw_plan(plan, replay)
    kind = Path(path).suffix.lstrip(".").lower()
    known = figure.canvas.get_supported_filetypes()
    if kind not in known:
        names = ", ".join(sorted(known))
        raise FileError(f"Cannot write {str(path)!r}: no picture format {kind!r}; expected one of {names}.")
    with write_atomically(path) as hidden:
        figure.savefig(hidden, dpi=DPI, format=kind)


def draw_plan(plan: Plan, replay: Replay | None) -> Figure:
    """The figure that plot_plan() writes."""
    # Agg objects of its own and no pyplot: neither a display nor a caller's figures are touched.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = _panels(plan)
    touched = replay is not None and bool(np.any(replay.contact_force > 0))
    total = len(panels) + touched + 1
    columns = 1 if total == 1 else 2
    rows = math.ceil(total / columns)

    figure = Figure(figsize=(5.4 * columns, 0.5 + 3.1 * rows), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(w_pad=0.08, h_pad=0.08)  # type: ignore[call-arg]
    grid = figure.add_gridspec(rows, columns)
    # An odd last panel takes the whole width.
    cells = [grid[index // columns, index % columns] for index in range(total - 1)]
    cells.append(grid[rows - 1, (total - 1) % columns :])

    timed: list[Axes] = []
    for panel, cell in zip(panels, cells, strict=False):
        timed += _draw_panel(figure, cell, panel, plan, replay)
    if replay is not None and touched:
        stage = stage_of(plan.problem)
        timed.append(_draw_force(figure, cells[len(panels)], replay, "" if stage is None else stage.force_unit))
    for axes in timed:
        axes.set_xlim(0.0, float(plan.t[-1]))
        if replay is not None and touched:
            _shade_stance(axes, replay)
    _draw_convergence(figure, cells[-1], plan)
    _head(figure, plan, replay, touched)
    return figure


def _panels(plan: Plan) -> tuple[Panel, ...]:
    """The panels that the plan's stage lists; for a plan without any, its states and its controls."""
    stage = stage_of(plan.problem)
    if stage is not None and stage.plots:
        return stage.plots
    nx, nu = min(plan.xs.shape[1], _MOST_CURVES), min(plan.us.shape[1], _MOST_CURVES)
    return (
        Panel("States", "x", states=tuple((index, f"x[{index}]") for index in range(nx))),
        Panel("Controls", "u", controls=tuple((index, f"u[{index}]") for index in range(nu))),
    )


def _curves(panel: Panel, plan: Plan, replay: Replay | None) -> list[_Curve]:
    curves = []
    for index, label in panel.states:
        planned = (plan.t, plan.xs[:, index])
        simulated = None
        if replay is not None:
            planned = (replay.t, replay.plan_xs[:, index])
            simulated = (replay.t, replay.xs[:, index])
        curves.append(_Curve(label, planned, simulated, held=False))
    for index, label in panel.controls:
        simulated = None if replay is None else (replay.t, _to_the_end(replay.ctrl[:, index]))
        curves.append(_Curve(label, (plan.t, _to_the_end(plan.us[:, index])), simulated, held=True))
    return curves


def _draw_panel(figure: Figure, cell: SubplotSpec, panel: Panel, plan: Plan, replay: Replay | None) -> list[Axes]:
    """One panel of the stage; with `difference`, replay minus plan on an axis of its own beneath."""
    curves = _curves(panel, plan, replay)
    first = next((curve for curve in curves if not curve.held), None)
    beneath = None
    if panel.difference and first is not None and first.replay is not None:
        inner = cell.subgridspec(2, 1, height_ratios=(3, 1), hspace=0.0)
        axes = figure.add_subplot(inner[0])
        beneath = figure.add_subplot(inner[1], sharex=axes)
    else:
        axes = figure.add_subplot(cell)
    _dress(axes, panel.title, panel.ylabel)
    # Controls seldom have the unit of the states: they get the right-hand axis, named by their labels.
    right = None
    if panel.states and panel.controls:
        right = _right_axis(axes, ", ".join(label for _, label in panel.controls))

    for curve, (dark, light) in zip(curves, _cycled(len(curves)), strict=True):
        steps = "steps-post" if curve.held else "default"
        on = right if curve.held and right is not None else axes
        if curve.replay is not None:
            on.plot(
                curve.replay[0], _finite(curve.replay[1]), color=light, lw=2.6, drawstyle=steps, zorder=2,
                solid_capstyle="round",
            )  # fmt: skip
        on.plot(
            curve.plan[0], _finite(curve.plan[1]), color=dark, lw=1.2, ls=(0, (4, 2)), drawstyle=steps,
            label=curve.label, zorder=3,
        )  # fmt: skip
    if len(curves) > 1:
        _name_curves(right or axes, [curve.label for curve in curves])
        axes.margins(y=0.18)  # room for the names

    if beneath is None or first is None or first.replay is None:
        axes.set_xlabel("time (s)")
        return [axes]
    axes.tick_params(labelbottom=False)
    difference = _finite(first.replay[1]) - _finite(first.plan[1])
    power = _power_of_thousand(difference)
    _dress(beneath, "", "")
    beneath.plot(first.plan[0], difference / 1000.0**power, color=FORCE, lw=1.1, zorder=3)
    beneath.axhline(0.0, color=INK, lw=0.6, zorder=1)
    beneath.locator_params(axis="y", nbins=3)
    beneath.margins(y=0.25)
    unit = re.search(r"[(\[,]\s*([^()\[\],]+?)\s*[)\]]?$", panel.ylabel)
    scale = f"$10^{{{3 * power}}}$" if power else ""
    shown = " ".join(part for part in (scale, unit[1] if unit else "") if part)
    beneath.set_title(
        f"{first.label}, replay {MINUS} plan" + (f" ({shown})" if shown else ""), fontsize=8, loc="left",
        color=FORCE, pad=3,
    )  # fmt: skip
    beneath.set_xlabel("time (s)")
    return [axes, beneath]


def _draw_force(figure: Figure, cell: SubplotSpec, replay: Replay, unit: str) -> Axes:
    axes = figure.add_subplot(cell)
    _dress(axes, "Contact force in the replay", f"normal force, {unit or 'model units'}")
    force = _finite(replay.contact_force)
    axes.plot(replay.t, force, color=FORCE, lw=1.3, zorder=3)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time (s)")
    return axes


def _draw_convergence(figure: Figure, cell: SubplotSpec, plan: Plan) -> None:
    """Cost minus final cost, and gradient norm, at each iteration."""
    axes = figure.add_subplot(cell)
    _dress(axes, "Convergence", "")
    axes.set_xlabel("iteration")
    axes.locator_params(axis="x", integer=True)
    iterations = np.array([line.iteration for line in plan.history], dtype=float)
    excess = _finite(np.array([line.cost for line in plan.history], dtype=float))
    if excess.size and np.isfinite(excess[-1]):
        excess = excess - excess[-1]
    gradient = np.array([line.gradient_norm for line in plan.history], dtype=float)
    drawn = False
    for axis, label, values, (dark, _), marker in (
        (axes, f"cost {MINUS} final cost", excess, HUES[0], "o"),
        (None, "gradient norm", gradient, HUES[1], "s"),
    ):
        # A log scale has no zero: the last cost, which is the final one, falls out, and so does rounding.
        shown = np.isfinite(values) & (values > 0) & (values < _DRAWABLE)
        if not np.any(shown):
            continue
        if axis is None:
            axis = _right_axis(axes, "") if drawn else axes
        axis.set_yscale("log")
        axis.plot(iterations[shown], values[shown], color=dark, lw=1.2, marker=marker, ms=3.5)
        axis.set_ylabel(label, color=dark, fontsize=8.5)
        axis.tick_params(axis="y", which="both", colors=dark)
        axis.tick_params(axis="y", which="minor", length=1.5)
        drawn = True
    if not drawn:
        axes.text(0.5, 0.5, "no finite iteration", ha="center", va="center", transform=axes.transAxes)
        axes.set_yticks([])


def _shade_stance(axes: Axes, replay: Replay) -> None:
    axes.fill_between(
        replay.t, 0.0, 1.0, where=replay.contact_force > 0, transform=axes.get_xaxis_transform(),
        color=STANCE, lw=0, zorder=0,
    )  # fmt: skip


def _head(figure: Figure, plan: Plan, replay: Replay | None, touched: bool) -> None:
    """The title, and one legend for what is the same in every panel."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    stage = stage_of(plan.problem)
    title = stage.title if stage is not None else (plan.case or "Plan")
    figure.suptitle(title, fontsize=12, fontweight="bold", color=INK)
    handles: list[Line2D | Patch] = [Line2D([], [], color=INK, lw=1.2, ls=(0, (4, 2)), label="plan")]
    if replay is not None:
        mode = "with feedback" if replay.feedback else "open loop"
        handles.append(Line2D([], [], color="#9a9a9a", lw=2.6, label=f"replay in MuJoCo, {mode}"))
    if touched:
        handles.append(Patch(facecolor=STANCE, edgecolor="#cfc8b8", lw=0.5, label="stance (contact force > 0)"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=8.5)


def _name_curves(axes: Axes, labels: list[str]) -> None:
    """A legend by colour: each curve's plan and replay share a hue."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=dark, lw=2.0) for dark, _ in _cycled(len(labels))]
    legend = axes.legend(
        handles, labels, fontsize=8, loc="upper left", ncols=min(len(labels), 3), framealpha=0.85,
        edgecolor="none", borderpad=0.3, handlelength=1.4,
    )  # fmt: skip
    legend.set_zorder(5)
    axes.margins(y=0.18)


def _dress(axes: Axes, title: str, ylabel: str) -> None:
    if title:
        axes.set_title(title, fontsize=9.5, loc="left", color=INK)
    axes.set_ylabel(ylabel, fontsize=8.5)
    axes.xaxis.label.set_fontsize(8.5)
    axes.tick_params(labelsize=8, color="#999999", length=3)
    axes.grid(True, color="#d9d9d9", lw=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#999999")


def _right_axis(axes: Axes, ylabel: str) -> Axes:
    right = axes.twinx()
    _dress(right, "", ylabel)
    right.grid(False)
    right.spines["right"].set(visible=True, color="#999999")
    return right


def _power_of_thousand(values: np.ndarray) -> int:
    """The k for which values / 1000**k are numbers of one to three digits."""
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    return math.floor(math.log10(largest) / 3) if largest > 0 else 0


def _cycled(count: int) -> list[tuple[str, str]]:
    return [HUES[index % len(HUES)] for index in range(count)]


def _to_the_end(us: np.ndarray) -> np.ndarray:
    """Controls (N,) with the last one repeated, so that its stage is drawn too: (N+1,)."""
    return np.append(us, us[-1:])


def _finite(values: np.ndarray) -> np.ndarray:
    """The values with gaps where one cannot be drawn."""
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) < _DRAWABLE, values, np.nan)
