"""LeastSquares: the weighted square of a residual, of the library or of your own; one term of a cost."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, count, numbers, short_repr
from planner.base.errors import PlannerError
from planner.model.coordinates import Coordinate
from planner.model.space import space_of
from planner.problem.costs.goal_spec import GoalSpec
from planner.problem.costs.terms import Quadratic, Term, per_stage
from planner.problem.residual import Residual

TABLES = ("weight", "lower", "upper")


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
        values = self.values(xs, us)
        return np.maximum(values - self.upper, 0.0) - np.maximum(self.lower - values, 0.0)

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
        return np.maximum(values - self.upper[-1], 0.0) - np.maximum(self.lower[-1] - values, 0.0)

    def goal_specs(self, _: Sequence[Coordinate]) -> tuple[GoalSpec, ...]:
        """The residual at the end, where it has a final weight."""
        return (GoalSpec(str(self.residual), self.residual.unit, self._missed),) if self.has_goal else ()

    def _missed(self, xs: np.ndarray) -> np.ndarray:
        """(K,) norm of the weighed components at the end; infinite for states that are not finite."""
        known, missed = np.isfinite(xs).all(axis=1), np.full(len(xs), np.inf)
        missed[known] = np.linalg.norm(self._error_at_end(xs[known])[:, self.weight[-1] > 0.0], axis=1)
        return missed

    def final_cost(self, x: np.ndarray) -> float:
        """The final cost at the end state x (nx,)."""
        if self.of_controls:
            return 0.0
        return 0.5 * float(self.weight[-1] @ self._error_at_end(x[None])[0] ** 2)
