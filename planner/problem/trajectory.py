"""Trajectory: states, controls and gains of a plan without its problem; shifted, stretched, or at other knots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import number
from planner.model.capabilities import capabilities_of
from planner.model.space import StateSpace
from planner.problem.constraints.trajectory_constraints import TrajectoryConstraints
from planner.problem.state_bounds import BoundPenalties


class ScaledMultipliers(NamedTuple):
    """Scaled multipliers of state bounds and constraints: inward shifts of the penalized bounds; penalty weights."""

    low: np.ndarray  # (N+1, H) shift of the lower bounds
    high: np.ndarray  # (N+1, H) shift of the upper bounds
    weight: np.ndarray  # (N+1, H) penalty weights

    def penalties(self, kept: TrajectoryConstraints) -> BoundPenalties | None:
        """The penalties for another problem's bounds of the same shape; None for another shape."""
        if self.weight.shape != kept.lower.shape:
            return None
        used = np.isfinite(kept.lower) | np.isfinite(kept.upper)
        return BoundPenalties(kept.lower + self.low, kept.upper - self.high, np.where(used, self.weight, 0.0))


def scaled_multipliers(
    kept: TrajectoryConstraints | None, penalties: BoundPenalties | None
) -> ScaledMultipliers | None:
    """Scaled multipliers from trajectory constraints and a plan's last penalties; None without either."""
    if kept is None or penalties is None:
        return None
    with np.errstate(invalid="ignore"):  # of bounds that are infinite
        shifts = penalties.lower - kept.lower, kept.upper - penalties.upper
    low, high = (np.nan_to_num(shift, nan=0.0) for shift in shifts)
    return ScaledMultipliers(low, high, penalties.weight)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States and controls over time with feedback gains: a first guess for solve(warm_start=...).

    Attributes:
        t: (N+1,) s, the knots; the first is not 0 after shifted().
        xs: (N+1, nx) states.
        us: (N, nu) controls, constant over each stage.
        K: (N, nu, ndx) feedback gains.
        space: State space.
        rates: Indices of the velocities in a state; empty for dynamics without a mechanism.
        pulls: Scaled multipliers of state bounds and constraints; None without either.
    """

    t: np.ndarray
    xs: np.ndarray
    us: np.ndarray
    K: np.ndarray
    space: StateSpace
    rates: slice
    pulls: ScaledMultipliers | None = None

    def shifted(self, seconds: float) -> Trajectory:
        """The trajectory `seconds` earlier, at rest after its end; later, at rest before its start, if negative.

        Raises:
            PlannerError: seconds is no finite number.
        """
        return replace(self, t=self.t - number("seconds", seconds))

    def stretched(self, duration: float) -> Trajectory:
        """The same states over another duration, s, with velocities scaled to it; controls unchanged.

        Raises:
            PlannerError: duration is not above 0.
        """
        ratio = number("duration", duration, greater_than=0.0) / float(self.t[-1] - self.t[0])
        xs = self.xs.copy()
        xs[:, self.rates] /= ratio
        return replace(self, t=self.t[0] + ratio * (self.t - self.t[0]), xs=xs)

    def at(self, t: np.ndarray) -> Trajectory:
        """The trajectory at other knots t (M+1,): states interpolated between its knots, at rest before and after.

        Controls and gains of a stage are those at the time of its middle.
        """
        middle = 0.5 * (t[:-1] + t[1:])
        held = np.clip(np.searchsorted(self.t, middle, side="right") - 1, 0, len(self.us) - 1)
        n = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.us) - 1)
        share = np.clip((t - self.t[n]) / (self.t[n + 1] - self.t[n]), 0.0, 1.0)
        xs = self.xs[n].copy()
        inside = share > 0.0  # at its own knots the states are bitwise equal
        displacement = self.space.difference(self.xs[n + 1], self.xs[n])
        xs[inside] = self.space.integrate(self.xs[n], share[:, None] * displacement)[inside]
        xs[share == 1.0] = self.xs[n + 1][share == 1.0]
        slack = 1e-9 * float(self.t[-1] - self.t[0])
        out = (t < self.t[0] - slack) | (t > self.t[-1] + slack)
        xs[np.ix_(out, np.arange(xs.shape[1])[self.rates])] = 0.0
        pulls = self.pulls
        if pulls is not None:  # the last knot takes the multipliers of the end
            near = np.minimum(np.searchsorted(0.5 * (self.t[:-1] + self.t[1:]), t), len(self.us) - 1)
            near[-1] = len(self.us)
            out[-1] = False
            inside = ~out[:, None]
            pulls = ScaledMultipliers(pulls.low[near] * inside, pulls.high[near] * inside, pulls.weight[near])
        return replace(self, t=t, xs=xs, us=self.us[held], K=self.K[held], pulls=pulls)


def rates_of(dynamics: Any) -> slice:
    """Indices of the velocities in a state; empty for dynamics without a mechanism."""
    mechanism = capabilities_of(dynamics).mechanism
    return slice(0, 0) if mechanism is None else slice(mechanism.nq, mechanism.nq + mechanism.nv)
