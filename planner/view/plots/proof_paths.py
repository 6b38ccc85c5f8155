"""Panels of a proof over its replays: errors as shares of what passes, the hold of the goal, and other grounds.

A share of 1 is the bound of planner.proof.error_scales.path_error_bounds, whatever the unit of the coordinate.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from planner.base.measured import Section
from planner.problem.plan import Plan
from planner.proof.error_scales import by_unit, has_contacts, path_error_bounds
from planner.proof.goal_regulator import RegulatedRun
from planner.proof.replays.replaying import Replay
from planner.view.plots.style import (
    DASHED,
    HUES,
    MODE_COLOURS,
    MODE_WORDS,
    RED,
    SOFT,
    dress,
    positive,
    say,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHARE = "error / bound"
_DECADES = 6  # below the largest share that are drawn: what is smaller passes in any case
_HIGHEST = 1e6  # the largest share that is drawn; beyond it a replay has long left the plan
_MAX_POINTS = 1500  # points of a curve
_TURNING = "angle_error"  # drawn where there are errors of several units
_GROUND = re.compile(r"(.+)_path_((?:.+_)?error)_(open_loop|feedback)")


def draw_path_errors(axes: Axes, run: Replay) -> None:
    """The errors of a replay over time, of each unit the coordinate that is nearest to its bound."""
    sampling, jumps = run.sampling, has_contacts(run.plan.problem)
    how = "" if sampling is None else f" at {sampling.rate:.4g} Hz, held, {_late(sampling.delay)}"
    words = MODE_WORDS["feedback" if run.feedback else "open-loop"]
    label = f"{SHARE}\n(dashed: not judged)" if jumps else SHARE
    dress(axes, f"Errors of the replay, {words}{how}", label, "time, s")
    _draw_shares(axes, run.plan, run.t, run.error, jumps)


def draw_hold(axes: Axes, held: RegulatedRun) -> None:
    """The deviations from the goal while a regulator holds it."""
    dress(axes, "Deviations from the goal, held by a regulator", SHARE, "time, s")
    _draw_shares(axes, held.plan, held.t, held.deviation, jumps=False)


def _draw_shares(axes: Axes, plan: Plan, t: np.ndarray, errors: np.ndarray, jumps: bool) -> None:
    """Errors (K, ndx) over their bounds by unit; velocities of a machine whose velocities jump are not judged."""
    every = slice(None, None, max(1, len(t) // _MAX_POINTS))
    assert plan.problem is not None  # it was proved
    shares, curves = np.abs(errors[every]) / path_error_bounds(plan), []
    for k, (_, unit, which, names) in enumerate(by_unit(plan.problem)):
        of_unit = np.where(np.isfinite(shares[:, which]), shares[:, which], np.inf)
        judged = not (jumps and unit.endswith("/s"))
        name = names[int(np.argmax(of_unit.max(axis=0)))]
        words = f"{name}{f', {unit}' if unit else ''}"
        curves.append((positive(of_unit.max(axis=1)), judged, HUES[k % len(HUES)][1], words))
    _draw_curves(axes, t[every], curves)


def _draw_curves(axes: Axes, t: np.ndarray, curves: list[tuple[np.ndarray, bool, str, str]]) -> None:
    """Curves on a log scale between the bound and what is too small to matter, with room for a legend below them."""
    axes.set_xlim(float(t[0]), float(t[-1]))
    found = np.concatenate([values for values, *_ in curves])
    found = found[np.isfinite(found)]
    if not found.size:
        say(axes, "no error above zero")
        return
    top = min(max(float(found.max()), 1.0), _HIGHEST)
    bottom = max(float(found.min()), top / 10.0**_DECADES)
    for values, judged, colour, words in curves:
        shown = np.where(values >= bottom, values, np.nan)
        if not np.isfinite(shown).any():
            continue
        axes.plot(t, shown, color=colour, lw=1.4, ls="-" if judged else DASHED, label=words)
    axes.axhline(1.0, color=RED, lw=1.1, label="bound")
    axes.set_yscale("log")
    rows = (len(curves) + 2) // 2
    room = 0.07 + 0.07 * rows  # of the height, for the legend
    axes.set_ylim(bottom / (3.0 * top / bottom) ** (room / (1.0 - room)), 3.0 * top)
    axes.legend(fontsize=7.0, loc="lower center", frameon=False, ncols=2)


def _late(periods: int) -> str:
    return {0: "at once", 1: "one period late"}.get(periods, f"{periods} periods late")


def draw_grounds(axes: Axes, section: Section) -> None:
    """Bars of the largest path error on each ground in both modes, beside them the peak forces."""
    values = {one.name: one for one in section.measured}
    found = [match for name in values if (match := _GROUND.fullmatch(name))]
    kinds = [match[2] for match in found]
    kind = _TURNING if _TURNING in kinds else next(iter(kinds), "")
    found = [match for match in found if match[2] == kind]
    grounds = list(dict.fromkeys(match[1] for match in found))
    unit = values[found[0][0]].unit if found else ""
    words = kind.replace("_", " ").replace("error", "").strip()
    dress(axes, "Another ground: shown, not judged", "", f"largest error of a path, {words} {unit}".rstrip())
    largest = [values[match[0]].value for match in found]
    finite = [value for value in largest if np.isfinite(value) and value > 0.0]
    if not finite:
        say(axes, "no ground changes anything")
        return
    low, high = 0.5 * min(finite), 2.0 * max(finite)
    for k, mode in enumerate(MODE_COLOURS):
        key, colour = mode.replace("-", "_"), MODE_COLOURS[mode]
        for row, ground in enumerate(grounds):
            value, force = (values.get(f"{ground}_{part}_{key}") for part in (f"path_{kind}", "peak_force"))
            if value is None:
                continue
            shown = min(value.value, high) if np.isfinite(value.value) else high
            place = row + (0.2 if k else -0.2)
            axes.barh(
                place, max(shown, low), height=0.38, color=colour, alpha=0.75, label=None if row else MODE_WORDS[mode]
            )
            peak = "" if force is None else f"peak {force.value:,.0f} N"
            note = peak if np.isfinite(value.value) else f"runs away, {peak}"
            axes.annotate(note, (max(shown, low), place), (3, 0), textcoords="offset points", va="center", fontsize=6.5,
                          color=SOFT)  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlim(low, high * (high / low) ** 0.45)  # room for the forces
    axes.set_yticks(range(len(grounds)), [ground.replace("_", "\n") for ground in grounds], fontsize=7)
    axes.set_ylim(len(grounds) - 0.4, -1.6)  # the first on top, room for the legend above it
    axes.grid(False, axis="y")
    axes.legend(fontsize=7.5, loc="upper right", frameon=False, ncols=2)
