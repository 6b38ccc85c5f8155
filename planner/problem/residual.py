"""Residual: a number, or a few, of a machine's state and control, with a name and a unit.

A cost weighs it (planner.costs.LeastSquares), a constraint bounds it (planner.Constraint), a plan's file stores it by
the name of its class and its parameters. Those of the library are in planner.constraints and have kernels; a class of
your own derives from Residual and is evaluated in Python beside the compiled terms.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.model.space import StateSpace, space_of

_DIFFERENCE = float(np.cbrt(np.finfo(float).eps))
"""Relative and absolute step of central differences: smallest error of rounding and truncation."""


class ResidualFunction(Protocol):
    """A residual of one machine: R functions of a state, or of a state and a control.

    States (K, nx) and controls (K, nu) are at or after the knots n (K,). Derivatives are with respect to deviations dx
    (see planner.model.space) and, where `of_controls`, to controls.
    """

    rows: int
    of_controls: bool
    same: Any  # equal for equal functions, hashable

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, R)."""
        ...

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, R, ndx) and (K, R, nu)."""
        ...


class Residual:
    """Base class of a residual; write `value`, and `jacobian` where differences are too slow.

    The arguments of the constructor are its parameters: each is kept as an attribute of the same name, as a dataclass
    does, and is a JSON value or an array of numbers. So a plan's file can store it.

    Attributes:
        dim: Number of components.
        unit: Of the components.
        name: For messages, proof and pictures; by default that of the class.
        names: (dim,) of the components, for pictures; optional.
        of_controls: Whether it depends on the control too; it then has no value at the end.
    """

    dim: int = 1
    unit: str = ""
    name: str = ""
    names: tuple[str, ...] = ()
    of_controls: bool = False

    def value(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> Any:
        """Values (K, dim), or (K,) where dim is 1, of states xs (K, nx) and controls us (K, nu) of the dynamics."""
        raise NotImplementedError

    def jacobian(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> Any:
        """Derivatives (K, dim, ndx) by a deviation of the state; where `of_controls` a pair of that and (K, dim, nu).

        By default None: central differences of `value`.
        """
        return None

    def __str__(self) -> str:
        return self.name or type(self).__name__

    def residual_function(self, dynamics: Dynamics, N: int) -> ResidualFunction:
        """The residual of a machine, for N stages."""
        return PythonResidual(self, dynamics)

    def parameters(self) -> dict[str, Any]:
        """Arguments of the constructor by name, as JSON values.

        Raises:
            PlannerError: One is no attribute, or no JSON value or array of numbers.
        """
        found = {}
        for name in inspect.signature(type(self)).parameters:
            try:
                found[name] = json.loads(json.dumps(getattr(self, name), default=_array_as_list))
            except (AttributeError, TypeError, ValueError):
                raise PlannerError(
                    f"the residual {type(self).__name__} has no parameter {name!r} that a file can hold, expected "
                    f"an attribute {name} that is a number, a text, a list, a table or an array of these."
                ) from None
        return found


def _array_as_list(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError


class PythonResidual:
    """A Residual in Python, of a machine: its shapes checked.

    Args:
        residual: To be evaluated.
        dynamics: Of the problem.
        states: Number of leading entries of a state that it takes; None for all.
    """

    def __init__(self, residual: Residual, dynamics: Dynamics, states: int | None = None) -> None:
        if not isinstance(residual.dim, int) or residual.dim < 1:
            raise PlannerError(f"the residual {residual} has dim = {short_repr(residual.dim)}, expected at least 1.")
        self.residual, self.rows, self.of_controls = residual, residual.dim, residual.of_controls
        self._dynamics, self._space, self._nu = dynamics, space_of(dynamics), dynamics.nu
        self._nx = self._space.nx if states is None else states
        self.same = id(residual)

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, R)."""
        value = np.asarray(self.residual.value(self._dynamics, xs[:, : self._nx], us), dtype=float)
        value = value[:, None] if value.ndim == 1 else value
        if value.shape != (len(xs), self.rows):
            raise PlannerError(
                f"{self.residual} gives an array of shape {value.shape} for {len(xs)} states, expected "
                f"{(len(xs), self.rows)}: one row for each."
            )
        return value

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, R, ndx) and (K, R, nu)."""
        K, ndx = len(xs), self._space.ndx
        by_x, by_u = np.zeros((K, self.rows, ndx)), np.zeros((K, self.rows, self._nu))
        if not K:
            return by_x, by_u
        returned = self.residual.jacobian(self._dynamics, xs[:, : self._nx], us)
        if returned is None:
            varied = us if self.of_controls else us[:, :0]
            by_x, by_u[:, :, : varied.shape[1]] = central_differences(
                lambda x, u: self.values(x, u if self.of_controls else us, n), self._space, xs, varied, self.rows
            )
            return by_x, by_u
        parts = returned if self.of_controls else (returned,)
        if not isinstance(parts, tuple) or len(parts) != 1 + self.of_controls:
            raise PlannerError(
                f"{self.residual}'s derivatives give {short_repr(returned)}, expected those by x and by u."
            )
        for part, into in zip(parts, (by_x, by_u), strict=False):
            part = np.asarray(part, dtype=float)
            fits = part.ndim == 3 and part.shape[:2] == (K, self.rows) and part.shape[2] <= into.shape[2]
            if not fits or (into is by_u and part.shape != into.shape):
                raise PlannerError(
                    f"{self.residual}'s derivatives have shape {part.shape}, expected {into.shape}: (K, R, ndx) "
                    "and, by controls, (K, R, nu)."
                )
            into[:, :, : part.shape[2]] = part
        return by_x, by_u


def central_differences(
    value: Callable[[np.ndarray, np.ndarray], Any], space: StateSpace, xs: np.ndarray, us: np.ndarray, rows: int
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (K, rows, ndx) and (K, rows, nu) of a function of states (K, nx) and controls (K, nu)."""
    K = len(xs)

    def along(size: int, at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], scale: np.ndarray) -> np.ndarray:
        J = np.zeros((K, rows, size))
        for j in range(size):
            d = np.zeros((K, size))
            d[:, j] = _DIFFERENCE * scale[:, j]
            up, down = (np.reshape(value(*at(one)), (K, rows)) for one in (d, -d))
            J[:, :, j] = (up - down) / (2.0 * d[:, j : j + 1])
        return J

    by_x = along(space.ndx, lambda d: (space.integrate(xs, d), us), np.ones((K, space.ndx)))
    return by_x, along(us.shape[1], lambda d: (xs, us + d), np.maximum(1.0, np.abs(us)))
