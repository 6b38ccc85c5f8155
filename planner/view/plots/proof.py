"""The figure of a proof: errors of replays and their propagation, step convergence, Monte Carlo, contact sensitivity.

Panels that do not apply are left out. Errors are divided by their bounds, so that 1 is the bound whatever the unit.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from planner.base.measured import Section
from planner.model.coordinates import coordinates_of
from planner.problem.plan import Plan
from planner.proof import Proof
from planner.proof.error_propagation import ErrorPropagation
from planner.proof.error_scales import by_unit, has_contacts, is_path_judged, path_error_bounds, ranges_of_motion
from planner.proof.goal_regulator import RegulatedRun
from planner.proof.replays.replaying import Replay
from planner.proof.robustness.perturbed import RobustnessResult
from planner.proof.robustness.rollouts import CLOCK
from planner.proof.step_convergence import StepConvergence
from planner.view.plots.style import (
    DASHED,
    GREYS,
    HUES,
    INK,
    MODE_COLOURS,
    MODE_WORDS,
    RED,
    SOFT,
    drawable,
    dress,
    panels_of,
    positive,
    sampling_words,
    say,
    title_above,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DECADES = 16  # decades below the largest error that are drawn; smaller errors are rounding
_HIGHEST = 1e6  # largest error over its bound that is drawn; such a replay has long left the plan
_BINS = 36
_LABEL = 36  # characters beside an axis
_LINEAR = 1e3  # larger deviations are drawn on a symmetric log scale


def draw_proof(proof: Proof) -> Figure:
    """The figure of a proof's measurements."""
    plan, rollouts = proof.replay.plan, proof.monte_carlo
    panels: list[Callable[[Axes], None]] = [partial(draw_path_errors, run=run) for run in proof.replays.values()]
    panels.append(partial(_draw_growth, errors=proof.errors))
    if proof.convergence is not None:
        panels.append(partial(_draw_order, order=proof.convergence))
    if rollouts is not None and rollouts.done:
        panels += [partial(_draw_fan, rollouts=rollouts, mode=mode, plan=plan) for mode in rollouts.fans]
        panels.append(partial(_draw_ends, rollouts=rollouts))
    if proof.held is not None:
        panels.append(partial(draw_hold, held=proof.held))
    ground = proof.sections.get("another_ground")
    if ground is not None and ground.measured:
        panels.append(partial(draw_grounds, section=ground))
    figure, axes = panels_of(len(panels))
    for draw, on in zip(panels, axes, strict=True):
        draw(on)
    title_above(figure, "What the proof measured")
    return figure


def _draw_growth(axes: Axes, errors: ErrorPropagation) -> None:
    dress(axes, "Growth of errors: MuJoCo (solid), predicted from the plan (dashed)", f"largest {SHARE}", "time, s")
    drawn = []
    for mode, colour in MODE_COLOURS.items():
        for values, line, width, words in (
            (errors.measured[mode], "-", 2.6, MODE_WORDS[mode]),
            (errors.predicted[mode], DASHED, 1.1, f"{MODE_WORDS[mode]}, predicted"),
        ):
            shown = positive(values)
            if np.isfinite(shown).any():  # the prediction is drawn on top
                alpha = 0.5 if line == "-" else 1.0
                axes.plot(errors.t, shown, color=colour, ls=line, lw=width, alpha=alpha, label=words)
                drawn.append(shown)
    axes.set_xlim(0.0, float(errors.t[-1]))
    if not drawn:
        say(axes, "no error above zero at any knot")
        return
    axes.set_yscale("log")
    values = np.concatenate(drawn)
    top = min(float(np.nanmax(values)), _HIGHEST)
    bottom = max(float(np.nanmin(values)), top / 10.0**_DECADES)
    top *= 2.0
    axes.set_ylim(bottom / max(3.0, (top / bottom) ** 0.35), top)  # room for the legend
    axes.legend(fontsize=7.5, loc="lower right", framealpha=0.85, edgecolor="none", ncols=2)


