"""Constraint: a path or terminal constraint on states, or on states and controls. Data only.

    h(x, u) = equal,   or   lower <= h(x, u) <= upper,   with one bound or both,

to a tolerance, by the augmented Lagrangian of planner.solvers.augmented_lagrangian. h is one of:

    a term of planner.costs (Height, Distance, Gap, Velocity, ...), which has its own bound
    a residual: one of planner.constraints (Power, ...), or a planner.Residual of your own
    h(xs) of states (K, nx), required at every knot but the start, which is given
    h(xs, us) of states and controls (K, nu), required at both ends of every stage, over which a control is constant

A function returns (K,) or (K, R) for K states at once, each row of that state alone: R components.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planner.base.arguments import number, numbers, set_fields, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.problem.constraints.quantities import function_of_term
from planner.problem.costs.penalty_terms import Penalty, Velocity
from planner.problem.costs.terms import per_stage
from planner.problem.residual import PythonResidual, Residual, ResidualFunction

ALWAYS, END = "always", "end"
DEFAULT_TOLERANCE = 1e-4  # of the largest bound, and of 1 in its unit
_TIME_TOLERANCE = 1e-9  # of the duration: a knot within it of an end of `when` is included


@dataclass(frozen=True, eq=False)
class Constraint:
    """A constraint of a plan.

    Attributes:
        of: A term of planner.costs, with its own lower, upper or target and tolerance; a residual; or a function.
        equal: Of a residual or function: a number, (R,), or (N+1, R) by knots with NaN for no bound.
        lower: The same.
        upper: The same; with lower or alone.
        when: "always", "end", or (from, to) in s.
        tolerance: Largest violation that passes, in the unit of h. By default that of the term, or 1e-4 of the largest
            bound but at least 1e-4.
        name: In messages; by default that of the term or function.
        unit: Of h.
        derivatives: Of a function, of the same arguments: (K, R, ndx), and where it takes controls a pair of that and
            (K, R, nu). By default central differences.
        states: Number of leading entries of a state that the function takes; None for all.

    Raises:
        PlannerError: Neither a term nor a function, bounds that contradict each other, a bad time or tolerance.
    """

    of: Any
    equal: Any = None
    lower: Any = None
    upper: Any = None
    when: Any = ALWAYS
    tolerance: float | None = None
    name: str = ""
    unit: str = ""
    derivatives: Callable[..., Any] | None = None
    states: int | None = None

    def __post_init__(self) -> None:
        term, quantity = isinstance(self.of, Penalty), hasattr(self.of, "residual_function")
        if not (term or quantity or callable(self.of)):
            raise PlannerError(
                f"a constraint is of {short_repr(self.of)}, expected a term of planner.costs or planner.constraints, "
                "a planner.Residual, or a function h(xs) or h(xs, us)."
            )
        for name in ("name", "unit"):
            if not isinstance(getattr(self, name), str):
                raise PlannerError(f"a constraint's {name} is {short_repr(getattr(self, name))}, expected a text.")
        own = str(self.of) if term or quantity else getattr(self.of, "__name__", "h")
        set_fields(self, name=self.name or own.replace("<lambda>", "h"))
        unit = ("m/s" if isinstance(self.of, Velocity) else "m") if term else getattr(self.of, "unit", "")
        set_fields(self, unit=self.unit or unit)
        given = [name for name in ("equal", "lower", "upper") if getattr(self, name) is not None]
        if term and given:
            raise PlannerError(f"{self} has {given[0]} beside a term, expected it in the term: {given[0]}=.")
        if not term and not given:
            raise PlannerError(f"{self} has no bound, expected equal=, lower= or upper=.")
        if "equal" in given and len(given) > 1:
            raise PlannerError(f"{self} has equal and {given[1]}, expected equal alone, or lower and upper.")
        if self.derivatives is not None and (term or quantity or not callable(self.derivatives)):
            raise PlannerError(f"{self} has derivatives={short_repr(self.derivatives)}, expected those of a function.")
        for name in given:
            bound = numbers(f"{self}'s {name}", getattr(self, name))
            if bound.ndim > 2 or np.isinf(bound).any():
                raise PlannerError(
                    f"{self} has {name} = {short_repr(getattr(self, name))}, expected finite numbers: one, (R,) or "
                    "(N+1, R), with NaN for no bound."
                )
            set_fields(self, **{name: bound})
        if self.tolerance is not None:
            set_fields(self, tolerance=number(f"{self}'s tolerance", self.tolerance, greater_than=0.0))
        set_fields(self, when=self._when())

    def __str__(self) -> str:
        return f"the constraint {self.name!r}"

    def _when(self) -> Any:
        if isinstance(self.when, str):
            if self.when in (ALWAYS, END):
                return self.when
        elif isinstance(self.when, (Sequence, np.ndarray)) and len(self.when) == 2:
            first, last = (number(f"{self}'s when", one, minimum=0.0) for one in self.when)
            if first <= last:
                return first, last
        raise PlannerError(
            f"{self} has when = {short_repr(self.when)}, expected {ALWAYS!r}, {END!r}, or (from, to) in s, which rise."
        )

    @property
    def takes_controls(self) -> bool:
        """Whether a function takes controls too: by the number of its arguments."""
        try:
            taken = inspect.signature(self.of).parameters.values()
        except (TypeError, ValueError):  # some builtins have no signature
            return False
        needed = [one for one in taken if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
        return len([one for one in needed if one.default is one.empty]) >= 2

    def stages(self, N: int, dt: float) -> np.ndarray:
        """(N+1,) bool, the knots at which it holds."""
        if isinstance(self.when, str):
            return np.ones(N + 1, dtype=bool) if self.when == ALWAYS else np.arange(N + 1) == N
        (first, last), t = self.when, dt * np.arange(N + 1)
        within = (t >= first - _TIME_TOLERANCE * dt * N) & (t <= last + _TIME_TOLERANCE * dt * N)
        if not within.any():
            raise PlannerError(
                f"{self} is from {first:g} to {last:g} s, expected a time with a knot: 0 to {dt * N:g} s in steps of "
                f"{dt:g} s."
            )
        return within

    def allowed(self) -> float:
        """The largest violation that passes, in the unit of h."""
        if self.tolerance is not None:
            return self.tolerance
        if isinstance(self.of, Penalty):
            return self.of.tolerance
        sizes = [np.abs(one) for one in (self.equal, self.lower, self.upper) if one is not None]
        return DEFAULT_TOLERANCE * max(1.0, *(float(np.nanmax(one, initial=0.0)) for one in sizes))

    def resampled(self, parts: int) -> Constraint:
        """The same over stages divided into parts."""
        changed = {
            name: per_stage(bound, parts) for name in ("equal", "lower", "upper")
            if (bound := getattr(self, name)) is not None and bound.ndim == 2
        }  # fmt: skip
        return replace(self, **changed)


class FunctionResidual(Residual):
    """A function h(xs) or h(xs, us) as a residual; with its derivatives, or by central differences."""

    def __init__(
        self, h: Callable[..., Any], of_controls: bool, derivatives: Callable[..., Any] | None, name: str
    ) -> None:
        self._h, self.of_controls, self._derivatives, self.name = h, of_controls, derivatives, name

    def value(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> Any:
        """(K, dim)."""
        return self._h(xs, us) if self.of_controls else self._h(xs)

    def jacobian(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> Any:
        """(K, dim, ndx), and where it takes controls a pair of that and (K, dim, nu); None for differences."""
        if self._derivatives is None:
            return None
        return self._derivatives(xs, us) if self.of_controls else self._derivatives(xs)

    def tried(self, xs: np.ndarray, us: np.ndarray) -> FunctionResidual:
        """Itself, with the number of components that it has at states (K, nx)."""
        try:
            shape = np.shape(np.asarray(self.value(None, xs, us), dtype=float))
        except (TypeError, ValueError, IndexError) as error:
            raise PlannerError(
                f"{self} fails on {len(xs)} states at once ({error}), expected a function of xs (K, nx)"
                f"{' and us (K, nu)' if self.of_controls else ''} that gives (K,) or (K, R)."
            ) from None
        if len(shape) not in (1, 2) or shape[0] != len(xs) or 0 in shape:
            raise PlannerError(
                f"{self} gives an array of shape {shape} for {len(xs)} states, expected one number or one row for each."
            )
        self.dim = 1 if len(shape) == 1 else shape[1]
        return self


def residual_of(constraint: Constraint, dynamics: Dynamics, N: int, x0: np.ndarray, u0: np.ndarray) -> ResidualFunction:
    """What a constraint bounds, for N stages; a user's function is tried at x0 (nx,) and u0 (nu,)."""
    if isinstance(constraint.of, Penalty):
        return function_of_term(constraint.of, dynamics, N)
    if hasattr(constraint.of, "residual_function"):
        return constraint.of.residual_function(dynamics, N)
    function = FunctionResidual(constraint.of, constraint.takes_controls, constraint.derivatives, str(constraint))
    function.tried(np.stack([x0, x0])[:, : constraint.states], np.stack([u0, u0]))
    found = PythonResidual(function, dynamics, constraint.states)
    found.same = id(constraint.of)
    return found


