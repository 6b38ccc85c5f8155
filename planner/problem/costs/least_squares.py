"""Costs of weighted squared residuals: ResidualCost and PenaltyCost of kernels' residuals, LeastSquares of any.

ResidualCost is the base class of PenaltyCost, FrameCost, CenterOfMassCost and SlipCost:

    J = sum over stages and rows of w r^2 / 2,    gradient w r r' J,    Hessian w r'^2 J'J (Gauss and Newton)

with the residual r of a row's value e (see residual_arrays), r' = dr/de and J the derivative of e by a deviation of
the state. Independent of the control. The reference implementation of kernels.tree.residuals.evaluate.

PenaltyCost has terms of problem.costs.penalty_terms, heights, distances, gaps and velocities of a machine:

    J = sum_n dt weight_n 1/2 r_n^2  over the stages,  + final_weight 1/2 r_N^2 at the end

for each, r its residual. Constraints use the same terms as ResidualArrays.

LeastSquares is of a planner.Residual, of the library or of your own.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, count, numbers, short_repr
from planner.base.errors import PlannerError
from planner.dynamics.contacts import ramp
from planner.kernels.tree.residuals.kinds import VELOCITY
from planner.model.coordinates import Coordinate
from planner.model.mechanism import Mechanism
from planner.model.space import StateSpace, space_of
from planner.problem.costs.residual_arrays import ResidualArrays, arrays_of_terms, resampled
from planner.problem.costs.residual_functions import RESIDUALS, KinematicsCache
from planner.problem.costs.terms import GoalSpec, Quadratic, Term, per_stage, where_finite
from planner.problem.costs.tracking import mechanism_and_step
from planner.problem.residual import Residual

TABLES = ("weight", "lower", "upper")


def values_of(mechanism: Mechanism, arrays: ResidualArrays, xs: np.ndarray) -> np.ndarray:
    """(M, K) of all rows for states xs (K, nx), one for each stage of the arrays."""
    cache = KinematicsCache(mechanism, arrays, xs)
    values = [RESIDUALS[int(kind)](cache, t, False)[0].T for t, kind in enumerate(arrays.kind)]
    return np.concatenate([np.empty((0, len(xs))), *values])


def values_and_jacobians(mechanism: Mechanism, arrays: ResidualArrays, xs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (K, M) of all rows for states xs (K, nx), one for each stage, and their derivatives (K, M, ndx)."""
    cache, M = KinematicsCache(mechanism, arrays, xs), len(arrays.weight)
    values, by_x = np.empty((len(xs), M)), np.zeros((len(xs), M, mechanism.space.ndx))
    for t, kind in enumerate(arrays.kind):
        value, J = RESIDUALS[int(kind)](cache, t, True)
        values[:, arrays.rows(t)], by_x[:, arrays.rows(t), : J.shape[2]] = value, J
    return values, by_x


class GoalRows(NamedTuple):
    """Rows of a term that are a goal at the end, with its name and unit."""

    name: str
    unit: str
    term: int
    rows: slice = slice(None)