def _draw_order(axes: Axes, order: StepConvergence) -> None:
    """Draw the change of the end state from each step to half of it, and the slope of the integrator's order."""
    observed = "none to be seen" if order.observed is None else f"{order.observed:.3g}"
    with np.errstate(all="ignore"):  # at h = 0: Richardson's extrapolation, its grid convergence index
        words = (
            "step h, s, halved to h/2\n"
            f"observed order {observed}; end at h = 0 known to {order.end_uncertainty:.1e} bounds\n"
            f"J at h = 0: {order.extrapolated_cost:.6g} ± {order.cost_uncertainty:.1e}, plan {order.plan_cost:.6g}"
        )
    dress(axes, "Order of the open-loop replay as MuJoCo's step is halved", "change of the end / bound", words)
    axes.xaxis.label.set_fontsize(7.5)
    steps, changes = order.steps[: len(order.shares)], positive(order.shares)
    seen = np.isfinite(changes)
    if not seen.any():
        say(axes, "no change above zero")
        return
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(list(steps), [f"{step:.2g}" for step in steps])
    axes.minorticks_off()
    axes.plot(steps, changes, color=MODE_COLOURS["open-loop"], lw=1.3, marker="o", ms=4.5, label="measured", zorder=3)
    first = int(np.argmax(seen))
    line = changes[first] * (steps / steps[first]) ** order.nominal
    low, high = np.nanmin(changes), np.nanmax(changes)
    axes.plot(steps, line, color=SOFT, lw=1.1, ls=DASHED, label=f"order {order.nominal:g}, the integrator's", zorder=2)
    axes.set_ylim(0.2 * max(low, high / 10.0**_DECADES), 5.0 * high)
    axes.legend(fontsize=7.5, loc="upper left", framealpha=0.85, edgecolor="none")


def _draw_fan(axes: Axes, rollouts: RobustnessResult, mode: str, plan: Plan) -> None:
    """Draw percentiles over time of the coordinate with the largest deviation in this mode."""
    fan = drawable(rollouts.fans[mode].astype(float))
    reach = np.nan_to_num(np.abs(fan), nan=0.0).max(axis=(0, 1), initial=0.0)  # of each component
    worst = int(np.argmax(reach / ranges_of_motion(plan))) if reach.size else 0
    name, unit = coordinates_of(getattr(plan.problem, "dynamics", None))[worst]
    title = f"Monte Carlo, {MODE_WORDS[mode]}: the coordinate with the largest deviation"
    label = textwrap.fill(f"deviation of {name}{f', {unit}' if unit else ''}", _LABEL)
    dress(axes, title, label, "time, s")
    if fan.size == 0 or not np.isfinite(fan).any():
        say(axes, "every rollout diverged")
        return
    low, low_half, median, high_half, high = fan[:, :, worst]
    colour = MODE_COLOURS[mode]
    axes.fill_between(rollouts.t, low, high, color=colour, alpha=0.18, lw=0, label="90 % of rollouts")
    axes.fill_between(rollouts.t, low_half, high_half, color=colour, alpha=0.35, lw=0, label="50 %")
    axes.plot(rollouts.t, median, color=colour, lw=1.3, label="median")
    axes.axhline(0.0, color=INK, lw=0.6, zorder=1)
    if reach[worst] > _LINEAR:
        axes.set_yscale("symlog", linthresh=1.0)
    elif reach[worst] == 0.0:
        axes.set_ylim(-1.0, 1.0)
    bottom, top = axes.get_ylim()  # room for the legend
    axes.set_ylim(bottom, 20.0 * top if reach[worst] > _LINEAR else top + 0.15 * (top - bottom))
    axes.set_xlim(float(rollouts.t[0]), float(rollouts.t[-1]))
    axes.legend(fontsize=7.5, loc="upper left", framealpha=0.85, edgecolor="none", ncols=3)


def _draw_ends(axes: Axes, rollouts: RobustnessResult) -> None:
    """Draw a histogram of the end errors in each mode, and the tolerance."""
    title = f"Monte Carlo: end errors of {rollouts.done} rollouts in each mode"
    dress(axes, title, "rollouts", "end error / range of motion")
    ends = {mode: positive(errors) for mode, errors in rollouts.end_error.items()}
    found = np.concatenate([*ends.values(), [rollouts.tolerance], [1.0] if math.isnan(rollouts.tolerance) else []])
    found = found[np.isfinite(found)]
    low = max(float(found.min()), float(found.max()) / 10.0**_DECADES)
    bins = np.geomspace(0.8 * low, 1.25 * float(found.max()), _BINS + 1)
    for mode, errors in ends.items():
        exact = int(np.sum(rollouts.end_error[mode] == 0.0))
        shown = np.concatenate([np.clip(errors[np.isfinite(errors)], bins[0], bins[-1]), np.full(exact, bins[0])])
        rate, name = rollouts.rates[mode], (MODE_WORDS | {CLOCK: "with gains, by the clock"})[mode]
        lowest, highest = rate.interval
        words = (
            f"{name}: {100.0 * rate.value:.1f} % succeed ({rate.successes} of {rate.of}, "
            f"95 % interval {100.0 * lowest:.1f} to {100.0 * highest:.1f} %)"
        )
        exploded = rate.of - len(shown)
        words += f", {exploded} exploded" if exploded else ""
        colour = (MODE_COLOURS | {CLOCK: GREYS[1]})[mode]
        axes.hist(shown, bins=list(bins), color=colour, alpha=0.35, label=words)
        axes.hist(shown, bins=list(bins), histtype="step", color=colour, lw=1.2)
    if math.isfinite(rollouts.tolerance):
        axes.axvline(rollouts.tolerance, color=RED, lw=1.1, label=f"tolerance {rollouts.tolerance:g}")
    else:
        axes.plot([], [], " ", label=f"success: {rollouts.rule or 'by its own rule'}")
    axes.set_xscale("log")
    axes.locator_params(axis="y", integer=True)
    _, highest_bar = axes.get_ylim()
    axes.set_ylim(0.0, max(1.0, 1.35 * highest_bar if math.isfinite(highest_bar) else 1.0))  # room for the legend
    axes.legend(fontsize=7.0, loc="upper left", framealpha=0.85, edgecolor="none")


