"""Bounds of the controls: constant for each stage, and for servos dependent on the state; from a model's clamps.

A servo's force is F = gain u + bias[0] + bias[1] length + bias[2] length rate, and a clamp limits F. So its control has
bounds that are affine in the state, u within (F - bias(x)) / gain, and its ctrlrange. The control is constant over a
stage while the joints move: a second pair of bounds uses the lengths at the stage's end, predicted by the velocities at
its start. If the two pairs contradict each other, both bounds are their mean; if they are outside of the ctrlrange, its
nearest end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from planner.model.actuators import DIRECT
from planner.model.mechanism import SCREW, Mechanism

AT_BOUND = 1e-11  # as in kernels.lq.bounded_riccati


class StepBounds(NamedTuple):
    """Bounds of the change of each control at a trajectory, and their derivatives by the state."""

    lower: np.ndarray  # (N, nu) at most 0
    upper: np.ndarray  # (N, nu) at least 0
    lower_by_x: np.ndarray | None = None  # (N, nu, ndx) of the bounds; None where they are constant
    upper_by_x: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Servos:
    """Bounds low - c y <= u <= high - c y of S controls, affine in M entries y of the state."""

    control: np.ndarray  # (S,) which controls
    in_x: np.ndarray  # (M,) the entries of a state
    in_dx: np.ndarray  # (M,) the same of a deviation
    low: np.ndarray  # (S,)
    high: np.ndarray  # (S,)
    now: np.ndarray  # (S, M) c at the start of a stage
    late: np.ndarray  # (S, M) c at its end
    ndx: int

    def bounds(self, xs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Lower and upper bounds (..., S) at states xs (..., nx), and weights (..., S, 2) of start and end in each."""
        y = xs[..., self.in_x]
        at = np.stack([y @ self.now.T, y @ self.late.T], axis=-1)  # (..., S, 2)
        low, high = self.low[:, None] - at, self.high[:, None] - at
        parts = [
            np.stack([first, ~first], axis=-1) for first in (low[..., 0] >= low[..., 1], high[..., 0] <= high[..., 1])
        ]
        lower, upper = low.max(axis=-1), high.min(axis=-1)
        crossed = lower > upper
        with np.errstate(invalid="ignore"):
            middle = 0.5 * (lower + upper)
        lower, upper = np.where(crossed, middle, lower), np.where(crossed, middle, upper)
        parts = [np.where(crossed[..., None], 0.5, part) for part in parts]
        return lower, upper, parts[0], parts[1]


