"""Bounds of the controls that a model's own clamps make: ctrlrange, forcerange and actuatorfrcrange."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.model.actuators import DIRECT
from planner.model.mechanism import SCREW, Mechanism
from planner.problem.control_bounds import Servos


class _Clamp(NamedTuple):
    """The range (2,) of an actuator's force from one clamp of the file."""

    what: str
    range: np.ndarray
    alone: bool  # Whether the actuator is the only one that it clamps


def model_bounds(mechanism: Mechanism, nu: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds (nu,) of the controls as far as they do not depend on the state."""
    acts = mechanism.actuators
    lower, upper = np.full(nu, -np.inf), np.full(nu, np.inf)
    lower[: acts.nu], upper[: acts.nu] = acts.control_range.T
    for a in range(acts.nu):
        if _bounded(mechanism, a) and not _moves(mechanism, a):
            low, high = _control_range(mechanism, a)
            lower[a], upper[a] = max(lower[a], low), min(upper[a], high)
            if lower[a] > upper[a]:  # the nearest of ctrlrange
                lower[a] = upper[a] = np.clip(lower[a], *acts.control_range[a])
    return lower, upper


def servo_bounds(mechanism: Mechanism, dt: float, ndx: int, without: frozenset[int] = frozenset()) -> Servos | None:
    """The bounds that depend on the state, for stages of dt s; None where there are none.

    Args:
        mechanism: The machine.
        dt: Length of a stage, s.
        ndx: Size of a deviation of the state.
        without: Actuators that the user bounds.
    """
    acts, nv = mechanism.actuators, mechanism.nv
    which = [a for a in range(acts.nu) if a not in without and _bounded(mechanism, a) and _moves(mechanism, a)]
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


def unbounded_actuators(mechanism: Mechanism) -> frozenset[int]:
    """The actuators with clamps that bound no control of a plan."""
    acts = mechanism.actuators
    return frozenset(
        a
        for a in range(acts.nu)
        if np.isfinite(acts.activation_range[a]).any()
        or any(not (clamp.alone and _plain(mechanism, a)) for clamp in _clamps(mechanism, a))
    )


def unbounded(mechanism: Mechanism) -> tuple[str, ...]:
    """The clamps of the model that bound no control of a plan, one sentence each: its replay judges them."""
    acts, found = mechanism.actuators, []
    for a, name in enumerate(acts.names):
        for clamp in _clamps(mechanism, a):
            if not _plain(mechanism, a):
                why = "the force comes from an activation" if acts.dynamics[a] != DIRECT else "its gain is 0"
            elif not clamp.alone:
                why = "several actuators share it"
            else:
                continue
            found.append(f"the {clamp.what} of actuator {name!r} is not bounded in the plan: {why}.")
        if np.isfinite(acts.activation_range[a]).any():
            found.append(f"the actrange of actuator {name!r} is not bounded in the plan: it is of an activation.")
    return tuple(found)


def _clamps(mechanism: Mechanism, a: int) -> list[_Clamp]:
    acts = mechanism.actuators
    found = [_Clamp("forcerange", acts.force_range[a], True)] if np.isfinite(acts.force_range[a]).any() else []
    for i in np.flatnonzero(acts.moment[a]):
        limits = mechanism.joint_force_range[i]
        if np.isfinite(limits).any():
            alone = int(np.count_nonzero(acts.moment[:, i])) == 1
            found.append(_Clamp("actuatorfrcrange", np.sort(limits / acts.moment[a, i]), alone))
    return found


def _plain(mechanism: Mechanism, a: int) -> bool:
    """Whether an actuator's force is gain u + bias of the state."""
    return bool(mechanism.actuators.dynamics[a] == DIRECT and mechanism.actuators.gain[a] != 0.0)


def _bounded(mechanism: Mechanism, a: int) -> bool:
    """Whether clamps of an actuator's force bound its control."""
    return _plain(mechanism, a) and any(clamp.alone for clamp in _clamps(mechanism, a))


def _moves(mechanism: Mechanism, a: int) -> bool:
    """Whether an actuator's force depends on the state."""
    return bool(np.any(mechanism.actuators.bias[a, 1:]))


def _control_range(mechanism: Mechanism, a: int) -> tuple[float, float]:
    """The control at which the clamps of an actuator's force begin, at length and length rate 0."""
    ranges = np.array([clamp.range for clamp in _clamps(mechanism, a) if clamp.alone])
    low, high = ranges[:, 0].max(), ranges[:, 1].min()
    acts = mechanism.actuators
    ends = (np.array([low, max(low, high)]) - acts.bias[a, 0]) / acts.gain[a]
    return float(ends.min()), float(ends.max())
