"""Pictures of a case beyond those of every plan: charts, stick figures and paths. Data only, as an Appearance is.

A case says what is in them, planner.view.plots draws them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True)
class Stick:
    """Points joined by a line: a leg, for example.

    Attributes:
        points: Indices of the points, in order.
        label: For the legend; "" for none.
        hue: Which of the hues of all plots it has; None for ink.
    """

    points: tuple[int, ...]
    label: str = ""
    hue: int | None = None


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of points.

    Attributes:
        label: For the legend.
        points: (K, P, 3) m, at equal times; see projection.frame_points.
        dashed: Drawn thin and dashed: what others are held to.
    """

    label: str
    points: np.ndarray
    dashed: bool = False


class Trace(NamedTuple):
    """Where a point goes.

    Attributes:
        label: For the legend.
        points: (K, 3) m.
        dashed: Drawn dashed and grey: what others are held to.
    """

    label: str
    points: np.ndarray
    dashed: bool = False


class Curve(NamedTuple):
    """One quantity over time.

    Attributes:
        label: For the legend; the same label in another chart has the same colour there.
        values: (K,) at the times of all charts, or at t; gaps where they are not finite.
        dashed: Drawn dashed: what was planned beside what happened, for example. It shares the colour of a solid curve
            of the same chart that has `of` for a label.
        of: See dashed.
        t: (K,) times of its own.
    """

    label: str
    values: np.ndarray
    dashed: bool = False
    of: str = ""
    t: np.ndarray | None = None


class Band(NamedTuple):
    """What is normal: a mean, dashed, and how far people are from it.

    Attributes:
        label: For the legend.
        mean: (K,).
        spread: (K,) or a number, to both sides: a standard deviation, for example.
    """

    label: str
    mean: np.ndarray
    spread: np.ndarray | float


@dataclass(frozen=True, eq=False)
class Chart:
    """One panel.

    Attributes:
        title: Above it.
        ylabel: With the unit.
        curves: What is drawn.
        band: Behind them, or None.
        spans: (start, end) of times that are shaded: stance, for example.
    """

    title: str
    ylabel: str
    curves: Sequence[Curve] = ()
    band: Band | None = None
    spans: Sequence[tuple[float, float]] = field(default=())


@dataclass(frozen=True, eq=False)
class StickFigures:
    """A picture of poses, see plots.draw_stick_figures().

    Attributes:
        caption: Under it, on a page.
        motions: Over the same time.
        sticks: What joins the points.
        times: What is written under each pose, which are as many.
        ground: m, height of a line under the feet; None for none.
        title: Above it all.
    """

    caption: str
    motions: Sequence[Motion]
    sticks: Sequence[Stick]
    times: tuple[str, ...]
    ground: float | None = None
    title: str = ""


@dataclass(frozen=True, eq=False)
class Charts:
    """Panels, see plots.draw_charts().

    Attributes:
        caption: Under them, on a page.
        t: (K,) of all curves without times of their own.
        charts: The panels.
        xlabel: Of t.
        title: Above them all.
        span_label: What shaded times are.
    """

    caption: str
    t: np.ndarray
    charts: Sequence[Chart]
    xlabel: str = "time (s)"
    title: str = ""
    span_label: str = ""


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths in space from the side, from the front and from above, see plots.draw_paths().

    Attributes:
        caption: Under them, on a page.
        traces: What is drawn.
        title: Above it all.
    """

    caption: str
    traces: Sequence[Trace]
    title: str = ""


CasePicture = StickFigures | Charts | Paths