def bounds_of(constraint: Constraint, function: ResidualFunction, N: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds (N+1, R), infinite or NaN for none."""
    given, R = constraint, function.rows
    if isinstance(given.of, Penalty):
        own = np.reshape(getattr(given.of, given.of.side), (-1, 1))
        low, high = None if given.of.side == "upper" else own, None if given.of.side == "lower" else own
    else:
        low, high = (given.equal, given.equal) if given.equal is not None else (given.lower, given.upper)
    lower, upper = (
        np.full((N + 1, R), none) if side is None else _spread(given, side, R, N)
        for side, none in ((low, -np.inf), (high, np.inf))
    )
    if np.any(lower > upper):
        n, r = np.argwhere(lower > upper)[0]
        raise PlannerError(f"{given} has lower = {lower[n, r]:g} above upper = {upper[n, r]:g}, expected it below.")
    return lower, upper


def _spread(constraint: Constraint, side: np.ndarray, R: int, N: int) -> np.ndarray:
    if side.shape not in ((), (R,), (N + 1, R), (N + 1, 1), (1, 1)):
        raise PlannerError(
            f"{constraint} has a bound of shape {side.shape} and is of {R} number{'s' * (R > 1)}, expected one number, "
            f"({R},) or ({N + 1}, {R})."
        )
    return np.array(np.broadcast_to(side, (N + 1, R)))
