"""RecedingHorizonProblem: a problem over the next H stages, whose weights and references shift with time (MPC).

At stage s of the task the window has the stages s ... s+H-1 of the problem, and at its end the problem's final weight.
After the end of the task the goal remains: the stage weight is that of the last stage plus dt times the final weight,
with velocity weights limited so that the robot reaches equilibrium (window_parts.holding_stage_weights). The reference
control is then the equilibrium control of the goal.

The tables cover the whole task and one window after it. To slide the window, an engine reads them from another stage
on, or copies a slice of them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.arguments import choice
from planner.control.window_parts import (
    SlidingLeastSquares,
    at_stages,
    first_stages,
    frame_rows,
    holding_stage_weights,
    lengthened,
    parts_of,
    updated_rows,
)
from planner.dynamics import ResidualDynamics
from planner.kernels.lq.workspace import W
from planner.model.space import space_of
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.problem.costs.least_squares import ResidualCost
from planner.problem.costs.residual_arrays import ResidualArrays, joined
from planner.problem.costs.terms import Cost, SumCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.augmented_lagrangian import shifted_bounds
from planner.solvers.engine import CompiledEngine, NumpyEngine, acquire_engine


class RecedingHorizonProblem:
    """The window of a problem and the engine that solves it.

    Args:
        problem: With a TrackingCost and costs of residuals: frames and penalties, as tasks and problem files have them,
            and LeastSquares.
        H: Number of stages of the window.
        keeps: Whether the goal remains after the end of the task. False where no control makes it an equilibrium (apex
            of a hop, end of a stride): the final weight then acts only at the end of the task, later stages have only
            control weights.

    Attributes:
        problem: The problem of the window, H stages from the start.
        engine: Solves it; made once.
        keeps: See the argument.
        stage: Index in the task of the window's first stage.

    Raises:
        PlannerError: A cost with other terms than these.
    """

    def __init__(self, problem: Problem, H: int, keeps: bool = True) -> None:
        self.H, self.N, self._space = H, problem.N, space_of(problem.dynamics)
        tracking, residuals, python = parts_of(problem)
        N, self._at = self.N, np.minimum(np.arange(self.N + H + 1), self.N)
        dt, before = problem.dynamics.dt, np.minimum(self._at, N - 1)
        past = (np.arange(N + H + 1) > N)[:, None, None]  # knot N itself has its weight of the plan
        self.x_ref, self.u_ref = tracking.x_ref[self._at].copy(), tracking.u_ref[before].copy()
        resting = keeps * holding_stage_weights((tracking.Q[N - 1] if N > 1 else 0.0) + dt * tracking.Q[N])
        self._Q, self._R = np.where(past, resting, tracking.Q[self._at]), tracking.R[before]
        self._final, self._last = tracking.Q[N], keeps * tracking.Q[N - 1]
        self.keeps = keeps
        self._own_x_ref = self.x_ref.copy()
        self._to_goal = np.all(self.x_ref == self.x_ref[-1], axis=1)
        self._end_rows = joined([cost.residual_arrays_for(N) for cost in residuals]) if residuals else None
        self._residuals = None if self._end_rows is None else lengthened(self._end_rows, H, dt, keeps)
        self._frames, self._points = frame_rows(residuals, N), dict[str, np.ndarray]()
        Q = np.concatenate([self._Q[:H], self._final[None]])
        Q[0] = self._Q.sum(axis=0)  # sparsity of the kernels' tables: entries nonzero at any stage
        cost: Any = TrackingCost(Q, self._R[:H], self.x_ref[: H + 1], self.u_ref[:H], self._space)
        if residuals:
            first = at_stages(self._residuals, slice(0, H + 1))
            cost = SumCost(cost, *[_Measured(residuals, first)])
        self._python = [SlidingLeastSquares(one, H, dt, keeps) for one in python]
        cost = SumCost(cost, *(one.window for one in self._python)) if python else cost
        limits = first_stages(problem.limits, H, N)
        self.problem = replace(
            problem, cost=cost, horizon=H, us=np.zeros((H, problem.dynamics.nu)), limits=limits, objective=None,
            recipe=None, goal_specs=None, stances=(), requirements=None, periodic=None, tolerance="soft",
        )  # fmt: skip
        self.engine, self._residual_costs = acquire_engine(self.problem), residuals
        self._hinges: BoundPenalties | None = None
        self._rows, self._columns = updated_rows(self.problem)
        self._kept = np.zeros((0, 0)), np.zeros((0, 0))  # bounds without multiplier shifts, as in _hinges
        self._lay_out(problem)
        self.stage, self._passed, self._stale = -1, -1, True

    def _lay_out(self, problem: Problem) -> None:
        """Build the tables over the task and one window after it, of which the engine reads slices."""
        engine = self.engine
        if not isinstance(engine, CompiledEngine):
            return
        arrays = self._arrays = engine.cost_arrays()
        rows = {
            "x_ref": self.x_ref, "u_ref": self.u_ref,
            "stage_value": self._Q[:, arrays["stage_row"], arrays["stage_column"]],
            "control_value": self._R[:, arrays["control_row"], arrays["control_column"]],
        }  # fmt: skip
        self._tables = {name: np.ascontiguousarray(values) for name, values in rows.items()}
        self.x_ref, self.u_ref = self._tables["x_ref"], self._tables["u_ref"]
        self._entries = np.array([getattr(W, name) for name in rows])
        begins, strides = np.array([(values.ctypes.data, values.strides[0]) for values in self._tables.values()]).T
        self._addresses = begins + np.arange(self.N + 1)[:, None] * strides  # (N+1, tables) of a stage's rows
        at_end = arrays["final_row"], arrays["final_column"]
        self._values_at_end, self._ends = [Q[at_end] for Q in (self._last, self._final)], -1
        self._own_bounds: list[tuple[np.ndarray, np.ndarray]] = []
        if problem.bounds is not None:
            before = np.minimum(self._at, self.N - 1)
            for side, names in (("lower", ("lower", "range_lower")), ("upper", ("upper", "range_upper"))):
                values = getattr(problem.bounds, side)[before]
                if not np.all(values == values[0]):
                    self._own_bounds += [(arrays[name], values) for name in names]
        self._table = engine.residuals
        self._source = None
        if self._residuals is not None and isinstance(problem.dynamics, ResidualDynamics):
            self._source = problem.dynamics.residuals(self._residuals)

    def set_penalties(self, plan: Plan, kept: Any) -> None:
        """Take the penalties of ranges and constraints from a plan of the whole task; unshifted bounds after its end.

        Args:
            plan: Of the problem; with `bound_penalties`, or None for zero weights.
            kept: The problem's trajectory_constraints, or None.
        """
        if kept is None:
            return
        weight = np.zeros_like(kept.lower) if plan.bound_penalties is None else plan.bound_penalties.weight
        lower, upper = (kept.lower, kept.upper) if plan.bound_penalties is None else plan.bound_penalties[:2]
        most = np.tile(weight.max(axis=0), (len(self._at), 1))
        past = (self._at == self.N)[:, None]
        self._kept = kept.lower[self._at], kept.upper[self._at]
        self._hinges = BoundPenalties(
            np.where(past, kept.lower[self._at], lower[self._at]),
            np.where(past, kept.upper[self._at], upper[self._at]), most,
        )  # fmt: skip
        self._move_ranges(self._own_x_ref)
        self._stale = True

    def _move_ranges(self, before: np.ndarray) -> None:
        """Shift ranges, which bound the deviation from the reference, after x_ref changed from `before`."""
        ranges = self.problem.ranges
        if self._hinges is None or ranges is None:
            return
        moved = self._space.difference(self.x_ref, before)[:, ranges.component]
        for side in (*self._hinges[:2], *self._kept):
            side[:, : moved.shape[1]] -= moved[: len(side)]

    def update_hinges(self, xs: np.ndarray, us: np.ndarray, cost: float, solved: bool) -> None:
        """Update penalties after a solve: weights of newly violated bounds and, if `solved`, the multipliers.

        Multipliers are updated as in an augmented Lagrangian; those of an unconverged plan, as after a push, would
        distort the next one. They are stored per stage of the task and shift with the window. Clearances have weights
        from the start and are too slow to evaluate at each call: their multipliers remain those of the first plan.

        Args:
            xs: (H+1, nx) states of the plan.
            us: (H, nu) its controls.
            cost: J of the plan.
            solved: Whether its expected reduction is small.
        """
        if self._hinges is None or not len(self._columns):
            return
        here, columns = slice(self.stage + 1, self.stage + self.H), self._columns  # the first state is fixed
        e = self._deviations(xs, us)[1:]
        lower, upper, weight = (part[here, columns] for part in self._hinges)
        low, high = np.maximum(lower - e, 0.0), np.maximum(e - upper, 0.0)  # multipliers over the weight
        broken = np.any((low > 0.0) | (high > 0.0), axis=0)
        new = broken & ~np.any(weight > 0.0, axis=0)
        if new.any():
            outside = float(np.sum((low**2 + high**2)[:, new]))
            self._hinges.weight[:, columns[new]] = 2.0 * max(abs(cost), np.finfo(float).tiny) / outside
            low[:, new] = high[:, new] = 0.0
            self._stale = True
        kept = [side[here, columns] for side in self._kept]
        if solved and (broken.any() or np.any(lower != kept[0]) or np.any(upper != kept[1])):
            self._hinges.lower[here, columns], self._hinges.upper[here, columns] = shifted_bounds(
                kept[0], kept[1], low, high
            )
            self._stale = True

    def _advance(self, stages: int) -> None:
        """Shift the multipliers after the end of the task by a number of stages; those after the window become zero."""
        assert self._hinges is not None
        past, m = slice(self.N + 1, None), min(stages, self.H)
        for side, kept in zip(self._hinges[:2], self._kept, strict=True):
            own, free = side[past], kept[past]
            shift = np.where(np.isfinite(free), own - free, 0.0)
            own[:-m], own[-m:] = free[:-m] + shift[m:], free[-m:]
        self._stale = True

    def _deviations(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """Values (H, columns) of ranges and constraints with updated multipliers, at knots 0 ... H-1 of the window."""
        ranges, found = self.problem.ranges, list[np.ndarray]()
        if ranges is not None:
            e = self._space.difference(xs[:-1], self.x_ref[self.stage : self.stage + self.H])
            found.append(e[:, ranges.component])
        if self._rows is not None:
            found.append(self._rows.values(xs, us)[:-1])
        return np.concatenate(found, axis=1)

    def aim(self, goal: np.ndarray, control: np.ndarray | None, stage: int) -> None:
        """Set the goal state (nx,), and its equilibrium control (nu,) as reference after the end of the task.

        A goal (H+1, nx) is its trajectory over the window that begins at `stage`. All state references that equal the
        final one change with it.
        """
        goals, before = np.atleast_2d(goal), self.x_ref.copy()
        first = min(max(stage, 0), self.N)
        at = np.clip(np.arange(len(self.x_ref)) - first, 0, len(goals) - 1)
        self.x_ref[self._to_goal] = goals[at[self._to_goal]]
        self._move_ranges(before)
        self.rest(control)

    def rest(self, control: np.ndarray | None) -> None:
        """Set the reference control (nu,) after the end of the task; None changes nothing."""
        if control is not None:
            self.u_ref[self._at == self.N] = control
        self._stale = True

    def point(self, frame: str, places: np.ndarray) -> None:
        """Set the goal of a frame, and its path reference, to a position (3,) in the world, m.

        Positions (H+1, 3) are its trajectory over the next window.
        """
        choice("a frame of the goal", frame, self._frames)
        self._points[frame] = np.atleast_2d(places)
        self._stale = True

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames whose position goal can be changed."""
        return tuple(self._frames)

    def slide(self, stage: int) -> None:
        """Move the window to a stage of the task; after the end the tables stay at stage N."""
        if self._hinges is not None and stage > max(self._passed, self.N):  # multipliers still shift
            self._advance(stage - max(self._passed, self.N))
        self._passed, stage = stage, min(max(stage, 0), self.N)
        if stage == self.stage and not self._stale:
            return
        self.stage, self._stale = stage, False
        H, here = self.H, slice(stage, stage + self.H)
        for one in self._python:
            one.slide(stage)
        engine = self.engine
        if isinstance(engine, CompiledEngine):
            arrays = self._arrays
            engine.use_tables(self._entries, self._addresses[stage])
            ends = int(self.keeps or stage + H <= self.N)
            if ends != self._ends:
                self._ends, arrays["final_value"][:] = ends, self._values_at_end[ends]
            for array, values in self._own_bounds:
                if array.size:
                    array[:] = values[here]
            if self._source is not None:
                self._slide_residuals(stage)
        elif isinstance(engine, NumpyEngine):
            engine.weigh(self.cost_at(stage))
        if self._hinges is not None:
            last = [*range(stage, stage + H), self.N]
            hinges = BoundPenalties(*(part[last] for part in self._hinges))
            ranges = self.problem.ranges
            if ranges is not None:  # of the deviation from the window's last reference
                away = self._space.difference(self.x_ref[stage + H], self.x_ref[self.N])[ranges.component]
                for side in hinges[:2]:
                    side[-1, : len(away)] -= away
            engine.set_penalties(hinges)

    def _slide_residuals(self, stage: int) -> None:
        H, here = self.H, slice(stage, stage + self.H + 1)
        table, source, end = self._table, self._source, self._end_rows
        assert table is not None
        assert source is not None
        assert end is not None
        for name in ("world", "reference"):
            own, values = table._arrays[name], source._arrays[name]
            own[: len(values), ..., : H + 1] = values[..., here]
        M = len(source.weight)
        table.weight[:M], table.bound[:M] = source.weight[:, here], source.bound[:, here]
        if self.keeps or stage + H <= self.N:
            table.weight[:M, H] = end.weight[:, -1]
        for frame, places in self._points.items():
            table.bound[self._frames[frame], : H + 1] = places.T
        table.changed()

    def cost_at(self, stage: int) -> Cost:
        """The cost of the window that begins at a stage, for the NumPy engine and for the cost of a closed loop."""
        H, here = self.H, slice(stage, stage + self.H)
        ends = self.keeps or stage + H <= self.N  # with the problem's final weight
        Q = np.concatenate([self._Q[here], (self._final if ends else self._last)[None]])
        cost = object.__new__(TrackingCost)  # checked when the window was made
        cost.Q, cost.R, cost.N, cost.nu = Q, self._R[here], H, self._R.shape[1]
        cost.x_ref, cost.u_ref, cost.space = self.x_ref[stage : stage + H + 1], self.u_ref[here], self._space
        cost.nx, cost.ndx = self._space.nx, self._space.ndx
        python = [one.at(stage) for one in self._python]
        if self._residuals is None or self._end_rows is None:
            return SumCost(cost, *python) if python else cost
        parts = at_stages(self._residuals, slice(stage, stage + H + 1))
        bound, weight = np.array(parts.bound), np.array(parts.weight)
        for frame, places in self._points.items():
            bound[self._frames[frame]] = places.T
        if ends:
            weight[:, -1] = self._end_rows.weight[:, -1]
        parts = replace(parts, bound=bound, weight=weight)
        return SumCost(cost, _Measured(self._residual_costs, parts), *python)


class _Measured(ResidualCost):
    """Sum of several costs of residuals over a window."""

    def __init__(self, costs: list[ResidualCost], measures: ResidualArrays) -> None:
        super().__init__(costs[0].mechanism, measures, measures.weight.shape[1] - 1)
