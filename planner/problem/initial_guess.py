"""First guesses: the trajectory of a plan, controls by inverse dynamics (Eq. 6), states along a straight line.

A Trajectory has the states, controls and gains of a plan without its problem; shifted, stretched, or at other knots.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import number
from planner.base.errors import PlannerError
from planner.dynamics.algorithms import rnea
from planner.dynamics.joint_forces import actuator_lengths, friction_forces, gains_at, passive_forces
from planner.dynamics.loops import constraint_jacobians
from planner.model.actuators import DIRECT
from planner.model.capabilities import capabilities_of, stationary_object_dofs
from planner.model.mechanism import SCREW, Mechanism
from planner.model.space import StateSpace
from planner.problem.constraints.trajectory_constraints import BoundPenalties, TrajectoryConstraints

_REDUNDANT = 1e-9  # relative rank tolerance of the closure Jacobian J, for dependent equations
_WEAK_DIRECTION_RATIO = 1e-6  # relative rank tolerance of the map from controls to generalized forces


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
    return ScaledMultipliers(*kept.inward_shifts(penalties), penalties.weight)


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
    return slice(0, 0) if mechanism is None else mechanism.velocities


def inverse_dynamics_controls(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Controls (N, nu) along a trajectory by inverse dynamics, M(q) qdd + bias(q, qd) = tau + J'f (Eq. 6).

    The trajectory q (N, nq), qd and qdd (N, nv) satisfies couplings and closed chains. Actuators have no activations
    and actuate every direction of motion of the machine, except stationary objects. With couplings the reduced forces
    are G' tau; closure forces f balance the constrained directions. Redundant actuators get minimum-norm controls.
    """
    actuators = mechanism.actuators
    G = mechanism.independent_directions
    G = G[:, ~np.any(G[stationary_object_dofs(mechanism)], axis=0)]
    lengths, rates = actuator_lengths(mechanism, q), qd @ actuators.moment.T
    gain = gains_at(actuators, lengths, rates)
    reach = G.T @ (actuators.moment.T * gain[0])
    closed = mechanism.has_closed_chains
    by_wrenches = bool(actuators.wrenches)  # reach is that of joints and tendons, constant
    indirect = by_wrenches or np.any(actuators.dynamics != DIRECT) or np.any(gain != gain[0])
    if indirect or (not closed and np.linalg.matrix_rank(reach) < len(reach)):
        raise PlannerError("the actuators do not reach every joint directly, expected a fully actuated machine.")
    force = passive_forces(actuators, lengths, rates)
    tree = replace(mechanism, loops=(), polynomial_couplings=()) if closed else mechanism
    tau = rnea(tree, q, qd, qdd) - friction_forces(mechanism, qd, qdd)[0] - force @ actuators.moment
    if not closed:
        return np.linalg.lstsq(reach, G.T @ tau.T, rcond=None)[0].T
    JG = constraint_jacobians(mechanism, q) @ G
    P = np.eye(G.shape[1]) - np.linalg.pinv(JG, rcond=_REDUNDANT) @ JG  # projection on the null space of JG
    reach = P @ reach
    values = np.linalg.svd(reach, compute_uv=False)
    ways = round(float(np.trace(P, axis1=1, axis2=2).max()))
    if np.count_nonzero(values > _WEAK_DIRECTION_RATIO * values.max(initial=0.0), axis=1).max() < ways:
        raise PlannerError("the actuators do not move closed chains in every way, expected a fully actuated machine.")
    return (np.linalg.pinv(reach, rcond=_WEAK_DIRECTION_RATIO) @ (P @ (tau @ G)[:, :, None]))[:, :, 0]


def straight_line(mechanism: Mechanism, x0: np.ndarray, goal: np.ndarray, duration: float, N: int) -> np.ndarray | None:
    """Controls (N, nu) along the straight line in joint space from x0 to goal, both (nx,); None if not applicable.

    Applicable to a fully actuated tree of hinges and slides without contacts, from rest to rest. Stationary objects
    remain at rest.
    """
    nq, nv, v = mechanism.nq, mechanism.nv, mechanism.velocities
    closed = mechanism.has_closed_chains
    lies = stationary_object_dofs(mechanism)
    if np.any(mechanism.kind[~lies] != SCREW) or np.any(mechanism.space.difference(goal, x0)[:nv][lies]):
        return None
    if mechanism.contacts or mechanism.body_contacts or closed or np.any(x0[v]) or np.any(goal[v]):
        return None
    q, *rates = quintic(x0[:nq], goal[:nq], duration, N)
    try:
        return inverse_dynamics_controls(
            mechanism, q, *(np.where(lies, 0.0, rate[:, mechanism.q_address]) for rate in rates)
        )
    except PlannerError:  # the actuators do not reach every joint
        return None


def quintic(start: np.ndarray, goal: np.ndarray, duration: float, N: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fifth-order polynomial trajectory from rest to rest, sampled in the middle of each of N stages.

    The middle makes the guess second-order accurate for a control that is constant over a stage.

    From start (n,) to goal (n,) in duration s: positions, velocities and accelerations, each (N, n).
    """
    share, rate, acceleration = minimum_jerk((np.arange(N)[:, None] + 0.5) / N)
    displacement = goal - start
    return start + share * displacement, rate * displacement / duration, acceleration * displacement / duration**2


def minimum_jerk(s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The minimum-jerk time law from rest to rest (Flash and Hogan 1985): 0 at s = 0, 1 at s = 1.

    Args:
        s: Any shape, time over the duration, 0 to 1.

    Returns:
        The share of the displacement and its first and second derivatives with respect to s, each shaped as s.
    """
    return (
        10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5,
        30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4,
        60.0 * s - 180.0 * s**2 + 120.0 * s**3,
    )


def interpolated_states(space: StateSpace, x0: np.ndarray, goal: np.ndarray, duration: float, N: int) -> np.ndarray:
    """States (N+1, nx) along the straight line from x0 to goal, both (nx,), by the time law minimum_jerk.

    If a state has as many velocities as positions, velocities are the derivatives of this trajectory. Other entries
    are interpolated with the same time law.
    """
    s = np.linspace(0.0, 1.0, N + 1)[:, None]
    displacement = space.difference(goal, x0)
    share, rate, _ = minimum_jerk(s)
    dxs, nv = share * displacement, space.ndx // 2
    if space.ndx == 2 * nv:
        dxs[:, nv:] += rate / duration * displacement[:nv]
    return space.integrate(x0, dxs)
