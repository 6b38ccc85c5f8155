"""Costs: J = phi(x(N)) + sum of L(x(n), u(n), n) (Eq. 9), their quadratic models, and the goals of their terms.

Every quadratic term has a factor 1/2, also the control's: Eq. 11 as printed has none there, but Eq. 16 and 18 imply
it. Gradients and Hessians of states are with respect to a deviation dx (ndx,) of model.space, for plain vectors the
difference of states.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from planner.base.arguments import number, short_repr
from planner.base.errors import PlannerError
from planner.model.space import StateSpace

SOFT = "soft"  # the word for an infinite tolerance in files, which know no infinity


class Quadratic(NamedTuple):
    """Hessians and gradients of the stage costs; the last of Q and q belong to the end."""

    Q: np.ndarray  # (N+1, ndx, ndx)
    q: np.ndarray  # (N+1, ndx)
    R: np.ndarray  # (N, nu, nu)
    r: np.ndarray  # (N, nu)
    S: np.ndarray | None = None  # (N, nu, ndx) of the mixed term du'S dx; None for none

    @property
    def finite(self) -> bool:
        """Whether all entries are finite."""
        return all(np.isfinite(part).all() for part in self if part is not None)


class Cost(Protocol):
    """The two methods of every cost, also of user-defined ones."""

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        ...

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Gradients and positive semidefinite Hessians (R positive definite) along a trajectory."""
        ...


def check_cost(name: str, value: Any) -> None:
    """Raise a PlannerError unless a value has the two methods of a cost."""
    if not (callable(getattr(value, "value", None)) and callable(getattr(value, "quadratize", None))):
        raise PlannerError(f"{name} is {short_repr(value)}, expected a cost with value() and quadratize().")


def call_if_supported(cost: Any, method: str, *arguments: Any) -> Any:
    """Call `resampled` or `with_effort` of a cost; a PlannerError if it has no such method."""
    if not callable(getattr(cost, method, None)):
        signature = {"resampled": "resampled(parts, ratio)", "with_effort": "with_effort(weight)"}[method]
        raise PlannerError(f"the cost is of the type {type(cost).__name__}, expected a cost with {signature}.")
    return getattr(cost, method)(*arguments)


def per_stage(rows: np.ndarray, parts: int) -> np.ndarray:
    """Rows (N+1, ...) of stages and the end, each stage's row repeated for its parts; (1, ...) is unchanged."""
    return rows if len(rows) == 1 else np.concatenate([np.repeat(rows[:-1], parts, axis=0), rows[-1:]])


def extended_cost(cost: Any, own: StateSpace, space: StateSpace) -> Any:
    """A cost of states in `own` extended to states in `space`, which append components."""
    extend = getattr(cost, "augmented", None)
    return EmbeddedCost(cost, own.nx, own.ndx, space) if extend is None else extend(own, space)


class Term:
    """A cost that can be added to any other: a + b is SumCost(a, b).

    Two optional methods let a problem change its step or its objective: `resampled(parts, ratio)` is the same cost
    over stages divided into parts, with running weights multiplied by ratio; `with_effort(weight)` is the same cost
    with the weights of the controls multiplied.
    """

    def with_effort(self, weight: float) -> Cost:
        """Returns itself. Costs with control weights override this."""
        return self  # type: ignore[return-value]

    def augmented(self, own: StateSpace, space: StateSpace) -> Cost:
        """The same cost on a state with appended components; see extended_cost."""
        return EmbeddedCost(self, own.nx, own.ndx, space)  # type: ignore[arg-type]

    def __add__(self, other: Cost) -> SumCost:
        return SumCost(self, other)

    def __radd__(self, other: Cost) -> SumCost:
        return SumCost(other, self)


