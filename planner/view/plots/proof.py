"""The figure of a proof: errors of both replays and their growth, order, Monte Carlo, hold and other grounds.

Panels that do not apply are left out. Errors are shares of what passes: 1 is the bound, whatever the unit.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from planner.model.coordinates import coordinates_of
from planner.problem.plan import Plan
from planner.proof import Proof
from planner.proof.error_propagation import ErrorPropagation
from planner.proof.error_scales import ranges_of_motion
from planner.proof.robustness.perturbed import RobustnessResult
from planner.proof.step_convergence import StepConvergence
from planner.view.plots.proof_paths import SHARE, draw_grounds, draw_hold, draw_path_errors
from planner.view.plots.style import (
    DASHED,
    INK,
    MODE_COLOURS,
    MODE_WORDS,
    RED,
    SOFT,
    drawable,
    dress,
    panels_of,
    positive,
    say,
    title_above,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DECADES = 16  # decades below the largest error that are drawn; smaller errors are rounding
_HIGHEST = 1e6  # largest error that is drawn; beyond it a replay has long left the plan
_BINS = 36
_LABEL = 36  # characters beside an axis
_LINEAR = 1e3  # a fan with larger deviations is drawn on a symmetric log scale


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
            if np.isfinite(shown).any():  # the prediction is seen on top of what it predicts
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
    title = f"Monte Carlo, {MODE_WORDS[mode]}: the coordinate that strays farthest"
    label = textwrap.fill(f"deviation of {name}{f', {unit}' if unit else ''}", _LABEL)
    dress(axes, title, label, "time, s")
    if fan.size == 0 or not np.isfinite(fan).any():
        say(axes, "no rollout is left")
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
        rate = rollouts.rates[mode]
        lowest, highest = rate.interval
        words = (
            f"{MODE_WORDS[mode]}: {100.0 * rate.value:.1f} % succeed ({rate.successes} of {rate.of}, "
            f"95 % interval {100.0 * lowest:.1f} to {100.0 * highest:.1f} %)"
        )
        exploded = rate.of - len(shown)
        words += f", {exploded} exploded" if exploded else ""
        colour = MODE_COLOURS[mode]
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
