"""Constraint functions: h of K states and controls, with its derivatives.

`values(xs, us, n)` (K, R) and `derivatives(xs, us, n)` take states (K, nx) and controls (K, nu) at or after the knots
n (K,). Derivatives are with respect to deviations dx (see planner.model.space) and, where `of_controls`, to controls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.model.space import space_of
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.quantities import function_of_term
from planner.problem.costs.penalty_terms import Penalty

_DIFFERENCE = float(
    np.cbrt(np.finfo(float).eps)
)  # relative and absolute step of central differences: smallest error of rounding and truncation


class ConstraintFunction(Protocol):
    """R functions of a state, or of a state and a control."""

    rows: int
    of_controls: bool
    same: Any  # equal for equal functions, hashable

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, R)."""
        ...

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, R, ndx) and (K, R, nu)."""
        ...


def constraint_function_of(
    constraint: Constraint, dynamics: Dynamics, N: int, x0: np.ndarray, u0: np.ndarray
) -> ConstraintFunction:
    """The function of a constraint for N stages; a user's own is tried at x0 (nx,) and u0 (nu,)."""
    if isinstance(constraint.of, Penalty):
        return function_of_term(constraint.of, dynamics, N)
    if hasattr(constraint.of, "constraint_function"):
        return constraint.of.constraint_function(dynamics, N)
    return UserFunction(constraint, dynamics, x0, u0)


def bounds_of(constraint: Constraint, function: ConstraintFunction, N: int) -> tuple[np.ndarray, np.ndarray]:
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


class UserFunction:
    """A user's function h(xs) or h(xs, us)."""

    def __init__(self, constraint: Constraint, dynamics: Dynamics, x0: np.ndarray, u0: np.ndarray) -> None:
        self._constraint, self._h, self.of_controls = constraint, constraint.of, constraint.takes_controls
        self._given: Callable[..., Any] | None = constraint.derivatives
        self._space, self._nu = space_of(dynamics), dynamics.nu
        self._nx = self._space.nx if constraint.states is None else constraint.states
        self.rows, self.same = 0, id(constraint.of)
        tried = self._called(np.stack([x0, x0]), np.stack([u0, u0]))
        self.rows = tried.shape[1]

    def _called(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(K, R) of states (K, nx) and controls (K, nu)."""
        arguments = (xs[:, : self._nx], us) if self.of_controls else (xs[:, : self._nx],)
        try:
            value = np.asarray(self._h(*arguments), dtype=float)
        except (TypeError, ValueError, IndexError) as error:
            if self.rows:
                raise
            raise PlannerError(
                f"{self._constraint} fails on {len(xs)} states at once ({error}), expected a function of xs (K, nx)"
                f"{' and us (K, nu)' if self.of_controls else ''} that gives (K,) or (K, R)."
            ) from None
        if value.ndim == 1:
            value = value[:, None]
        if value.ndim != 2 or len(value) != len(xs) or (self.rows and value.shape[1] != self.rows) or not value.size:
            raise PlannerError(
                f"{self._constraint} gives an array of shape {value.shape} for {len(xs)} states, expected one number "
                "or one row for each."
            )
        return value

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, R)."""
        return self._called(xs, us)

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, R, ndx) and (K, R, nu): given, or by central differences."""
        K, ndx = len(xs), self._space.ndx
        by_x, by_u = np.zeros((K, self.rows, ndx)), np.zeros((K, self.rows, self._nu))
        if not K:
            return by_x, by_u
        if self._given is None:
            by_x[:] = self._differences(xs, us, ndx, lambda d: (self._space.integrate(xs, d), us), np.ones(ndx))
            if self.of_controls:
                size = np.maximum(1.0, np.abs(us))
                by_u[:] = self._differences(xs, us, self._nu, lambda d: (xs, us + d), size)
            return by_x, by_u
        returned = self._given(xs[:, : self._nx], us) if self.of_controls else (self._given(xs[:, : self._nx]),)
        if not isinstance(returned, tuple) or len(returned) != 1 + self.of_controls:
            raise PlannerError(
                f"{self._constraint}'s derivatives give {short_repr(returned)}, expected those by x and by u."
            )
        for part, into in zip(returned, (by_x, by_u), strict=False):
            part = np.asarray(part, dtype=float)
            own = (K, self.rows, part.shape[-1] if part.ndim == 3 and into is by_x else into.shape[2])
            if part.shape != own or part.shape[2] > into.shape[2]:
                raise PlannerError(
                    f"{self._constraint}'s derivatives have shape {part.shape}, expected {into.shape}: (K, R, ndx) "
                    "and, by controls, (K, R, nu)."
                )
            into[:, :, : part.shape[2]] = part
        return by_x, by_u

    def _differences(self, xs: np.ndarray, us: np.ndarray, size: int, moved: Any, scale: np.ndarray) -> np.ndarray:
        """(K, R, size) central differences along deviations (K, size) of either."""
        J = np.zeros((len(xs), self.rows, size))
        scale = np.broadcast_to(scale, (len(xs), size))
        for j in range(size):
            d = np.zeros((len(xs), size))
            d[:, j] = _DIFFERENCE * scale[:, j]
            J[:, :, j] = (self._called(*moved(d)) - self._called(*moved(-d))) / (2.0 * d[:, j : j + 1])
        return J