SHARE = "error / bound"
_SHARE_DECADES = 6  # decades below the largest share that are drawn; smaller ones pass anyway
_MAX_POINTS = 1500  # points of a curve
_ORIENTATION = "angle_error"  # drawn where there are errors of several units
_GROUND = re.compile(r"(.+)_path_((?:.+_)?error)_(open_loop|feedback)")


def draw_path_errors(axes: Axes, run: Replay) -> None:
    """The errors of a replay over time, of each unit the coordinate that is nearest to its bound."""
    sampling, jumps = run.sampling, has_contacts(run.plan)
    how = "" if sampling is None else f" at {sampling_words(sampling)}"
    words = MODE_WORDS["feedback" if run.feedback else "open-loop"]
    label = f"{SHARE}\n(dashed: not judged)" if jumps else SHARE
    dress(axes, f"Errors of the replay, {words}{how}", label, "time, s")
    _draw_shares(axes, run.plan, run.t, run.error, of_path=True)


def draw_hold(axes: Axes, held: RegulatedRun) -> None:
    """The deviations from the goal under a regulator."""
    dress(axes, "Deviations from the goal under its regulator", SHARE, "time, s")
    _draw_shares(axes, held.plan, held.t, held.deviation, of_path=False)


def _draw_shares(axes: Axes, plan: Plan, t: np.ndarray, errors: np.ndarray, of_path: bool) -> None:
    """Errors (K, ndx) over their bounds by unit; those of a path that are not judged are dashed."""
    every = slice(None, None, max(1, len(t) // _MAX_POINTS))
    assert plan.problem is not None  # it was proved
    shares, curves = np.abs(errors[every]) / path_error_bounds(plan), []
    for k, (_, unit, which, names) in enumerate(by_unit(plan.problem)):
        of_unit = np.where(np.isfinite(shares[:, which]), shares[:, which], np.inf)
        judged = not of_path or is_path_judged(plan, unit)
        name = names[int(np.argmax(of_unit.max(axis=0)))]
        words = f"{name}{f', {unit}' if unit else ''}"
        curves.append((positive(of_unit.max(axis=1)), judged, HUES[k % len(HUES)][1], words))
    _draw_curves(axes, t[every], curves)


def _draw_curves(axes: Axes, t: np.ndarray, curves: list[tuple[np.ndarray, bool, str, str]]) -> None:
    """Curves on a log scale, of _SHARE_DECADES at most, with room for a legend below them."""
    axes.set_xlim(float(t[0]), float(t[-1]))
    found = np.concatenate([values for values, *_ in curves])
    found = found[np.isfinite(found)]
    if not found.size:
        say(axes, "no error above zero")
        return
    top = min(max(float(found.max()), 1.0), _HIGHEST)
    bottom = max(float(found.min()), top / 10.0**_SHARE_DECADES)
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


def draw_grounds(axes: Axes, section: Section) -> None:
    """Bars of the largest path error on each ground in both modes, beside them the peak forces."""
    values = {one.name: one for one in section.measured}
    found = [match for name in values if (match := _GROUND.fullmatch(name))]
    kinds = [match[2] for match in found]
    kind = _ORIENTATION if _ORIENTATION in kinds else next(iter(kinds), "")
    found = [match for match in found if match[2] == kind]
    grounds = list(dict.fromkeys(match[1] for match in found))
    unit = values[found[0][0]].unit if found else ""
    words = kind.replace("_", " ").replace("error", "").strip()
    dress(axes, "Contact sensitivity: shown, not judged", "", f"largest error of a path, {words} {unit}".rstrip())
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
