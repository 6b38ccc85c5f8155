"""Motion: what a plan does, apart from the problem that it solves; shifted, stretched, and sampled at other knots."""

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
    """Shifts of the penalized bounds, inwards, by the multipliers of ranges and constraints; weights."""

    low: np.ndarray  # (N+1, H)
    high: np.ndarray  # (N+1, H)
    weight: np.ndarray  # (N+1, H)

    def penalties(self, kept: TrajectoryConstraints) -> BoundPenalties | None:
        """Those of another problem with as many ranges and knots; None where it has others."""
        if self.weight.shape != kept.lower.shape:
            return None
        used = np.isfinite(kept.lower) | np.isfinite(kept.upper)
        return BoundPenalties(kept.lower + self.low, kept.upper - self.high, np.where(used, self.weight, 0.0))


def scaled_multipliers(
    kept: TrajectoryConstraints | None, penalties: BoundPenalties | None
) -> ScaledMultipliers | None:
    """Those of trajectory constraints and the penalties that a plan ended with; None where it has none."""
    if kept is None or penalties is None:
        return None
    with np.errstate(invalid="ignore"):  # of bounds that are infinite
        shifts = penalties.lower - kept.lower, kept.upper - penalties.upper
    low, high = (np.nan_to_num(shift, nan=0.0) for shift in shifts)
    return ScaledMultipliers(low, high, penalties.weight)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States and controls over time with the gains that hold them: a first guess for solve(warm_start=...).

    Attributes:
        t: (N+1,) s, the knots; the first is not 0 where it was shifted.
        xs: (N+1, nx) states.
        us: (N, nu) controls, each held over its stage.
        K: (N, nu, ndx) gains.
        space: Where the states lie.
        rates: Which entries of a state are velocities; none for dynamics without a mechanism.
        pulls: Of ranges and constraints; None where nothing was held.
    """

    t: np.ndarray
    xs: np.ndarray
    us: np.ndarray
    K: np.ndarray
    space: StateSpace
    rates: slice
    pulls: ScaledMultipliers | None = None

    def shifted(self, seconds: float) -> Trajectory:
        """The same `seconds` earlier: what is left of it from then on; at its end it stays where it is.

        Negative seconds wait at the start as long.

        Raises:
            PlannerError: seconds is no finite number.
        """
        return replace(self, t=self.t - number("seconds", seconds))

    def stretched(self, duration: float) -> Trajectory:
        """The same states in another duration, s, with velocities of that pace; controls as they are.

        Raises:
            PlannerError: duration is not above 0.
        """
        ratio = number("duration", duration, greater_than=0.0) / float(self.t[-1] - self.t[0])
        xs = self.xs.copy()
        xs[:, self.rates] /= ratio
        return replace(self, t=self.t[0] + ratio * (self.t - self.t[0]), xs=xs)

    def at(self, t: np.ndarray) -> Trajectory:
        """The same at other knots t (M+1,): states between its own are interpolated, at rest before and after it.

        Controls and gains of a stage are those in its middle.
        """
        middle = 0.5 * (t[:-1] + t[1:])
        held = np.clip(np.searchsorted(self.t, middle, side="right") - 1, 0, len(self.us) - 1)
        n = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.us) - 1)
        share = np.clip((t - self.t[n]) / (self.t[n + 1] - self.t[n]), 0.0, 1.0)
        xs = self.xs[n].copy()
        inside = share > 0.0  # at its own knots the states are its own to the last bit
        displacement = self.space.difference(self.xs[n + 1], self.xs[n])
        xs[inside] = self.space.integrate(self.xs[n], share[:, None] * displacement)[inside]
        xs[share == 1.0] = self.xs[n + 1][share == 1.0]
        slack = 1e-9 * float(self.t[-1] - self.t[0])
        out = (t < self.t[0] - slack) | (t > self.t[-1] + slack)
        xs[np.ix_(out, np.arange(xs.shape[1])[self.rates])] = 0.0
        pulls = self.pulls
        if pulls is not None:  # the end's are of the end
            near = np.minimum(np.searchsorted(0.5 * (self.t[:-1] + self.t[1:]), t), len(self.us) - 1)
            near[-1] = len(self.us)
            out[-1] = False
            inside = ~out[:, None]
            pulls = ScaledMultipliers(pulls.low[near] * inside, pulls.high[near] * inside, pulls.weight[near])
        return replace(self, t=t, xs=xs, us=self.us[held], K=self.K[held], pulls=pulls)


def rates_of(dynamics: Any) -> slice:
    """The entries of a state that are velocities; none for dynamics without a mechanism."""
    mechanism = capabilities_of(dynamics).mechanism
    return slice(0, 0) if mechanism is None else slice(mechanism.nq, mechanism.nq + mechanism.nv)
