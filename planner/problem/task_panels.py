"""Panels of goal errors and constrained quantities over time, with their bounds. Data for pictures.

A residual may name its components by `names`, and its function may have `shown(xs, us, n) -> (K, R)`, values for
pictures in place of the solver's (see planner.problem.residual).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile
from typing import Any

import numpy as np

from planner.problem.constraints.constraint_stack import StackEntry
from planner.problem.goals import between
from planner.problem.pictures import BoundedPanel
from planner.problem.problem import Problem

MAX_CURVES = 8  # of a panel
_GOALS = {"m": "distance", "rad": "angle", "m/s": "speed"}
StatesControls = tuple[np.ndarray, np.ndarray]  # states (N+1, nx) and controls (N, nu)


def task_panels(problem: Problem, t: np.ndarray, motions: Sequence[StatesControls]) -> list[BoundedPanel]:
    """Panels of goals and constraints; none for a problem without either.

    Args:
        problem: Of the plan.
        t: (N+1,) s, the knots.
        motions: States and controls of the plan, then of its replays, at the knots.
    """
    return [*_of_goals(problem, t, motions), *_of_constraints(problem, t, motions)]


def _of_goals(problem: Problem, t: np.ndarray, motions: Sequence[StatesControls]) -> list[BoundedPanel]:
    """Panels by unit: the error of each goal of a task over time, and its tolerance at the goal's times."""
    units: dict[str, dict[bytes, tuple[list[str], np.ndarray, np.ndarray]]] = {}
    for one in problem.goal_specs or ():
        if one.tolerance is None:
            continue
        asked = np.array([problem.N] if one.times is None else np.round(np.array(one.times) / problem.dynamics.dt), int)
        values, upper = np.full((len(motions), len(t)), np.nan), np.full(len(t), np.inf)
        for (xs, _), curve in zip(motions, values, strict=True):
            if len(asked) == 1:
                curve[:] = one.error(xs)
            else:  # of a path: the largest that is nearest to each knot
                np.fmax.at(curve, asked, one.error(between(t, xs, np.array(one.times))))
        upper[asked] = one.tolerance
        # Goals with equal errors at all times share a curve, e.g. the speed of a frame that stops twice.
        names, _, bound = units.setdefault(one.unit, {}).setdefault(values[0].tobytes(), ([], values, upper))
        names.append(one.name)
        bound[:] = np.minimum(bound, upper)
    panels = []
    for unit, found in units.items():
        curves = list(found.values())
        for first in range(0, len(curves), MAX_CURVES):
            few = curves[first : first + MAX_CURVES]
            what, names = _shared([_joined(names) for names, _, _ in few])
            upper = np.stack([bound for _, _, bound in few], axis=1)
            displacement = np.stack([values for _, values, _ in few], axis=2)
            title = f"Goals: {what or _GOALS.get(unit, 'miss')}"
            panels.append(
                BoundedPanel(
                    title,
                    f"miss, {unit}",
                    t,
                    names,
                    tuple(displacement),
                    np.full_like(upper, -np.inf),
                    upper,
                    decades=True,
                )
            )
    return panels


def _of_constraints(problem: Problem, t: np.ndarray, motions: Sequence[StatesControls]) -> list[BoundedPanel]:
    """Panels of the components of each constraint; constraints of one component and equal bounds share a panel."""
    rows = None if problem.trajectory_constraints is None else problem.trajectory_constraints.rows
    alike: dict[Any, list[tuple[StackEntry, np.ndarray, np.ndarray]]] = {}
    for k, part in enumerate(() if rows is None else rows.parts):
        if part.at_end:  # values at the end of a stage repeat those at the start of the next, except for the control
            continue
        assert rows is not None
        lower, upper = (
            side[:, part.columns] / rows.scale[part.columns] for side in (rows.specified_lower, rows.specified_upper)
        )
        if part.function.of_controls:
            lower[-1], upper[-1] = lower[-2], upper[-2]
        key = (part.constraint.unit, lower.tobytes(), upper.tobytes()) if part.function.rows == 1 else k
        alike.setdefault(key, []).append((part, lower, upper))
    panels = []
    for found in alike.values():
        for first in range(0, len(found), MAX_CURVES):
            few = found[first : first + MAX_CURVES]
            values = np.concatenate([[_values(part, *motion) for motion in motions] for part, _, _ in few], axis=2)
            lower, upper = (np.concatenate(side, axis=1) for side in list(zip(*few, strict=True))[1:])
            names = tuple(name for part, _, _ in few for name in _names(part))
            what = few[0][0].constraint.name if len(few) == 1 else _shared(names)[0]
            names = names if len(few) == 1 or not what else _shared(names)[1]
            panels.append(_nearest(few[0][0].constraint.unit, what, t, names, values, lower, upper))
    return panels


