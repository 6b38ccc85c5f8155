"""What is drawn of a plan and its replays over time: panels of goals, states and controls, as plain arrays.

plots.png and the interactive curves of the page are made of these.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from planner.model.coordinates import Coordinate, coordinates_of
from planner.problem.appearance import Panel
from planner.problem.default_appearance import appearance_of, small_multiples
from planner.problem.pictures import BoundedPanel
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.task_panels import task_panels
from planner.proof.replays.replaying import Replay

if TYPE_CHECKING:
    from planner.proof import Proof


@dataclass(frozen=True)
class TimeSeries:
    """One quantity over time: (t, values) of the plan and of each replay."""

    label: str
    plan: tuple[np.ndarray, np.ndarray]
    replays: tuple[tuple[np.ndarray, np.ndarray], ...]
    held: bool  # constant over a stage: drawn as steps
    index: int  # of the state or control


def replays_of(shown: Proof | Replay | None) -> list[Replay]:
    """The replays to draw, the widest line first."""
    if shown is None:
        return []
    return [shown] if isinstance(shown, Replay) else sorted(shown.replays.values(), key=lambda replay: replay.feedback)


def tasks_of(plan: Plan, replays: list[Replay]) -> list[BoundedPanel]:
    """Goals and constraints over time, at the knots; none for a problem without."""
    if not isinstance(plan.problem, Problem):
        return []
    motions = [(plan.xs, plan.us)]
    for replay in replays:
        us = replay.stage_controls if replay.ctrl.shape[1] == plan.us.shape[1] else plan.us
        motions.append((replay.xs[:: replay.substeps], us))
    return task_panels(plan.problem, plan.t, motions)


def panels_of(plan: Plan) -> tuple[Panel, ...]:
    """The panels that the plan's appearance lists; for a plan without any, its states by unit and its controls."""
    if own := appearance_of(plan.problem).plots:
        return own
    nx, nu = plan.xs.shape[1], plan.us.shape[1]
    known = coordinates_of(plan.problem.dynamics) if plan.problem is not None else ()
    states = known if len(known) == nx else tuple(Coordinate(f"x[{index}]", "") for index in range(nx))
    panels = []
    for unit in dict.fromkeys(one.unit for one in states):
        of_unit = [(index, one.name) for index, one in enumerate(states) if one.unit == unit]
        for title, curves in small_multiples(f"States, {unit}" if unit else "States", of_unit):
            panels.append(Panel(title, unit or "x", states=curves))
    inputs = small_multiples("Controls", [(index, f"u[{index}]") for index in range(nu)])
    return (*panels, *(Panel(title, "u", controls=curves) for title, curves in inputs))


def curves_of(panel: Panel, plan: Plan, replays: list[Replay]) -> list[TimeSeries]:
    """The curves of a panel: states first."""
    curves = []
    for index, label in panel.states:
        planned = (replays[0].t, replays[0].plan_xs[:, index]) if replays else (plan.t, plan.xs[:, index])
        simulated = tuple((replay.t, replay.xs[:, index]) for replay in replays)
        curves.append(TimeSeries(label, planned, simulated, held=False, index=index))
    for index, label in panel.controls:
        simulated = tuple((replay.t, to_the_end(replay.ctrl[:, index])) for replay in replays)
        curves.append(TimeSeries(label, (plan.t, to_the_end(plan.us[:, index])), simulated, held=True, index=index))
    return curves


def to_the_end(us: np.ndarray) -> np.ndarray:
    """Controls (N,) with the last one repeated, so that its stage is drawn too: (N+1,)."""
    return np.append(us, us[-1:])


def unit_of(ylabel: str) -> str:
    """The unit in the label of an axis, "height, in" or "rate (rad/s)"; "" where there is none."""
    found = re.search(r"[(\[,]\s*([^()\[\],]+?)\s*[)\]]?$", ylabel)
    return found[1] if found else ""