class ResidualCost(Term):
    """Weighted squared residuals of a mechanism; one term of a cost. Compiled with RigidBodyDynamics.

    Args:
        mechanism: The machine.
        arrays: The terms; of N stages, or of one stage and the end for any horizon.
        N: Stages; None for any horizon.
        goals: Goals at the end; those with a final weight of 0 are ignored.
    """

    def __init__(
        self, mechanism: Mechanism, arrays: ResidualArrays, N: int | None, goals: Sequence[GoalRows] = ()
    ) -> None:
        self.mechanism, self.residual_arrays, self.N, self._goals = mechanism, arrays, N, tuple(goals)
        self.space = mechanism.space
        self.nx, self.ndx = self.space.nx, self.space.ndx

    def residual_arrays_for(self, N: int) -> ResidualArrays:
        """The terms for N stages."""
        return self.residual_arrays if self.N is not None else resampled(self.residual_arrays, N, 1.0)

    def goal_rows(self) -> dict[str, np.ndarray]:
        """Indices of the rows of each goal, by its name: "position of hand"."""
        return {goal.name: self._rows_of(goal)[0] for goal in self._goals}

    def resampled(self, parts: int, ratio: float) -> ResidualCost:
        """The same cost over stages divided into parts, with running weights multiplied by ratio."""
        cost = copy(self)
        cost.N = None if self.N is None else parts * self.N
        cost.residual_arrays = resampled(self.residual_arrays, 1 if self.N is None else parts, ratio)
        return cost

    def augmented(self, own: StateSpace, space: StateSpace) -> ResidualCost:
        """The same cost on a state with appended components."""
        cost = copy(self)
        cost.space, cost.nx, cost.ndx = space, space.nx, space.ndx
        return cost

    def goal_specs(self, _: Sequence[Coordinate]) -> tuple[GoalSpec, ...]:
        """Goals with a final weight above 0."""
        weighed = [goal for goal in self._goals if self._rows_of(goal)[1].any()]
        return tuple(GoalSpec(goal.name, goal.unit, partial(self._missed, goal)) for goal in weighed)

    def _rows_of(self, goal: GoalRows) -> tuple[np.ndarray, np.ndarray]:
        """Indices of a goal's rows, and whether their final weights are above 0."""
        rows = np.arange(len(self.residual_arrays.weight))[self.residual_arrays.rows(goal.term)][goal.rows]
        return rows, self.residual_arrays.weight[rows, -1] > 0.0

    def _missed(self, goal: GoalRows, xs: np.ndarray) -> np.ndarray:
        """(K,) norm of the residual of the rows with a final weight; infinite for states that are not finite."""
        rows, weighed = self._rows_of(goal)
        return where_finite(xs, lambda n: np.linalg.norm(self._at_end(xs[n])[rows[weighed]], axis=0))

    def final_cost(self, x: np.ndarray) -> float:
        """The final cost at the end state x (nx,)."""
        return 0.5 * float(self.residual_arrays.weight[:, -1] @ self._at_end(x[None])[:, 0] ** 2)

    def _at_end(self, xs: np.ndarray) -> np.ndarray:
        """(M, K) residuals of states (K, nx), each with the targets of the end."""
        last = self.residual_arrays.along(np.full(len(xs), -1))
        return _residuals(last, values_of(self.mechanism, last, xs))[0]

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        if not np.isfinite(xs).all():  # a rollout that diverged
            return float("inf")
        stages, arrays = self._weighing(len(us))
        residuals, _ = _residuals(arrays, values_of(self.mechanism, arrays, xs[stages]))
        return 0.5 * float(np.sum(arrays.weight * residuals**2))

    def _weighing(self, N: int) -> tuple[np.ndarray, ResidualArrays]:
        """Stages with a weight above 0, and the terms there."""
        arrays = self.residual_arrays_for(N)
        stages = np.flatnonzero(arrays.weight.any(axis=0))
        return stages, arrays.along(stages)

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Gradient and Gauss-Newton Hessian by the state; zero by the control."""
        N, nu = us.shape
        model = Quadratic(
            np.zeros((N + 1, self.ndx, self.ndx)), np.zeros((N + 1, self.ndx)), np.zeros((N, nu, nu)), np.zeros((N, nu))
        )
        stages, arrays = self._weighing(N)
        cache = KinematicsCache(self.mechanism, arrays, xs[stages])
        for t, kind in enumerate(arrays.kind):
            value, J = RESIDUALS[int(kind)](cache, t, True)
            rows, n = arrays.rows(t), J.shape[2]
            residual, slope = _residuals(arrays, value.T, rows)
            J = slope.T[:, :, None] * J  # of the residuals
            WJ = arrays.weight[rows].T[:, :, None] * J
            model.q[stages, :n] += np.einsum("nri,rn->ni", WJ, residual)
            model.Q[stages, :n, :n] += np.swapaxes(J, 1, 2) @ WJ
        return model


def _residuals(m: ResidualArrays, values: np.ndarray, rows: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (M, K) of values (M, K) of some rows, and their derivatives by the values."""
    side, a = m.side[rows, None], m.ramp[rows, None]
    e = np.where(side == 0.0, 1.0, side) * (values - m.bound[rows])
    residual, slope = ramp(e, a)
    return np.where(side == 0.0, e, residual), np.where(side == 0.0, 1.0, side * slope)


