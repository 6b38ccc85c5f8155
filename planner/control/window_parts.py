"""Parts of a RecedingHorizonProblem: the cost terms during and after the task, and the limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace

import numpy as np

from planner.base.errors import PlannerError
from planner.problem.constraints.clearance import PairClearanceFunction
from planner.problem.constraints.constraint_stack import ConstraintStack
from planner.problem.costs.least_squares import LeastSquares
from planner.problem.costs.residuals.arrays import ResidualArrays
from planner.problem.costs.residuals.cost import ResidualCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.goals import terms_of
from planner.problem.limits import Limits
from planner.problem.problem import Problem

SETTLING_TIME = 0.5  # s, upper limit of sqrt(velocity weight / position weight) after the end of the task
AIMED = "position of "
"""Name prefix of the frame goals that controller.goal can change (planner.problem.costs.frame)."""


def parts_of(problem: Problem) -> tuple[TrackingCost, list[ResidualCost], list[LeastSquares]]:
    """The TrackingCost of a problem, its compiled costs of residuals and those in Python; an error for other terms."""
    terms = terms_of(problem.cost)
    tracking = [term for term in terms if type(term) is TrackingCost]
    residuals = [term for term in terms if isinstance(term, ResidualCost)]
    python = [term for term in terms if isinstance(term, LeastSquares)]
    if len(tracking) != 1 or len(terms) != 1 + len(residuals) + len(python):
        others = sorted({type(term).__name__ for term in terms if type(term) not in (TrackingCost,)})
        raise PlannerError(
            f"the cost has {len(tracking)} TrackingCost and {', '.join(others) or 'nothing else'}, expected one "
            "TrackingCost, alone or with FrameCosts, PenaltyCosts and LeastSquares: a controller asks it for weights "
            "past its end."
        )
    return tracking[0], residuals, python


class SlidingLeastSquares:
    """A LeastSquares over the task and H stages after it, of which windows are parts; there weighed as `lengthened`."""

    def __init__(self, cost: LeastSquares, H: int, dt: float, keeps: bool) -> None:
        N, self._cost, self._H, self._keeps = cost.N, cost, H, keeps
        self._N, at = N, np.minimum(np.arange(N + H + 1), N)
        weight, off = cost.weight[at], (cost.weight[at] == 0.0) & (cost.weight[-1] > 0.0)
        weight[N + 1 - cost.of_controls :] = keeps * (cost.weight[N - 1] + dt * cost.weight[N])
        self._tables = weight, *(np.where(off, side[-1], side[at]) for side in (cost.lower, cost.upper))
        self.window = self.at(0)

    def at(self, stage: int) -> LeastSquares:
        """The cost of the window that begins at a stage."""
        weight, lower, upper = (table[stage : stage + self._H + 1].copy() for table in self._tables)
        if self._cost.of_controls or self._keeps or stage + self._H <= self._N:
            weight[-1] = self._cost.weight[-1]
        return self._cost.with_tables(weight, lower, upper)

    def slide(self, stage: int) -> None:
        """Move the window to a stage."""
        now = self.at(stage)
        self.window.weight, self.window.lower, self.window.upper = now.weight, now.lower, now.upper


def lengthened(measures: ResidualArrays, H: int, dt: float, keeps: bool) -> ResidualArrays:
    """Residuals of the task and H stages after it, there with weights of stage N-1 plus dt times final ones, or 0."""
    N = measures.weight.shape[1] - 1
    longer = measures.along(np.minimum(np.arange(N + H + 1), N))
    weight, bound = np.array(longer.weight), np.array(longer.bound)
    weight[:, N + 1 :] = keeps * (measures.weight[:, N - 1] + dt * measures.weight[:, N])[:, None]
    # A window that ends before the task has the final goal at its end, whose components have weight zero there.
    off = (longer.weight == 0.0) & (measures.weight[:, -1:] > 0.0)
    bound = np.where(off, measures.bound[:, -1:], bound)
    return replace(longer, weight=weight, bound=bound)


def at_stages(measures: ResidualArrays | None, stages: slice) -> ResidualArrays:
    """The residuals at a slice of the stages."""
    assert measures is not None
    part = measures.along(stages)
    return ResidualArrays(**{f.name: np.array(getattr(part, f.name)) for f in fields(ResidualArrays)})


def frame_rows(residuals: list[ResidualCost], N: int) -> dict[str, np.ndarray]:
    """Indices (3,) of each frame's position components in the joined residuals, by the frame's name."""
    found, first = dict[str, np.ndarray](), 0
    for cost in residuals:
        for name, rows in cost.goal_rows().items():
            if name.startswith(AIMED):
                frame = name.removeprefix(AIMED)
                found[frame] = np.concatenate([found.get(frame, np.zeros(0, dtype=int)), first + rows])
        first += len(cost.residual_arrays_for(N).weight)
    return {frame: rows for frame, rows in found.items() if len(rows) == 3}


def first_stages(limits: Limits | None, H: int, N: int) -> Limits | None:
    """Limits of the window at stage 0: control bounds (N, nu) per stage become those of its H stages."""
    if limits is None or isinstance(limits.control, (str, Mapping)) or not isinstance(limits.control, (tuple, list)):
        return limits
    at = np.minimum(np.arange(H), N - 1)
    sides = [np.asarray(side, dtype=float)[at] if np.ndim(side) == 2 else side for side in limits.control]
    return replace(limits, control=tuple(sides))


def holding_stage_weights(Q: np.ndarray) -> np.ndarray:
    """Stage weights (ndx, ndx) that regulate a goal, from weights Q (ndx, ndx) for the end of the task.

    With position weight q and velocity weight v, a robot with strong motors converges as exp(-t sqrt(q / v)). So a
    velocity weight is at most q SETTLING_TIME^2.
    """
    ndx = len(Q)
    q, v = np.split(np.diag(Q)[: ndx // 2 * 2], 2)
    factor, both = np.ones(ndx), (q > 0.0) & (v > 0.0)
    factor[len(q) : 2 * len(q)][both] = np.minimum(1.0, SETTLING_TIME * np.sqrt(q[both] / v[both]))
    return Q * factor[:, None] * factor


def updated_rows(problem: Problem) -> tuple[ConstraintStack | None, np.ndarray]:
    """The constraints with updated multipliers, and their columns among ranges and constraints, ranges included."""
    kept = problem.trajectory_constraints
    if kept is None:
        return None, np.zeros(0, dtype=int)
    ranges = 0 if problem.ranges is None else len(problem.ranges.component)
    columns = [np.arange(ranges)]
    if kept.rows is None:
        return None, columns[0]
    rows, which = kept.rows.subset(
        [part for part in kept.rows.parts if not isinstance(part.function, PairClearanceFunction)]
    )
    return (rows if rows.parts else None), np.concatenate([*columns, ranges + which])
