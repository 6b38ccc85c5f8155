"""The fastest motion of a machine, and how many steps of RK4 follow it in a stage.

The rates of a machine at a state are the moduli of the eigenvalues of d(dx/dt)/dx, with everything in it that acts:
dampers, servos, springs, friction, contacts, stops. RK4 is stable for lambda in the left half plane where

    |1 + z + z^2/2 + z^3/6 + z^4/24| <= 1,   z = lambda h:   |z| <= 2.78 on the real axis, 2.61 in every direction.

Damping that is too fast for that is taken implicitly (kernels.tree.rosenbrock), where a stage of as many substeps is so
near to two stages of half the length as IMPLICIT asks.

The joint of a rate is the one with the largest participation, the product of its entries in the right and the left
eigenvector, which has no unit (Perez-Arriaga, Verghese and Schweppe, IEEE Trans. Power App. Syst. 101, 1982).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.rigid_body import MAX_SUBSTEPS, RigidBodyDynamics
from planner.model.coordinates import coordinates_of_mechanism
from planner.model.mechanism import Mechanism

# |lambda| h of a substep that is aimed at: RK4 lets a fast motion die out by exp(-0.7) to 0.3 %, so that a replay at
# finer steps is the same to a fraction of what passes. At 1 it is 2 %, at 2 it is 0.33 in place of 0.14.
TARGET_RATE_STEP = 0.7
# The most, which 16 substeps may take. Of the 2.61 above a quarter is left, for states on the way whose rates are
# higher than those asked about.
MAX_RATE_STEP = 2.0
IMPLICIT = 1e-3
"""How much two stages of half the length may change a stage's A, of positions and of velocities times the stage, for
its damping to be taken implicitly: a tenth of what passes of a path."""
_PROBE_STEP = (
    1e-6  # s: A - 1 of an Euler step so short, over it, is d(dx/dt)/dx to its rounding, also of turning bodies
)
_EIGENVALUE_TOLERANCE = 1e-6  # relative: eigenvalues that are one
_ROUNDING = 1e-9  # relative


class FastestMode(NamedTuple):
    """The fastest rate of a machine."""

    rate: float  # 1/s
    joint: str  # Whose motion it is, or the activation


def fastest_mode(
    mechanism: Mechanism, states: np.ndarray | Iterable[np.ndarray], prescribed: Collection[str] = ()
) -> FastestMode:
    """The largest rate, 1/s, of a machine at states (K, nx) or (nx,), and the joint that it belongs to.

    Friction loss holds a joint at rest like an armature; a light joint is faster once it slips, so both are looked at.

    Args:
        mechanism: With actuators.
        states: Where to look: the start, the goal and home, for example.
        prescribed: Joints whose accelerations are inputs.

    Raises:
        PlannerError: Nothing drives the mechanism, or a prescribed joint is unknown.
    """
    xs, found = _rows(states), FastestMode(0.0, "")
    for one in _held_and_slipping(mechanism):
        dynamics = RigidBodyDynamics(one, _PROBE_STEP, "euler", prescribed)
        A, _ = dynamics.linearize(np.vstack([xs, xs[-1:]]), np.zeros((len(xs), dynamics.nu)))
        for slopes in (A - np.eye(dynamics.ndx)) / _PROBE_STEP:
            if not np.isfinite(slopes).all():
                continue
            values, right = np.linalg.eig(slopes)
            k = int(np.argmax(np.abs(values)))
            rate = float(abs(values[k]))
            if rate > found.rate:
                found = FastestMode(rate, _joint(mechanism, slopes, values[k], right[:, k]))
    return found


def _rows(states: np.ndarray | Iterable[np.ndarray]) -> np.ndarray:
    return np.atleast_2d(np.array(states if isinstance(states, np.ndarray) else list(states), dtype=float))


def _held_and_slipping(mechanism: Mechanism) -> tuple[Mechanism, ...]:
    """The machine, and the same without friction loss where it has some."""
    if not np.any(mechanism.friction_loss):
        return (mechanism,)
    return mechanism, replace(mechanism, friction_loss=np.zeros(mechanism.nv))


def _joint(mechanism: Mechanism, slopes: np.ndarray, value: complex, right: np.ndarray) -> str:
    """The name of what participates most in an eigenvalue with this eigenvector (ndx,)."""
    values, left = np.linalg.eig(slopes.T)
    same = np.abs(values - value) <= max(_EIGENVALUE_TOLERANCE * abs(value), np.abs(values - value).min())
    share = np.abs(right) * np.abs(left[:, same]).sum(axis=1)
    nv = mechanism.nv
    joint = np.concatenate([share[:nv] + share[nv : 2 * nv], share[2 * nv :]])
    k = int(np.argmax(joint))
    return coordinates_of_mechanism(mechanism)[k if k < nv else k + nv].name


def substeps_for(
    mechanism: Mechanism, dt: float, states: np.ndarray | Iterable[np.ndarray], prescribed: Collection[str] = ()
) -> int:
    """How many substeps of RK4, 1 to 16, a stage of dt s needs for a machine's fastest motion.

    As many as follow it, or at the most 16 if it stays stable with these.

    Args:
        mechanism: With actuators.
        dt: Length of a stage, s.
        states: (K, nx) or (nx,), where to look: the start, the goal and home, for example.
        prescribed: Joints whose accelerations are inputs.

    Raises:
        PlannerError: It takes more than 16; the sentence has the joint, its rate and the stage that it needs.
    """
    return substeps_of(fastest_mode(mechanism, states, prescribed), dt)


def substeps_of(found: FastestMode, dt: float) -> int:
    """The substeps, 1 to 16, of a stage of dt s for this fastest rate; a PlannerError where they are more."""
    if found.rate * dt > MAX_SUBSTEPS * MAX_RATE_STEP * (1.0 + _ROUNDING):
        substeps = math.ceil(found.rate * dt / MAX_RATE_STEP)
        longest = MAX_SUBSTEPS * MAX_RATE_STEP / found.rate
        raise PlannerError(
            f"{found.joint} has a rate of {found.rate:.4g} per s, which takes {substeps} substeps in a stage of "
            f"{dt:g} s and {MAX_SUBSTEPS} are the most, expected dt = {_round_down(longest):g}, or less damping or "
            "gain there."
        )
    return min(max(math.ceil(found.rate * dt / TARGET_RATE_STEP - _ROUNDING), 1), MAX_SUBSTEPS)


def implicit_error(
    mechanism: Mechanism, dt: float, states: np.ndarray | Iterable[np.ndarray], prescribed: Collection[str] = ()
) -> float:
    """How much two stages of dt / 2 differ from one of dt s by the Rosenbrock method with 16 substeps; see IMPLICIT.

    The states are those of `fastest`. Infinite where a stage runs away.
    """
    xs, change = _rows(states), 0.0
    for one in _held_and_slipping(mechanism):
        whole, half = (RigidBodyDynamics(one, step, "rosenbrock", prescribed, MAX_SUBSTEPS) for step in (dt, 0.5 * dt))
        us, scale = np.zeros((len(xs), whole.nu)), np.ones(whole.ndx)
        scale[mechanism.nv : 2 * mechanism.nv] = dt
        with np.errstate(all="ignore"):
            middle = half.step(xs, us)
            first, second = (half.linearize(np.vstack([x, x[-1:]]), us)[0] for x in (xs, middle))
            A, _ = whole.linearize(np.vstack([xs, xs[-1:]]), us)
            apart = float(np.abs(scale[:, None] * (second @ first - A) / scale).max())
        change = max(change, apart if np.isfinite(apart) else math.inf)
    return change


def reason(found: FastestMode, substeps: int) -> str:
    """The sentence of a count of substeps."""
    steps = "1 step a stage is enough:" if substeps == 1 else f"{substeps} substeps a stage, because"
    return f"{steps} {found.joint} has the highest rate, {found.rate:.4g} per s."


def _round_down(value: float) -> float:
    """The next lower of 1, 2, 5, 10, ...: stages of these fit most durations."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1.0 + _ROUNDING)) * power
