"""Additional pictures of a built-in problem: charts, stick figures, paths. Data only; planner.view.plots draws them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True)
class Stick:
    """Points joined by a line: a leg, for example."""

    points: tuple[int, ...]  # Indices of the points, in order
    label: str = ""  # For the legend; "" for none
    hue: int | None = None  # Index in the hues of all plots; None for ink


@dataclass(frozen=True, eq=False)
class PoseSequence:
    """A motion of points."""

    label: str  # For the legend
    points: np.ndarray  # (K, P, 3) m, at equal times; see view.plots.projection
    dashed: bool = False  # Drawn thin and dashed: a reference of the others


class Trace(NamedTuple):
    """Path of a point."""

    label: str  # For the legend
    points: np.ndarray  # (K, 3) m
    dashed: bool = False  # Drawn dashed and grey: a reference of the others


class CurveData(NamedTuple):
    """One quantity over time."""

    label: str  # For the legend; the same label in another chart has the same colour there
    values: np.ndarray  # (K,) at the times of all charts, or at t; gaps where they are not finite
    # Drawn dashed, e.g. the plan against its replay, in the colour of the solid curve with label `of` in the chart.
    dashed: bool = False
    of: str = ""  # See dashed
    t: np.ndarray | None = None  # (K,) own times; None for those of all charts


class Band(NamedTuple):
    """The normal range of a quantity in people: a mean, drawn dashed, and the spread about it."""

    label: str  # For the legend
    mean: np.ndarray  # (K,)
    spread: np.ndarray | float  # (K,) or a number, to both sides: a standard deviation, for example


@dataclass(frozen=True, eq=False)
class Chart:
    """One panel."""

    title: str  # Above it
    ylabel: str  # With the unit
    curves: Sequence[CurveData] = ()  # The lines of the panel
    band: Band | None = None  # Behind them, or None
    # (start, end) of times that are shaded: stance, for example.
    spans: Sequence[tuple[float, float]] = field(default=())


@dataclass(frozen=True, eq=False)
class StickFigures:
    """A picture of poses, see view.plots.case_pictures."""

    caption: str  # Under it, on a page
    motions: Sequence[PoseSequence]  # Over the same time
    sticks: Sequence[Stick]  # Lines that join the points
    times: tuple[str, ...]  # One for each pose, written under it
    ground: float | None = None  # m, height of a line under the feet; None for none
    title: str = ""  # Above it all


@dataclass(frozen=True, eq=False)
class Charts:
    """Panels, see view.plots.charts."""

    caption: str  # Under them, on a page
    t: np.ndarray  # (K,) of all curves without times of their own
    charts: Sequence[Chart]  # The panels
    xlabel: str = "time, s"  # Of t
    title: str = ""  # Above them all
    span_label: str = ""  # Name of the shaded times


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths in space from the side, from the front and from above, see view.plots.paths."""

    caption: str  # Under them, on a page
    traces: Sequence[Trace]  # The paths
    title: str = ""  # Above it all


@dataclass(frozen=True, eq=False)
class BoundedPanel:
    """Quantities over time with their bounds: one panel of plots.png, see view.plots.time_series."""

    title: str  # Above it
    ylabel: str  # With the unit
    t: np.ndarray  # (K,) s
    names: tuple[str, ...]  # (R,) of the quantities
    motions: tuple[np.ndarray, ...]  # (K, R) each: of the plan, then of its replays; gaps where they are not finite
    lower: np.ndarray  # (K, R), not finite where there is none
    upper: np.ndarray  # (K, R), the same
    decades: bool = False  # Whether to use a log scale if values span decades


CasePicture = StickFigures | Charts | Paths
