"""A plan beside its replays over time: goals, constraints, states, controls, contact force, and convergence.

The plan is dashed and dark, a replay solid and wider beneath it, the one without gains widest: where they agree, all
can still be seen. A replay that runs away ends at the edge. Time with contact is shaded in every panel.
"""

from __future__ import annotations

import math
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from planner.dynamics import RigidBodyDynamics, constraint_forces, constraint_names
from planner.problem.appearance import Panel
from planner.problem.default_appearance import appearance_of
from planner.problem.plan import Plan
from planner.proof.replays.replaying import Replay
from planner.view.plots.style import (
    DASHED,
    GREYS,
    HUES,
    INK,
    MINUS,
    MODE_WORDS,
    RED,
    drawable,
    dress,
    figure_of,
    legend_below,
    positive,
    right_axis,
    say,
    title_above,
)
from planner.view.plots.time_series import (
    BESIDE,
    LABEL,
    OWN,
    SHADE,
    SHARED,
    TimeSeries,
    curves_of,
    draw_bounded,
    draw_bounds,
    limited,
    line_of,
    name_curves,
    panels_of,
    range_of,
    replays_of,
    tasks_of,
    to_the_end,
    unit_of,
    until_astray,
    view_limits,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

    from planner.proof import Proof

STANCE = "#ece7dc"

_ALWAYS = 0.95  # of the time: contact that lasts longer is not shaded, or every panel would be
_PAST_AXIS = 1.17  # position of names beside a right-hand axis, in widths of the panel


def draw_plan(plan: Plan, result: Proof | Replay | None) -> Figure:
    """The figure of a plan and its replays: both of a proof, one replay, or none.

    Goals and constraints come first. The appearance of the plan's problem lists the panels of states and controls;
    without any, all of them are drawn.
    """
    replays = replays_of(result)
    tasks, panels = tasks_of(plan, replays), panels_of(plan)
    touched = [replay for replay in replays if np.any(replay.contact_force > 0)]
    shaded = any(np.mean(replay.contact_force > 0) < _ALWAYS for replay in touched)
    chains = _chains(plan)
    figure, cells = figure_of(len(tasks) + len(panels) + bool(touched) + len(chains) + bool(plan.history))
    timed: list[Axes] = []
    for task, cell in zip(tasks, cells, strict=False):
        timed.append(figure.add_subplot(cell))
        draw_bounded(timed[-1], task, replays)
    for panel, cell in zip(panels, cells[len(tasks) :], strict=False):
        timed += _draw_panel(figure, cell, panel, plan, replays)
    if touched:
        timed.append(_draw_force(figure, cells[len(tasks) + len(panels)], replays, plan))
    after = len(tasks) + len(panels) + bool(touched)
    for cell, (unit, curves) in zip(cells[after:], chains.items(), strict=False):
        timed.append(_draw_chains(figure, cell, unit, curves, plan))
    for axes in timed:
        axes.set_xlim(0.0, float(plan.t[-1]))
        if shaded:
            stance = (result if isinstance(result, Replay) else result.replay) if result is not None else touched[0]
            axes.fill_between(
                stance.t, 0.0, 1.0, where=stance.contact_force > 0, transform=axes.get_xaxis_transform(),
                color=STANCE, lw=0, zorder=0,
            )  # fmt: skip
    if plan.history:  # controls that were given have none
        draw_convergence(figure.add_subplot(cells[-1]), plan)
    _head(figure, plan, replays, shaded, {str(line.get_label()) for axes in timed for line in axes.get_lines()})
    return figure


def _draw_panel(figure: Figure, cell: SubplotSpec, panel: Panel, plan: Plan, replays: list[Replay]) -> list[Axes]:
    """One panel; with `difference`, replays minus plan on an axis of its own beneath."""
    curves = curves_of(panel, plan, replays)
    first = next((curve for curve in curves if not curve.stepwise), None)
    beneath = None
    if panel.difference and first is not None and replays:
        inner = cell.subgridspec(2, 1, height_ratios=(3, 1), hspace=0.0)
        axes = figure.add_subplot(inner[0])
        beneath = figure.add_subplot(inner[1], sharex=axes)
    else:
        axes = figure.add_subplot(cell)
    dress(axes, panel.title, panel.ylabel)
    # Controls seldom have the unit of the states: they get the right-hand axis, named by their labels.
    right = None
    if panel.states and panel.controls:
        right = right_axis(axes, ", ".join(label for _, label in panel.controls))

    room = 0.18 if 1 < len(curves) <= BESIDE else 0.05  # for the names
    _keep_in_view(axes, [curve for curve in curves if right is None or not curve.stepwise], room)
    if right is not None:
        _keep_in_view(right, [curve for curve in curves if curve.stepwise], room)
    for curve, hue in zip(curves, cycle(HUES), strict=False):
        steps = "steps-post" if curve.stepwise else "default"
        on = right if curve.stepwise and right is not None else axes
        for replay, (t, values) in zip(replays, curve.replays, strict=True):
            result = until_astray(values, on.get_ylim())
            on.plot(t, result, **line_of(replay, hue), drawstyle=steps, solid_capstyle="round", scaley=False)
        on.plot(
            curve.plan[0], drawable(curve.plan[1]), color=hue[0], lw=1.2, ls=DASHED, drawstyle=steps,
            label=curve.label, zorder=3, scaley=False,
        )  # fmt: skip
        draw_bounds(on, plan, curve.index, hue[0], stepwise=curve.stepwise)
    if len(curves) > 1:
        name_curves(right or axes, [curve.label for curve in curves], 1.0 if right is None else _PAST_AXIS)
    if beneath is None or first is None:
        axes.set_xlabel("time, s")
        return [axes]
    axes.tick_params(labelbottom=False)
    _draw_difference(beneath, first, replays, panel.ylabel)
    return [axes, beneath]


def _keep_in_view(axes: Axes, curves: list[TimeSeries], room: float) -> None:
    """Set the limits of the axis."""
    planned = [curve.plan[1] for curve in curves]
    replayed = [values for curve in curves for _, values in curve.replays]
    low, high = range_of(planned)
    if low == high:  # a constant plan has no range; take that of the replay with gains, the last one
        planned += [curve.replays[-1][1] for curve in curves if curve.replays]
    axes.set_ylim(view_limits(planned, replayed, room))


def _draw_difference(axes: Axes, curve: TimeSeries, replays: list[Replay], ylabel: str) -> None:
    """Draw replays minus plan, in a power of a thousand of the unit."""
    t, planned = curve.plan
    # Replays of a plan whose stages are no whole number of periods of a controller have times of their own.
    differences = [drawable(values) - np.interp(at, t, drawable(planned)) for at, values in curve.replays]
    power = _power_of_thousand(np.concatenate(differences))
    dress(axes, "", "")
    for replay, (at, _), difference in zip(replays, curve.replays, differences, strict=True):
        style = line_of(replay, HUES[5])
        color = RED if replay.feedback or len(replays) == 1 else style["color"]
        axes.plot(at, difference / 1000.0**power, color=color, lw=0.5 * style["lw"], zorder=3)
    axes.axhline(0.0, color=INK, lw=0.6, zorder=1)
    axes.locator_params(axis="y", nbins=3)
    axes.margins(y=0.25)
    scale = f"$10^{{{3 * power}}}$" if power else ""
    unit = " ".join(part for part in (scale, unit_of(ylabel)) if part)
    axes.set_title(
        f"{curve.label}, replay {MINUS} plan" + (f" ({unit})" if unit else ""), fontsize=8, loc="left",
        color=RED, pad=3,
    )  # fmt: skip
    axes.set_xlabel("time, s")


def _draw_force(figure: Figure, cell: SubplotSpec, replays: list[Replay], plan: Plan) -> Axes:
    axes = figure.add_subplot(cell)
    unit = appearance_of(plan.problem).force_unit or "model units"
    dress(axes, "Contact force in the replay", f"normal force, {unit}")
    for replay in replays:
        light = len(replays) > 1 and not replay.feedback
        color, width = ("#f2a3a8", 3.0) if light else (RED, 1.3)
        axes.plot(replay.t, drawable(replay.contact_force), color=color, lw=width, zorder=3)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time, s")
    return axes


def _chains(plan: Plan) -> dict[str, dict[str, np.ndarray]]:
    """By unit and name the size (N,) of what holds each closed chain together, at the beginning of each stage."""
    dynamics = None if plan.problem is None else plan.problem.dynamics
    found: dict[str, dict[str, np.ndarray]] = {}
    if not isinstance(dynamics, RigidBodyDynamics) or not dynamics.capabilities.loops:
        return found
    forces, row = constraint_forces(dynamics, plan.xs[:-1], plan.us), 0
    names = constraint_names(dynamics.mechanism)
    for loop in dynamics.mechanism.loops:
        for unit, first in (("N", row), ("N m", row + 3))[: loop.rows // 3]:
            found.setdefault(unit, {})[loop.name] = np.linalg.norm(forces[:, first : first + 3], axis=1)
        row += loop.rows
    for (name, unit), values in zip(names[row:], forces.T[row:], strict=True):
        found.setdefault(unit, {})[name] = np.abs(values)
    return found


def _draw_chains(figure: Figure, cell: SubplotSpec, unit: str, curves: dict[str, np.ndarray], plan: Plan) -> Axes:
    axes = figure.add_subplot(cell)
    dress(axes, "What holds closed chains together, in the plan", f"{'force' if unit == 'N' else 'moment'}, {unit}")
    for values, hue in zip(curves.values(), cycle(HUES), strict=False):
        axes.plot(plan.t, drawable(to_the_end(values)), color=hue[0], lw=1.2, ls=DASHED, zorder=3)
    name_curves(axes, [name.removeprefix("equality ").strip("'") for name in curves], 1.0)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time, s")
    return axes


def _head(figure: Figure, plan: Plan, replays: list[Replay], touched: bool, lines: set[str]) -> None:
    """Draw the title and one legend for all panels, which have lines with these labels."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    title_above(figure, appearance_of(plan.problem).title or plan.name or "Plan")
    handles: list[Line2D | Patch] = [Line2D([], [], color=INK, lw=1.2, ls=DASHED, label="plan")]
    for replay in replays:
        words = MODE_WORDS["feedback" if replay.feedback else "open-loop"]
        handles.append(Line2D([], [], **line_of(replay, GREYS), label=f"replay in MuJoCo, {words}"))
    if touched:
        handles.append(Patch(facecolor=STANCE, edgecolor="#cfc8b8", lw=0.5, label="stance (contact force > 0)"))
    if SHARED in lines:
        handles.append(Line2D([], [], color=RED, lw=1.0, label="bound"))
    if OWN in lines or limited(plan):
        handles.append(Line2D([], [], color=INK, lw=1.0, ls=":", label="bound of the curve in its colour"))
    if limited(plan):
        handles.append(Patch(facecolor=INK, alpha=SHADE, label=LABEL))
    legend_below(figure, handles, 4)


def _power_of_thousand(values: np.ndarray) -> int:
    """The k for which values / 1000**k are numbers of one to three digits."""
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    return math.floor(math.log10(largest) / 3) if largest > 0 else 0


_MARKED = 60  # iterations beyond which marks would be a band


def draw_convergence(axes: Axes, plan: Plan) -> None:
    """Cost minus final cost, and gradient norm, at each iteration."""
    dress(axes, "Convergence", "", "iteration")
    axes.locator_params(axis="x", integer=True)
    iterations = np.array([line.iteration for line in plan.history], dtype=float)
    excess = drawable(np.array([line.cost for line in plan.history], dtype=float))
    if excess.size and np.isfinite(excess[-1]):
        excess = excess - excess[-1]
    gradient = np.array([line.gradient_norm for line in plan.history], dtype=float)
    drawn = False
    for axis, label, values, dark, marker in (
        (axes, f"cost {MINUS} final cost", excess, HUES[0][0], "o"),
        (None, "gradient norm", gradient, HUES[1][0], "s"),
    ):
        # A log scale has no zero: the last cost, which is the final one, falls out, and so does rounding.
        shown = positive(values)  # not finite where there is nothing to draw: a gap, which no line bridges
        if not np.any(np.isfinite(shown)):
            continue
        if axis is None:
            axis = right_axis(axes, "") if drawn else axes
        axis.set_yscale("log")
        mark = marker if len(iterations) < _MARKED else ""
        axis.plot(iterations, shown, color=dark, lw=1.2, marker=mark, ms=3.5)
        axis.set_ylabel(label, color=dark, fontsize=8.5)
        axis.tick_params(axis="y", which="both", colors=dark)
        axis.tick_params(axis="y", which="minor", length=1.5)
        drawn = True
    if not drawn:
        say(axes, "no finite iteration")