@dataclass(frozen=True, eq=False)
class ControlBounds:
    """Lower and upper bounds of the controls, (N, nu) each, and those of servos."""

    lower: np.ndarray
    upper: np.ndarray
    servos: Servos | None = None

    def at(self, stages: Any, xs: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """The bounds (..., nu) of stages (an index, a slice or (...,)) at states xs (..., nx).

        Without states those of servos are left out.
        """
        lower, upper = self.lower[stages], self.upper[stages]
        if self.servos is None or xs is None:
            return lower, upper
        return self._sides(stages, xs)[:2]

    def clip(self, stages: Any, us: np.ndarray, xs: np.ndarray | None) -> np.ndarray:
        """Controls us (..., nu) clipped to the bounds at states xs (..., nx)."""
        return us.clip(*self.at(stages, xs))

    def clamped(self, stages: Any, us: np.ndarray, xs: np.ndarray) -> np.ndarray:
        """Controls with the forces that the actuators' clamps leave of us (..., nu) at states xs (..., nx).

        For dynamics without clamps; those of a simulator do it by themselves.
        """
        us = np.clip(us, *self.at(stages, None))
        if self.servos is None:
            return us
        servos, us = self.servos, us.copy()
        at = xs[..., servos.in_x] @ servos.now.T
        us[..., servos.control] = np.clip(us[..., servos.control], servos.low - at, servos.high - at)
        return us

    def at_bound(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """Whether controls us (N, nu) along the states xs (N+1, nx) are at a bound, or outside."""
        lower, upper = self.at(slice(None), xs[: len(us)])
        nearly = 0.0 if self.servos is None else AT_BOUND * np.maximum(1.0, np.abs(us))
        return (us <= lower + nearly) | (us >= upper - nearly)

    def shifted_with_bounds(self, us: np.ndarray, xs: np.ndarray, to: np.ndarray) -> np.ndarray:
        """Controls us (N, nu) at bounds along states xs (N+1, nx), shifted to the bounds along states `to`."""
        if self.servos is None:
            return us
        (lower, upper), after = self.at(slice(None), xs[: len(us)]), self.at(slice(None), to[: len(us)])
        low = us - lower < upper - us
        return us + np.where(low, after[0] - lower, after[1] - upper)

    def step_bounds(self, xs: np.ndarray, us: np.ndarray) -> StepBounds:
        """Bounds of the change of controls us (N, nu) along the states xs (N+1, nx)."""
        if self.servos is None:
            return StepBounds(self.lower - us, self.upper - us)
        lower, upper, *shares = self.shares(xs, us)
        servos, by_x = self.servos, [np.zeros((*us.shape, self.servos.ndx)) for _ in range(2)]
        for rows, share in zip(by_x, shares, strict=True):
            of_servos = share[:, servos.control]
            slopes = -(of_servos[..., :1] * servos.now + of_servos[..., 1:] * servos.late)  # (N, S, M)
            rows[:, servos.control[:, None], servos.in_dx] = slopes
        return StepBounds(lower - us, upper - us, *by_x)

    def shares(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Bounds (N, nu) along states xs (N+1, nx), and weights (N, nu, 2) of start and end; 0 for constant bounds.

        Where controls us (N, nu) are at bounds but for rounding, they are the bounds: otherwise the box-QP takes tiny
        steps.
        """
        lower, upper, by_low, by_high = self._sides(slice(None), xs[: len(us)])
        nearly = AT_BOUND * np.maximum(1.0, np.abs(us))
        lower, upper = (np.where(np.abs(us - side) <= nearly, us, side) for side in (lower, upper))
        return lower, upper, by_low, by_high

    def _sides(self, stages: Any, xs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As shares, for any stages and states."""
        assert self.servos is not None
        shape = np.broadcast_shapes(self.lower[stages].shape, (*xs.shape[:-1], self.lower.shape[1]))
        lower, upper = (np.broadcast_to(side[stages], shape).copy() for side in (self.lower, self.upper))
        which = self.servos.control
        constant_lower, constant_upper = lower[..., which], upper[..., which]
        low, high, by_low, by_high = self.servos.bounds(xs)
        shares = []
        for bound, side, part in ((lower, low, by_low), (upper, high, by_high)):
            bound[..., which] = np.minimum(np.maximum(side, constant_lower), constant_upper)
            share = np.zeros((*shape, 2))
            share[..., which, :] = np.where(((side > constant_lower) & (side < constant_upper))[..., None], part, 0.0)
            shares.append(share)
        return lower, upper, shares[0], shares[1]


class _Clamp(NamedTuple):
    """The range (2,) of an actuator's force from one clamp of the model."""

    what: str
    range: np.ndarray
    alone: bool  # Whether the actuator is the only one that it clamps
    constrained: bool = False  # Whether a constraint of the plan keeps it, on the sum of all that it clamps


def model_bounds(mechanism: Mechanism, nu: int) -> tuple[np.ndarray, np.ndarray]:
    """Constant lower and upper bounds (nu,) of the controls, from the model's clamps."""
    acts = mechanism.actuators
    lower, upper = np.full(nu, -np.inf), np.full(nu, np.inf)
    lower[: acts.nu], upper[: acts.nu] = acts.control_range.T
    for a in range(acts.nu):
        if _bounds_control(mechanism, a) and not acts.depends_on_state[a]:
            low, high = _control_range(mechanism, a)
            lower[a], upper[a] = max(lower[a], low), min(upper[a], high)
            if lower[a] > upper[a]:  # the nearest of ctrlrange
                lower[a] = upper[a] = np.clip(lower[a], *acts.control_range[a])
    return lower, upper


def servo_bounds(mechanism: Mechanism, dt: float, ndx: int, without: frozenset[int] = frozenset()) -> Servos | None:
    """The bounds that depend on the state; None for none.

    Args:
        mechanism: The machine.
        dt: Length of a stage, s.
        ndx: Size of a deviation of the state.
        without: Actuators with bounds of the user's.
    """
    acts, nv = mechanism.actuators, mechanism.nv
    which = [
        a for a in range(acts.nu) if a not in without and _bounds_control(mechanism, a) and acts.depends_on_state[a]
    ]
    if not which:
        return None
    lengths = np.where(mechanism.kind == SCREW, acts.moment[which], 0.0) / acts.gain[which][:, None]  # (S, nv)
    rates = acts.moment[which] / acts.gain[which][:, None]
    bias = acts.bias[which]
    now = np.concatenate([bias[:, 1:2] * lengths, bias[:, 2:] * rates], axis=1)
    late = now.copy()
    late[:, nv:] += dt * bias[:, 1:2] * lengths
    used = np.flatnonzero(np.any(now, axis=0) | np.any(late, axis=0))
    in_x = np.concatenate([mechanism.q_address, mechanism.nq + np.arange(nv)])
    low, high = np.array([_control_range(mechanism, a) for a in which]).T
    return Servos(np.array(which), in_x[used], used, low, high, now[:, used], late[:, used], ndx)


def summed_joint_forces(mechanism: Mechanism) -> dict[int, str]:
    """Names of the joints, by degree of freedom, with an actuatorfrcrange that no bound of one control keeps.

    Several actuators act on such a joint, or one through an activation or with a force law.
    """
    acts, found = mechanism.actuators, {}
    acts_on, by_wrenches = acts.acts_on, acts.by_wrenches
    limited = np.any(np.isfinite(mechanism.joint_force_range), axis=1)
    for name, links in zip(mechanism.joint_names, mechanism.joint_links, strict=True):
        i = links.start
        which = np.flatnonzero(acts_on[:, i])
        reached = limited[i] and np.any(acts.pushes[which]) and not np.any(by_wrenches[which])
        if name and reached and not (len(which) == 1 and _is_affine(mechanism, int(which[0]))):
            found[i] = name
    return found


def constrained_forces(mechanism: Mechanism) -> dict[int, str]:
    """Names of the actuators, by index, with a force law and a forcerange, which a constraint of the plan keeps."""
    acts = mechanism.actuators
    ranged = np.any(np.isfinite(acts.force_range), axis=1) & acts.by_law
    return {int(a): acts.names[a] for a in np.flatnonzero(ranged) if acts.names[a]}


def unbounded_actuators(mechanism: Mechanism) -> frozenset[int]:
    """The actuators with clamps that the plan does not have as bounds."""
    acts = mechanism.actuators
    return frozenset(
        a
        for a in range(acts.nu)
        if np.isfinite(acts.activation_range[a]).any()
        or any(not (clamp.constrained or (clamp.alone and _is_affine(mechanism, a))) for clamp in _clamps(mechanism, a))
    )


def unbounded(mechanism: Mechanism) -> tuple[str, ...]:
    """The clamps that the plan does not have as bounds, one sentence each: its replay judges them."""
    acts, found = mechanism.actuators, []
    for a, name in enumerate(acts.names):
        for clamp in _clamps(mechanism, a):
            if clamp.constrained:
                continue
            if not _is_affine(mechanism, a):
                why = (
                    "the force comes from an activation" if acts.dynamics[a] != DIRECT
                    else "the force is not linear in the state" if acts.by_law[a] else "its gain is 0"
                )  # fmt: skip
            elif not clamp.alone:
                why = "other actuators share it, and one acts at a site or the joint has no name"
            else:
                continue
            found.append(f"the {clamp.what} of actuator {name!r} is not bounded in the plan: {why}.")
        if np.isfinite(acts.activation_range[a]).any():
            found.append(f"the actrange of actuator {name!r} is not bounded in the plan: it is of an activation.")
    return tuple(found)


def _clamps(mechanism: Mechanism, a: int) -> list[_Clamp]:
    acts = mechanism.actuators
    found = []
    if np.isfinite(acts.force_range[a]).any():
        found.append(_Clamp("forcerange", acts.force_range[a], True, a in constrained_forces(mechanism)))
    for i in np.flatnonzero(acts.moment[a]):
        limits = mechanism.joint_force_range[i]
        if np.isfinite(limits).any():
            alone = int(np.count_nonzero(acts.acts_on[:, i])) == 1
            constrained = not (alone and _is_affine(mechanism, a)) and int(i) in summed_joint_forces(mechanism)
            found.append(_Clamp("actuatorfrcrange", np.sort(limits / acts.moment[a, i]), alone, constrained))
    return found


def _is_affine(mechanism: Mechanism, a: int) -> bool:
    """Whether an actuator's force is gain u + a bias that is affine in the state."""
    acts = mechanism.actuators
    return bool(acts.dynamics[a] == DIRECT and acts.gain[a] != 0.0 and not acts.by_law[a])


def _bounds_control(mechanism: Mechanism, a: int) -> bool:
    """Whether clamps of an actuator's force bound its control."""
    return _is_affine(mechanism, a) and any(clamp.alone for clamp in _clamps(mechanism, a))


def _control_range(mechanism: Mechanism, a: int) -> tuple[float, float]:
    """The control at which the clamps of an actuator's force begin, at length and length rate 0."""
    ranges = np.array([clamp.range for clamp in _clamps(mechanism, a) if clamp.alone])
    low, high = ranges[:, 0].max(), ranges[:, 1].min()
    acts = mechanism.actuators
    ends = (np.array([low, max(low, high)]) - acts.bias[a, 0]) / acts.gain[a]
    return float(ends.min()), float(ends.max())