def _values(part: StackEntry, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
    """(N+1, R) values of a constraint; at the end with the last control. NaN where states or controls diverged."""
    n = np.arange(len(xs))
    last = np.minimum(n, len(us) - 1)
    measure, u = part.function, us[last]
    found = np.full((len(xs), measure.rows), np.nan)
    known = np.flatnonzero(np.isfinite(xs).all(axis=1) & np.isfinite(u).all(axis=1))
    values = getattr(measure, "shown", measure.values)
    if len(known):
        found[known] = values(xs[known], u[known], (last if measure.of_controls else n)[known])
    return found


def _nearest(
    unit: str, what: str, t: np.ndarray, names: tuple[str, ...], values: np.ndarray, lower: np.ndarray,
    upper: np.ndarray,
) -> BoundedPanel:  # fmt: skip
    """The panel of values (motions, K, R): at most MAX_CURVES components, by smallest margin in the plan."""
    margin = np.minimum(np.nan_to_num(values[0], nan=np.inf) - lower, upper - np.nan_to_num(values[0], nan=-np.inf))
    margin = np.where(np.isfinite(margin), margin, np.inf).min(axis=0)
    asked = np.flatnonzero((np.isfinite(lower) | np.isfinite(upper)).any(axis=0))
    shown = np.sort(asked[np.argsort(margin[asked], kind="stable")[:MAX_CURVES]])
    title = f"Constraint: {what}" if what else "Constraints"
    if len(shown) < len(asked):
        title += f", the {MAX_CURVES} nearest to their bound of {len(asked)}"
    lower, upper, values = lower[:, shown], upper[:, shown], values[..., shown]
    keeps_clear = not np.isfinite(upper).any() and bool(np.all(lower[np.isfinite(lower)] > 0.0))
    return BoundedPanel(
        title, unit or "h", t, tuple(names[k] for k in shown), tuple(values), lower, upper, decades=keeps_clear
    )


def _names(part: StackEntry) -> tuple[str, ...]:
    """(R,) names of a constraint's components."""
    own, R = tuple(getattr(part.constraint.of, "names", ())), part.function.rows
    if R == 1:
        return (part.constraint.name,)
    return own if len(own) == R else tuple(f"row {r}" for r in range(1, R + 1))


def _joined(names: list[str]) -> str:
    """The common name of several goals: "speed of hand" for those at 1 s and at 2 s."""
    return names[0] if len(names) == 1 else _shared(names)[0]


def _shared(names: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """The common first words of all names, and the remainder of each: "position of hand" and "at 1 s"."""
    if len(names) == 1:
        return names[0], tuple(names)
    common = _beginning(names)
    rest = [name.split()[len(common) :] for name in names]
    while common and common[-1] in ("of", "at"):
        if common.pop() == "at":
            rest = [["at", *words] for words in rest]
    return " ".join(common), tuple(" ".join(words) or "at the end" for words in rest)


def _beginning(names: Sequence[str]) -> list[str]:
    """The common first words of all names."""
    columns = zip(*(name.split() for name in names), strict=False)
    return [words[0] for words in takewhile(lambda words: len(set(words)) == 1, columns)]