class PenaltyCost(ResidualCost):
    """Penalties of heights, distances, gaps and velocities; one term of a cost: TrackingCost(...) + PenaltyCost(...).

    With RigidBodyDynamics it is part of the compiled solver.

    Args:
        machine: RigidBodyDynamics or a Mechanism.
        horizon: N, number of stages.
        terms: Height, Distance, Gap and Velocity.
        dt: s; that of the dynamics by default.

    Attributes:
        names: (T,) of the terms, for a reader.

    Raises:
        PlannerError: No such frame or contact, an array per stage whose length is not N+1, or an entry that is no term.
    """

    def __init__(self, machine: Any, horizon: int, terms: Sequence[Any], dt: float | None = None) -> None:
        mechanism, dt = mechanism_and_step(machine, dt)
        N = count("horizon", horizon, maximum=LONGEST_HORIZON)
        if not isinstance(terms, Sequence):
            raise PlannerError(f"terms is {short_repr(terms)}, expected a list of Height, Distance, Gap and Velocity.")
        self.names = tuple(str(term) for term in terms)
        residual_arrays = arrays_of_terms(mechanism, N, terms, dt)
        units = ["m/s" if kind == VELOCITY else "m" for kind in residual_arrays.kind]
        # a term without its own final weight is no goal at the end
        asked = [t for t, term in enumerate(terms) if getattr(term, "final_weight", None) is not None]
        super().__init__(mechanism, residual_arrays, N, [GoalRows(self.names[t], units[t], t) for t in asked])

    def values(self, xs: np.ndarray) -> np.ndarray:
        """(N+1, T) m or m/s, the values of the terms along xs (N+1, nx), also where they are off."""
        return values_of(self.mechanism, self.residual_arrays, xs).T


