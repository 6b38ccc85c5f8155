"""check_derivatives: the derivatives of a user's dynamics or cost beside differences of its values, entry by entry.

Central differences of two lengths are compared with each derivative. Where they disagree with each other, the function
is not smooth there, and nothing is said of the entry.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, short_repr
from planner.base.errors import PlannerError
from planner.base.measured import aligned
from planner.model.capabilities import capabilities_of
from planner.model.coordinates import controls_of_mechanism, coordinates_of
from planner.model.space import StateSpace, euclidean, origin_of, space_of
from planner.problem.problem import Problem

DERIVATIVE_BOUND = 1e-3
"""Relative error that passes: central differences have 1e-8, forward differences of a user 1e-6."""
AGREES = 0.1  # of an error: differences at two lengths that are further apart are of no smooth function
STEPS = (1e-4, 0.5e-4)  # of differences, relative to the state or control, at least to 1
# Of the largest derivative of the same function, of a cost at the same stage: smaller entries err relative to it.
SMALL = 1e-3
MAX_STAGES = 10  # of a cost, which is differenced one stage after the other
STATES = 5  # at random, where none are given
SPREADS = (0.3, 3.0, 30.0)  # rad, m and units of controls, about the start, one trajectory each
MAX_ROWS, FEW_ROWS = 30, 5  # of the table, where some are wrong and where none is


class DerivativeEntry(NamedTuple):
    """One derivative, at the stage where its error is largest."""

    of: str  # "cost", or a coordinate after the stage
    by: str
    stage: int
    given: float
    differenced: float
    error: float  # relative; NaN where the function is not smooth

    @property
    def passed(self) -> bool:
        """Whether it agrees with the differences, or these say nothing."""
        return not self.error > DERIVATIVE_BOUND


class DerivativeCheck(NamedTuple):
    """The derivatives of a cost, of dynamics or of both; str() is a table, the largest error first."""

    entries: tuple[DerivativeEntry, ...]

    @property
    def passed(self) -> bool:
        """Whether no derivative differs."""
        return all(one.passed for one in self.entries)

    def __str__(self) -> str:
        wrong = sum(not one.passed for one in self.entries)
        rows_shown = MAX_ROWS if wrong else FEW_ROWS
        ordered = sorted(self.entries, key=lambda one: -np.nan_to_num(one.error, nan=-1.0, posinf=np.inf))
        rows = [("derivative of", "by", "stage", "given", "differences", "relative error")]
        rows += [
            (one.of, one.by, str(one.stage), f"{one.given:.6g}", f"{one.differenced:.6g}",
             "not smooth" if np.isnan(one.error) else f"{one.error:.1e}{'' if one.passed else '  WRONG'}")
            for one in ordered[:rows_shown]
        ]  # fmt: skip
        more = len(self.entries) - rows_shown
        tail = [f"and {more} more with smaller errors"] if more > 0 else []
        total = f"{wrong} of {len(self.entries)} derivatives differ from the values by more than {DERIVATIVE_BOUND:g}"
        return "\n".join([*aligned(rows), *tail, total])


def check_derivatives(part: Any, xs: Any = None, us: Any = None) -> DerivativeCheck:
    """Compare the derivatives of dynamics, of a cost, or of both of a problem with differences of their values.

    Args:
        part: A Problem, dynamics with step() and linearize(), or a cost with value() and quadratize().
        xs: (N+1, nx) states at which to compare; by default seeded random ones about the start.
        us: (N, nu) controls; both are needed of a cost that does not know its sizes.

    Returns:
        A table of entries, and whether it `passed`.

    Raises:
        PlannerError: Neither dynamics nor a cost, or states of another size.
    """
    problem = part if isinstance(part, Problem) else None
    dynamics = problem.dynamics if problem else part if callable(getattr(part, "linearize", None)) else None
    cost = problem.cost if problem else part if callable(getattr(part, "quadratize", None)) else None
    if dynamics is None and cost is None:
        raise PlannerError(f"check_derivatives() was given {short_repr(part)}, expected a Problem, dynamics or a cost.")
    spreads = SPREADS if xs is None and us is None else SPREADS[:1]
    tried = [_trajectory(problem, dynamics, cost, xs, us, spread) for spread in spreads]
    xs, us, space = tried[0]
    if dynamics is None:
        states = [f"x[{i}]" for i in range(space.ndx)]
    else:
        states = [one.name for one in coordinates_of(dynamics)]
    mechanism = capabilities_of(dynamics).mechanism
    controls = [one.name for one in controls_of_mechanism(mechanism)] if mechanism is not None else []
    controls += [f"u[{j}]" for j in range(len(controls), us.shape[1])]
    entries: list[DerivativeEntry] = []
    if dynamics is not None:
        entries += _of_dynamics(dynamics, space, xs, us, states, controls)
    # Each term of a sum alone: beside the weights of the end a wrong running term is hardly seen.
    # Penalties act far from the start, where others may not be defined.
    for one in () if cost is None else getattr(cost, "costs", (cost,)):
        name, worst = type(one).__name__ if one is not cost else "cost", dict[str, DerivativeEntry]()
        for k, (xs, us, _) in enumerate(tried):
            if k > 0 and not _is_defined(one, xs, us):
                continue
            for entry in _of_cost(name, one, space, xs, us, states, controls):
                known = worst.setdefault(entry.by, entry)
                if np.nan_to_num(entry.error, nan=-1.0) > np.nan_to_num(known.error, nan=-1.0):
                    worst[entry.by] = entry
        entries += worst.values()
    return DerivativeCheck(tuple(entries))


def _is_defined(cost: Any, xs: np.ndarray, us: np.ndarray) -> bool:
    """Whether a cost has finite values and gradients along states (N+1, nx) and controls (N, nu)."""
    with np.errstate(all="ignore"):
        model = cost.quadratize(xs, us)
        return bool(np.isfinite(cost.value(xs, us)) and np.isfinite(model.q).all() and np.isfinite(model.r).all())


def _trajectory(
    problem: Problem | None, dynamics: Any, cost: Any, xs: Any, us: Any, spread: float
) -> tuple[np.ndarray, np.ndarray, StateSpace]:
    """The states and controls that are given, else random ones that far from the start, and their space."""
    if dynamics is not None:
        space, nu = space_of(dynamics), dynamics.nu
    else:
        own = getattr(cost, "space", None)
        nx, nu = (np.shape(xs)[-1], np.shape(us)[-1]) if xs is not None and us is not None else (None, None)
        nx, nu = getattr(cost, "nx", None) or nx, getattr(cost, "nu", None) or nu
        if nx is None or nu is None:
            raise PlannerError("the cost does not know its sizes, expected xs and us beside it, or a Problem.")
        space = own or euclidean(nx)
    if xs is not None and us is not None:
        us = array("us", us, ("N", nu))
        return array("xs", xs, (len(us) + 1, space.nx)), us, space
    if xs is not None or us is not None:
        raise PlannerError("only one of xs and us is given, expected both or none.")
    N = problem.N if problem else STATES if cost is None else getattr(cost, "N", None) or STATES
    rng, mechanism = np.random.default_rng(0), capabilities_of(dynamics).mechanism
    start = problem.x0 if problem else origin_of(space) if mechanism is None else mechanism.home
    xs = space.integrate(np.tile(start, (N + 1, 1)), spread * rng.normal(size=(N + 1, space.ndx)))
    return xs, spread * rng.normal(size=(N, nu)), space


def _of_dynamics(
    dynamics: Any, space: StateSpace, xs: np.ndarray, us: np.ndarray, states: Sequence[str], controls: Sequence[str]
) -> list[DerivativeEntry]:
    N, ends = len(us), dynamics.step(xs[:-1], us)
    given = np.concatenate(dynamics.linearize(xs, us), axis=2)  # (N, ndx, ndx + nu)

    def after(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return space.difference(dynamics.step(x, u), ends)

    scale = np.abs(given).max(axis=(0, 2), initial=0.0)
    entries = []
    for i, by in enumerate((*states, *controls)):
        one = np.zeros((N, space.ndx + us.shape[1]))
        one[:, i] = np.maximum(1.0, np.abs(us[:, i - space.ndx])) if i >= space.ndx else 1.0

        def along(h: float, one: np.ndarray = one) -> np.ndarray:
            return after(space.integrate(xs[:-1], h * one[:, : space.ndx]), us + h * one[:, space.ndx :])

        found, error = _compared(given[:, :, i], along, one[:, i, None], scale)
        for k, of in enumerate(states):
            n = _worst(error[:, k])
            entries.append(
                DerivativeEntry(f"{of}, next", by, n, float(given[n, k, i]), float(found[n, k]), float(error[n, k]))
            )
    return entries


def _of_cost(
    name: str,
    cost: Any,
    space: StateSpace,
    xs: np.ndarray,
    us: np.ndarray,
    states: Sequence[str],
    controls: Sequence[str],
) -> list[DerivativeEntry]:
    N, model = len(us), cost.quadratize(xs, us)
    stages = np.unique(np.linspace(0, N - 1, min(N, MAX_STAGES)).astype(int)).tolist()
    parts = [(model.q, i, of, stages) for i, of in enumerate(states)]
    parts += [(model.q, i, f"{of} at the end", [N]) for i, of in enumerate(states)]
    parts += [(model.r, j, of, stages) for j, of in enumerate(controls)]
    scale = np.abs(model.q).max(axis=1, initial=0.0)  # (N+1,) of each stage: one far out hides no other
    scale[:N] = np.maximum(scale[:N], np.abs(model.r).max(axis=1, initial=0.0))
    entries = []
    for gradient, i, by, places in parts:
        rows = []
        for n in places:

            def along(h: float, n: int = n, i: int = i, of_state: bool = gradient is model.q) -> np.ndarray:
                dx, du = np.zeros((N + 1, space.ndx)), np.zeros_like(us)
                (dx if of_state else du)[n, i] = h
                return np.array([cost.value(space.integrate(xs, dx), us + du)])

            rows.append(_compared(gradient[n, i : i + 1], along, np.ones(1), scale[n : n + 1]))
        k = _worst(np.array([error[0] for _, error in rows]))
        (found,), (error,) = rows[k]
        entries.append(DerivativeEntry(name, by, places[k], float(gradient[places[k], i]), float(found), float(error)))
    return entries


def _worst(errors: np.ndarray) -> int:
    return int(np.argmax(np.nan_to_num(errors, nan=-1.0, posinf=np.inf)))


def _compared(
    given: np.ndarray, along: Callable[[float], np.ndarray], size: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Differences of `along`, steps of whose variable have `size`, and the relative errors of given derivatives."""
    differences, rounding = [], np.zeros_like(given)
    for h in STEPS:
        ahead, back = along(h), along(-h)
        rounding = 1e-13 * (1.0 + np.maximum(np.abs(ahead), np.abs(back))) / (h * size)
        differences.append((ahead - back) / (2.0 * h * size))
    found = differences[-1]
    error, apart = np.abs(found - given), np.abs(found - differences[0])
    relative = error / np.maximum(np.maximum(np.abs(given), np.abs(found)), np.maximum(SMALL * scale, 1e-300))
    relative = np.where(error <= rounding, 0.0, np.where(apart <= AGREES * error, relative, np.nan))
    return found, np.where(np.isfinite(error), relative, np.inf)
