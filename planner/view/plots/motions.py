"""Curves of a plan and its replays: their lines, how much of them is seen, and their names."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.proof.replays.replaying import Replay
from planner.view.plots.style import HUES, drawable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BESIDE = 3  # curves, above which their names stand beside the panel and not in it
ASTRAY = 1.5  # how far a replay that runs away may widen an axis, in parts of the range of the other curves
_LONGEST = 22  # characters of a line of a name beside a panel


def line_of(replay: Replay, hue: tuple[str, str, str]) -> dict[str, Any]:
    """Style of a replay's line."""
    return {"color": hue[1], "lw": 2.2, "zorder": 2} if replay.feedback else {"color": hue[2], "lw": 4.0, "zorder": 1.9}


def range_of(values: Sequence[np.ndarray]) -> tuple[float, float]:
    """Least and largest value that can be drawn; (0, 0) if there is none."""
    shown = np.concatenate([drawable(part).ravel() for part in values] or [np.empty(0)])
    shown = shown[np.isfinite(shown)]
    return (float(shown.min()), float(shown.max())) if shown.size else (0.0, 0.0)


def until_astray(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """The values until they first leave the view: later ones of a replay that ran away would hide the others."""
    shown = drawable(values)
    outside = np.flatnonzero((shown < limits[0]) | (shown > limits[1]))
    if len(outside):
        shown[outside[0] + 1 :] = np.nan
    return shown


def name_curves(axes: Axes, labels: Sequence[str], beside: float, *, most: int = BESIDE) -> None:
    """Draw a legend by colour: each curve's plan and replay share a hue. More than `most` names stand at `beside`."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=dark, lw=2.0) for (dark, _, _), _ in zip(cycle(HUES), labels, strict=False)]
    style: dict[str, Any] = {"framealpha": 0.85, "edgecolor": "none", "borderpad": 0.3, "handlelength": 1.4}
    if len(labels) > most:
        names = [textwrap.fill(label, _LONGEST) for label in labels]
        legend = axes.legend(handles, names, fontsize=7, loc="center left", bbox_to_anchor=(beside, 0.5), **style)
    else:
        legend = axes.legend(handles, labels, fontsize=8, loc="upper left", ncols=len(labels), **style)
    legend.set_zorder(5)