class LeastSquares(Term):
    """1/2 w r^2 of a residual's components, summed over the stages; Gauss-Newton Hessian.

        r = value - target,   or   r = max(0, lower - value) and max(0, value - upper)

    A number stands for all components and stages, (R,) for the components, (N+1, R) for each stage too. It is evaluated
    in Python, beside the compiled terms of the same cost: TrackingCost(...) + LeastSquares(...).

    Args:
        dynamics: Of the problem.
        horizon: N, number of stages.
        residual: A planner.Residual.
        weight: Running weight, per second and square of the residual's unit.
        final_weight: Weight at the end; by default dt times the last running weight. With it the proof judges the end.
        target: What the residual is to be; 0 where neither lower nor upper is given.
        lower: What it is to be at least; NaN for no bound.
        upper: What it is to be at most.

    Attributes:
        weight: (N+1, R), the running ones times dt.
        lower: (N+1, R); equal to upper for a target, -inf for no bound.
        upper: (N+1, R).

    Raises:
        PlannerError: Not a residual, a wrong shape, a negative weight, bounds beside a target.
    """

    def __init__(
        self, dynamics: Any, horizon: int, residual: Residual, *, weight: Any = 0.0, final_weight: Any = None,
        target: Any = None, lower: Any = None, upper: Any = None,
    ) -> None:  # fmt: skip
        if not isinstance(residual, Residual):
            raise PlannerError(f"residual is {short_repr(residual)}, expected a planner.Residual.")
        self.dynamics, self.residual, self.N = dynamics, residual, count("horizon", horizon, maximum=LONGEST_HORIZON)
        self.space, self.nu = space_of(dynamics), dynamics.nu
        self.nx, self.ndx = self.space.nx, self.space.ndx
        self._function = residual.residual_function(dynamics, self.N)
        if target is not None and (lower is not None or upper is not None):
            raise PlannerError(f"{residual} has a target and a bound, expected the target alone, or lower and upper.")
        if target is None and lower is None and upper is None:
            target = 0.0
        running = dynamics.dt * self._table("weight", weight)
        self.weight, self.has_goal = running, final_weight is not None
        if final_weight is not None:
            self.weight[-1] = self._table("final_weight", final_weight)[-1]
        self.of_controls = self._function.of_controls
        if self.of_controls:
            if final_weight is not None:
                raise PlannerError(f"{residual} is of controls, which has no value at the end: leave final_weight out.")
            self.weight[-1] = 0.0
        if not (np.isfinite(self.weight).all() and self.weight.min() >= 0.0 and self.weight.any()):
            raise PlannerError(f"the weight of {residual} is {short_repr(weight)}, expected one above 0, none below.")
        given = {"lower": lower, "upper": upper} if target is None else {"target": target}
        tables = [self._table(name, np.nan if one is None else one) for name, one in given.items()]
        self.lower, self.upper = (
            np.where(np.isnan(table), none, table)
            for table, none in zip((tables[0], tables[-1]), (-np.inf, np.inf), strict=True)
        )

    def _table(self, name: str, given: Any) -> np.ndarray:
        """(N+1, R) of a number, (R,) or (N+1, R)."""
        value, R = numbers(f"the {name} of {self.residual}", given), self._function.rows
        if value.shape not in ((), (R,), (self.N + 1, R), (self.N + 1, 1)):
            raise PlannerError(
                f"the {name} of {self.residual} has the shape {value.shape}, expected a number, ({R},) or "
                f"({self.N + 1}, {R})."
            )
        return np.array(np.broadcast_to(value, (self.N + 1, R)), dtype=float)

    def with_tables(self, weight: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> LeastSquares:
        """The same residual with other weights and bounds, (N+1, R) each of any N."""
        cost = copy(self)
        cost.weight, cost.lower, cost.upper, cost.N = weight, lower, upper, len(weight) - 1
        return cost

    def resampled(self, parts: int, ratio: float) -> LeastSquares:
        """The same cost over stages divided into parts, with running weights multiplied by ratio."""
        weight, lower, upper = (per_stage(getattr(self, name), parts) for name in TABLES)
        weight[:-1] *= ratio
        return self.with_tables(weight, lower, upper)

    def values(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(N+1, R) of the residual along xs (N+1, nx), us (N, nu); 0 at the end for one of controls."""
        found = np.zeros((len(xs), self._function.rows))
        n = np.arange(len(us) if self.of_controls else len(xs))
        found[n] = self._function.values(xs[n], us[np.minimum(n, len(us) - 1)], np.zeros(len(n), dtype=int))
        return found

    def _errors(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(N+1, R) signed distance of the residual from its bounds, 0 within."""
        return _beyond(self.values(xs, us), self.lower, self.upper)

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        if not np.isfinite(xs).all():  # a rollout that diverged
            return float("inf")
        return 0.5 * float(np.sum(self.weight * self._errors(xs, us) ** 2))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Gradients and Gauss-Newton Hessians along a trajectory."""
        (N, nu), ndx, of_controls = us.shape, self.ndx, self.of_controls
        e = self._errors(xs, us)
        off = (e == 0.0) & (self.lower < self.upper)
        WJ = np.where(off, 0.0, self.weight)
        n = np.flatnonzero(WJ.any(axis=1))
        by_x, by_u = self._function.derivatives(xs[n], us[np.minimum(n, N - 1)], np.zeros(len(n), dtype=int))
        J = np.zeros((N + 1, e.shape[1], ndx + nu))
        J[n, :, :ndx] = by_x
        if of_controls:
            J[n, :, ndx:] = by_u
        WJ = WJ[:, :, None] * J
        H, h = np.swapaxes(J, 1, 2) @ WJ, np.einsum("nrz,nr->nz", WJ, e)
        mixed = H[:-1, ndx:, :ndx] if of_controls else None
        return Quadratic(H[:, :ndx, :ndx], h[:, :ndx], H[:-1, ndx:, ndx:], h[:-1, ndx:], mixed)

    def _error_at_end(self, xs: np.ndarray) -> np.ndarray:
        """(K, R) of end states (K, nx)."""
        values = self._function.values(xs, np.zeros((len(xs), self.nu)), np.zeros(len(xs), dtype=int))
        return _beyond(values, self.lower[-1], self.upper[-1])

    def goal_specs(self, _: Sequence[Coordinate]) -> tuple[GoalSpec, ...]:
        """The residual at the end, where it has a final weight."""
        return (GoalSpec(str(self.residual), self.residual.unit, self._missed),) if self.has_goal else ()

    def _missed(self, xs: np.ndarray) -> np.ndarray:
        """(K,) norm of the weighed components at the end; infinite for states that are not finite."""
        weighed = self.weight[-1] > 0.0
        return where_finite(xs, lambda n: np.linalg.norm(self._error_at_end(xs[n])[:, weighed], axis=1))

    def final_cost(self, x: np.ndarray) -> float:
        """The final cost at the end state x (nx,)."""
        if self.of_controls:
            return 0.0
        return 0.5 * float(self.weight[-1] @ self._error_at_end(x[None])[0] ** 2)


def _beyond(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Signed distances of values from bounds, 0 within."""
    return np.maximum(values - upper, 0.0) - np.maximum(lower - values, 0.0)
