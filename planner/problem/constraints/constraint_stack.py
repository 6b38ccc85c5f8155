"""ConstraintStack: the components of all constraints of a problem over its stages, scaled to one tolerance.

A component of states applies at every knot but the start, which is given. One of states and controls applies at both
ends of each stage, h(x(n), u(n)) and h(x(n+1), u(n)), since the control is constant over it; the derivative of the
second is chained with A and B of Eq. 35. Components are multiplied by `scale`, so that one tolerance applies to all.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.problem.constraints.constraint import Constraint, bounds_of, residual_of
from planner.problem.constraints.quantities import KernelResidual
from planner.problem.residual import ResidualFunction


class Violation(NamedTuple):
    """The largest violation of a constraint."""

    constraint: Constraint
    value: float  # in the constraint's unit
    at: int  # index of the state


class StackEntry(NamedTuple):
    """A constraint, its function and the columns of its components."""

    constraint: Constraint
    function: ResidualFunction
    columns: slice
    at_end: bool  # Whether it applies at the end of each stage, with the control of that stage


class ConstraintStack:
    """The components of constraints along N stages.

    Args:
        constraints: Of the problem.
        dynamics: Of the problem.
        x0: (nx,) start.
        us: (N, nu) first guess.
        tolerance: The largest scaled violation that passes.

    Attributes:
        names: (C,) of the components.
        scale: (C,) factors of the components.
        specified_lower: (N+1, C) scaled lower bounds; -inf if unbounded.
        specified_upper: (N+1, C) scaled upper bounds.
        lower: (N+1, C) the same, but unbounded at the start for components of states alone.
        upper: (N+1, C).

    Raises:
        PlannerError: As Constraint; a start that breaks a constraint, constraints that contradict each other.
    """

    def __init__(
        self, constraints: Sequence[Constraint], dynamics: Dynamics, x0: np.ndarray, us: np.ndarray, tolerance: float
    ) -> None:
        self.N, self.parts, columns = len(us), list[StackEntry](), 0
        lower, upper, scale, names, of_start = [], [], [], list[str](), []
        for constraint in constraints:
            function = residual_of(constraint, dynamics, self.N, x0, us[0])
            asked = constraint.stages(self.N, dynamics.dt)
            if function.of_controls:
                asked[-1] = False
                if not asked.any():
                    raise PlannerError(f"{constraint} is of controls at the end, where there are none, expected h(xs).")
            low, high = (
                np.where(asked[:, None] & ~np.isnan(side), side, none)
                for side, none in zip(bounds_of(constraint, function, self.N), (-np.inf, np.inf), strict=True)
            )
            if not (np.isfinite(low).any() or np.isfinite(high).any()):
                raise PlannerError(f"{constraint} asks for nothing at any stage, expected a number at one.")
            for at_end in (False, True)[: 1 + function.of_controls]:
                self.parts.append(StackEntry(constraint, function, slice(columns, columns + function.rows), at_end))
                columns += function.rows
                lower.append(low)
                upper.append(high)
                scale += function.rows * [tolerance / constraint.allowed()]
                names += function.rows * [constraint.name]
                of_start += function.rows * [function.of_controls]
        self.names, self.scale, self.tolerance = tuple(names), np.array(scale), tolerance
        self.specified_lower, self.specified_upper = (
            self.scale * np.concatenate(side, axis=1) for side in (lower, upper)
        )
        given = ~np.array(of_start)
        self.lower, self.upper = self.specified_lower.copy(), self.specified_upper.copy()
        self.lower[0, given], self.upper[0, given] = -np.inf, np.inf
        self._check_each_other(dynamics.dt)  # first: no other start can satisfy them
        self._check_start(x0, us[0])

    def _check_start(self, x0: np.ndarray, u0: np.ndarray) -> None:
        """Refuse a start that violates a constraint of states."""
        for part in self.parts:
            if part.function.of_controls:
                continue
            value = part.function.values(x0[None], u0[None], np.zeros(1, dtype=int))[0]
            if not np.isfinite(value).all():
                raise PlannerError(
                    f"{part.constraint} is {short_repr(value.tolist())} at the start, expected finite numbers."
                )
            scale = self.scale[part.columns]
            low, high = self.specified_lower[0, part.columns] / scale, self.specified_upper[0, part.columns] / scale
            violation = np.maximum(low - value, value - high)
            if violation.max() > part.constraint.allowed():
                r = int(np.argmax(violation))
                asked = f"at least {low[r]:.6g}" if low[r] > value[r] else f"at most {high[r]:.6g}"
                asked = f"{high[r]:.6g}" if low[r] == high[r] else asked
                unit = f" {part.constraint.unit}".rstrip()
                raise PlannerError(
                    f"the start breaks {part.constraint}: it is {value[r]:.6g}{unit} there, expected {asked}{unit}; "
                    "start elsewhere, or ask for it later by when=(from, to)."
                )

    def _check_each_other(self, dt: float) -> None:
        """Refuse constraints of equal functions whose bounds contradict each other."""
        by_function: dict[Any, list[StackEntry]] = {}
        for part in self.parts:
            by_function.setdefault((part.function.same, part.at_end), []).append(part)
        for alike in by_function.values():
            for a, b in itertools.permutations(alike, 2):
                low, high = (side[:, part.columns] / self.scale[part.columns] for side, part in
                             ((self.specified_lower, a), (self.specified_upper, b)))  # fmt: skip
                contradicts = low - high > a.constraint.allowed() + b.constraint.allowed()
                if contradicts.any():
                    n, r = map(int, np.argwhere(contradicts)[0])
                    raise PlannerError(
                        f"{a.constraint} asks for at least {low[n, r]:.6g} and {b.constraint} for at most "
                        f"{high[n, r]:.6g} at t = {n * dt:.4g} s, expected bounds that leave something between them."
                    )

    @property
    def constraints(self) -> tuple[Constraint, ...]:
        """The problem's own constraints, and the ranges of tendons."""
        return tuple({id(part.constraint): part.constraint for part in self.parts}.values())

    def subset(self, parts: Sequence[StackEntry]) -> tuple[ConstraintStack, np.ndarray]:
        """The stack of some of the parts, and their columns in this one."""
        few, first, columns = copy(self), 0, [np.arange(len(self.scale))[part.columns] for part in parts]
        few.parts = []
        for part, own in zip(parts, columns, strict=True):
            few.parts.append(part._replace(columns=slice(first, first + len(own))))
            first += len(own)
        which = np.concatenate([np.empty(0, dtype=int), *columns])
        few.scale, few.names = self.scale[which], tuple(self.names[c] for c in which)
        few.specified_lower, few.specified_upper, few.lower, few.upper = (
            side[:, which] for side in (self.specified_lower, self.specified_upper, self.lower, self.upper)
        )
        return few, which

    def values(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(N+1, C) scaled, of states xs (N+1, nx) and controls us (N, nu); 0 at the end for those of controls."""
        found, n = np.zeros((self.N + 1, len(self.scale))), np.arange(self.N + 1)
        padded = np.concatenate([us, us[-1:]])
        for function, columns, at_end in ((part.function, part.columns, part.at_end) for part in self.parts):
            if function.of_controls:
                found[:-1, columns] = function.values(xs[1:] if at_end else xs[:-1], us, n[:-1])
            else:
                found[:, columns] = function.values(xs, padded, n)
        return found * self.scale

    def derivatives(
        self, xs: np.ndarray, us: np.ndarray, A: np.ndarray, B: np.ndarray, active: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(N+1, C, ndx) and (N, C, nu) of the components where `active` (N+1, C); zero elsewhere."""
        N, nu = us.shape
        by_x, by_u = np.zeros((N + 1, len(self.scale), A.shape[1])), np.zeros((N, len(self.scale), nu))
        padded = np.concatenate([us, us[-1:]])
        for _, function, columns, at_end in self.parts:
            n = np.flatnonzero(active[:, columns].any(axis=1))
            if not len(n):
                continue
            Hx, Hu = function.derivatives(xs[n + at_end], padded[n], n)
            if at_end:
                by_x[n, columns], by_u[n, columns] = Hx @ A[n], Hu + Hx @ B[n]
            else:
                by_x[n, columns] = Hx
                if function.of_controls:
                    by_u[n, columns] = Hu
        return by_x * self.scale[:, None], by_u * self.scale[:, None]

    def second_derivatives(self, xs: np.ndarray, n: np.ndarray, gradients: np.ndarray) -> np.ndarray | float:
        """(K, ndx, ndx) at knots n (K,), the components' curvature weighted by penalty gradients (K, C); 0 for none."""
        own = gradients * self.scale
        return sum(
            part.function.second_derivatives(xs[n], n, own[:, part.columns])
            for part in self.parts if isinstance(part.function, KernelResidual)
        )  # fmt: skip

    def violation(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(M+1, C) in the constraints' own units, 0 within bounds, of states (M+1, nx) and controls (M, nu).

        At the knots (M = N), or at M/N equal parts of every stage. Between two knots the looser of their bounds
        applies.
        """
        M = len(us)
        parts = M // self.N
        at = np.arange(M + 1)
        n = at // parts
        inside = at % parts > 0
        later = np.minimum(n + 1, self.N)
        found = np.zeros((M + 1, len(self.scale)))
        for _, function, columns, at_end in self.parts:
            low, high = self.specified_lower[:, columns], self.specified_upper[:, columns]
            if function.of_controls:
                stages = n[:-1]
                value = function.values(xs[1:] if at_end else xs[:-1], us, stages)
                own = value, low[stages], high[stages], slice(0, M)
            else:
                value = function.values(xs, np.concatenate([us, us[-1:]]), n)
                is_free = inside[:, None]
                own = (
                    value, np.where(is_free, np.minimum(low[n], low[later]), low[n]),
                    np.where(is_free, np.maximum(high[n], high[later]), high[n]), slice(0, M + 1),
                )  # fmt: skip
            value, low, high, rows = own
            scale = self.scale[columns]
            found[rows, columns] = np.maximum(np.maximum(value - high / scale, low / scale - value), 0.0)
        return found

    def violations(self, xs: np.ndarray, us: np.ndarray) -> list[Violation]:
        """The largest violation of each constraint along states xs (M+1, nx) and controls us (M, nu)."""
        violation, found = self.violation(xs, us), dict[int, Violation]()
        violation = np.where(np.isfinite(violation), violation, np.inf)
        for part in self.parts:
            own = violation[:, part.columns].max(axis=1)
            at = int(np.argmax(own))
            one = Violation(part.constraint, float(own[at]), at + part.at_end)
            before = found.get(id(part.constraint))
            if before is None or one.value > before.value:
                found[id(part.constraint)] = one
        return list(found.values())
