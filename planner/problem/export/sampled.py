"""A plan at its knots, or at any rate.

Controls are constant over a stage: us[n] at time t in stage n. States between knots are integrated over a part of the
stage by the plan's dynamics; so quaternions remain unit ones, and states at knots are bitwise equal. Without an
integrator (a plan without its problem, discrete dynamics) states are interpolated on the state space:
x = integrate(x_n, s difference(x_n+1, x_n)), 0 <= s <= 1.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, number
from planner.base.errors import PlannerError
from planner.model.space import StateSpace
from planner.model.twin import Twin

_ROUNDING = 1e-9  # relative distance below which a time counts as a knot


class ExportedMotion(Protocol):
    """Attributes of a plan that exports read."""

    @property
    def t(self) -> np.ndarray: ...  # noqa: D102
    @property
    def xs(self) -> np.ndarray: ...  # noqa: D102
    @property
    def us(self) -> np.ndarray: ...  # noqa: D102
    @property
    def problem(self) -> Any: ...  # noqa: D102
    @property
    def space(self) -> StateSpace: ...  # noqa: D102
    @property
    def twin(self) -> Twin | None: ...  # noqa: D102


class Samples(NamedTuple):
    """A plan at M instants; the last one is its end."""

    t: np.ndarray  # (M,) s
    xs: np.ndarray  # (M, nx) states
    us: np.ndarray  # (M, nu) controls that act from t on; at the end those of the last stage
    stages: np.ndarray  # (M,) the stage n of each instant: gains are K[n]


def sampled(plan: ExportedMotion, rate: float | None = None) -> Samples:
    """The plan at its knots, or at `rate` Hz and at its end.

    The last step is shorter than the others where the duration is no whole number of them.

    Raises:
        PlannerError: The rate is not a number above 0 or gives too many samples, or the plan is not finite.
    """
    if not (np.isfinite(plan.xs).all() and np.isfinite(plan.us).all()):
        raise PlannerError("the plan has states or controls that are not finite, expected one that can be used.")
    N, dt = len(plan.us), float(plan.t[-1]) / len(plan.us)
    if rate is None:
        stages = np.minimum(np.arange(N + 1), N - 1)
        return Samples(plan.t.copy(), plan.xs.copy(), plan.us[stages], stages)
    rate = number("rate", rate, greater_than=0.0)
    periods = float(plan.t[-1]) * rate
    if not periods < LONGEST_HORIZON:
        raise PlannerError(
            f"rate is {rate:g} Hz, expected less: {periods:.3g} samples are more than {LONGEST_HORIZON}."
        )
    t = np.append(np.arange(math.ceil(periods * (1.0 - _ROUNDING))) / rate, plan.t[-1])
    stages = np.minimum(np.floor(t / dt * (1.0 + _ROUNDING)).astype(np.int64), N - 1)
    return Samples(t, _states(plan, t, stages, dt), plan.us[stages], stages)


def _states(plan: ExportedMotion, t: np.ndarray, stages: np.ndarray, dt: float) -> np.ndarray:
    """The states (M, nx) at instants t (M,) of some stages (M,)."""
    parts = t / dt - stages  # of a stage, 0 to 1
    xs = plan.xs[stages]
    xs[parts > 1.0 - _ROUNDING] = plan.xs[-1]
    inside = np.flatnonzero((parts > _ROUNDING) & (parts < 1.0 - _ROUNDING))
    if len(inside) == 0:
        return xs
    n, dynamics = stages[inside], getattr(plan.problem, "dynamics", None)
    if dynamics is not None and getattr(dynamics, "integrator", None) != "discrete":
        xs[inside] = dynamics.step(plan.xs[n], plan.us[n], dt * parts[inside])
    else:
        ways = plan.space.difference(plan.xs[n + 1], plan.xs[n])
        xs[inside] = plan.space.integrate(plan.xs[n], parts[inside, None] * ways)
    return xs