class SumCost(Term):
    """The sum of any costs. Only the sum needs a positive definite R.

    Args:
        costs: TrackingCost, FrameCost or user-defined.

    Raises:
        PlannerError: An argument that is no cost, or costs of different sizes or state spaces.
    """

    def __init__(self, *costs: Any) -> None:
        self.costs: tuple[Cost, ...] = ()
        for cost in costs:
            check_cost("a term of a cost", cost)
            self.costs += cost.costs if isinstance(cost, SumCost) else (cost,)
        if not self.costs:
            raise PlannerError("the sum has no costs, expected at least one.")
        self.N, self.nx, self.ndx, self.nu, self.space = (
            self._common(name) for name in ("N", "nx", "ndx", "nu", "space")
        )

    def _common(self, name: str) -> Any:
        """The common value of an attribute of the costs that have it; None if none has."""
        said = [value for cost in self.costs if (value := getattr(cost, name, None)) is not None]
        for value in said:
            if value != said[0]:
                raise PlannerError(f"the costs of a sum are made for {name} = {said[0]} and {value}: expected one.")
        return said[0] if said else None

    def resampled(self, parts: int, ratio: float) -> SumCost:
        """The sum of the costs over stages divided into parts; see Term."""
        return SumCost(*(call_if_supported(cost, "resampled", parts, ratio) for cost in self.costs))

    def with_effort(self, weight: float) -> SumCost:
        """The sum with the weights of the controls multiplied."""
        return SumCost(*(call_if_supported(cost, "with_effort", weight) for cost in self.costs))

    def augmented(self, own: StateSpace, space: StateSpace) -> SumCost:
        """The sum of the costs on a state with appended components."""
        return SumCost(*(extended_cost(cost, own, space) for cost in self.costs))

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        return float(sum(cost.value(xs, us) for cost in self.costs))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """The sum of the costs' quadratic models."""
        models = [cost.quadratize(xs, us) for cost in self.costs]
        for i, model in enumerate(models[1:], 1):  # a wrong shape could broadcast into a wrong gradient
            for name, first, part in zip(Quadratic._fields[:4], models[0][:4], model[:4], strict=True):
                if np.shape(part) != np.shape(first):
                    raise PlannerError(
                        f"cost {i} of a sum gives {name} of shape {np.shape(part)}, cost 0 of {np.shape(first)}: "
                        f"expected the same."
                    )
        Q, q, R, r = (np.sum(parts, axis=0) for parts in zip(*(model[:4] for model in models), strict=True))
        mixed = [model.S for model in models if model.S is not None]
        return Quadratic(Q, q, R, r, np.sum(mixed, axis=0) if mixed else None)


class EmbeddedCost(Term):
    """A cost of the first nx entries of an extended state in `space` (ndx of its deviation)."""

    def __init__(self, cost: Cost, nx: int, ndx: int, space: StateSpace) -> None:
        self.cost, self.space, self._nx, self._ndx = cost, space, nx, ndx
        self.nx, self.ndx = space.nx, space.ndx

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        return self.cost.value(xs[:, : self._nx], us)

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """The cost's quadratic model, padded with zeros for the appended components."""
        model, more = self.cost.quadratize(xs[:, : self._nx], us), self.ndx - self._ndx
        return Quadratic(
            np.pad(model.Q, ((0, 0), (0, more), (0, more))), np.pad(model.q, ((0, 0), (0, more))), model.R, model.r,
            None if model.S is None else np.pad(model.S, ((0, 0), (0, 0), (0, more))),
        )  # fmt: skip


class GoalSpec(NamedTuple):
    """One goal: of a cost's term with a final weight at the end, or of a task at its times.

    A term has `goal_specs(coordinates) -> tuple of GoalSpec`, with the planner.model.coordinates.Coordinate of every
    component of a deviation, and `final_cost(x) -> float`, its cost at the end.
    """

    name: str  # of the coordinate, or of a frame's part: "position of hand"
    unit: str
    error: Callable[[np.ndarray], np.ndarray]  # states (K, nx) -> (K,) distances from the goal; K = T with times
    times: tuple[float, ...] | None = None  # (T,) s; None for the end
    tolerance: float | None = None  # in its unit; None for the problem's


def where_finite(xs: np.ndarray, values_of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(K,) values of a function of indices (k,) -> (k,); infinite at states (K, nx) that are not finite."""
    finite, found = np.flatnonzero(np.isfinite(xs).all(axis=1)), np.full(len(xs), np.inf)
    if len(finite):
        found[finite] = values_of(finite)
    return found


def checked_tolerance(value: Any) -> float | dict[str, float] | None:
    """A problem's tolerance: a number above 0, "soft" or infinity for no check, or a table of these by name.

    Raises:
        PlannerError: It is something else.
    """
    if value is None:
        return None
    if isinstance(value, Mapping):
        return {str(name): _one(f"the tolerance of {short_repr(name)}", one) for name, one in value.items()}
    return _one("tolerance", value)


def stored_tolerance(tolerance: float | Mapping[str, float] | None) -> Any:
    """A checked tolerance as JSON values, which know no infinity."""
    if isinstance(tolerance, Mapping):
        return {name: stored_tolerance(one) for name, one in tolerance.items()}
    return SOFT if tolerance == np.inf else tolerance


def _one(name: str, value: Any) -> float:
    if value == SOFT or (isinstance(value, float) and value == np.inf):
        return float("inf")
    try:
        return number(name, value, greater_than=0.0)
    except PlannerError:
        raise PlannerError(
            f"{name} is {short_repr(value)}, expected a number above 0, 'soft' for a goal that is not judged, or a "
            "table such as {position = 0.02, velocity = 0.1}."
        ) from None
